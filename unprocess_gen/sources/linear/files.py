"""Decode the file of a linear source."""

from __future__ import annotations

from pathlib import PurePosixPath

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.linear.pixels import linear_pixels, linear_source
from unprocess_gen.sources.raw.mosaics import mosaic_pixels


def read_linear_source(config: SourceConfig, content: bytes, name: str) -> Photograph:
    """Decode the bytes of a linear source, whose ``name`` gives the format.

    Raises SourceError if they are damaged or no scene-linear picture, and ConfigError if a library is missing.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix != ".npy":
        raise SourceError("unsupported", f"is a {suffix} file")
    light = linear_pixels(mosaic_pixels(content, suffix))
    return Photograph(light, 1, source=linear_source(config, light))
