"""Check the light of a linear source, and describe it for a plan."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.simulation.plan import PRIMARIES, SourcePlan
from unprocess_gen.simulation.reference.colour import IDENTITY
from unprocess_gen.simulation.reference.primaries import PRIMARIES as CHROMATICITIES
from unprocess_gen.simulation.reference.primaries import to_camera
from unprocess_gen.sources.image.decode import Photograph

SRGB = "srgb"
"""Primaries of files that state none."""


class Light(NamedTuple):
    """Decoded pixels [H, W, 3], their primaries as `SourcePlan.primaries`, and a note about what was left out."""

    pixels: NDArray[Any]
    primaries: str = SRGB
    note: str = ""


def chromaticity_text(numbers: Iterable[float]) -> str:
    """Name, or text in six decimals, of the chromaticities that a file states: x, y of red, green, blue and white.

    SourceError unless they are primaries.
    """
    text = _spelled(numbers)
    try:
        if not PRIMARIES.allows(text):
            raise ValueError("they are no eight numbers")
        to_camera(IDENTITY, text)
    except (ValueError, ZeroDivisionError) as error:
        raise SourceError("corrupt", f"states the chromaticities {text[:80]} ({error}); expected primaries") from error
    return NAMES.get(text, text)


def _spelled(numbers: Iterable[float]) -> str:
    return ";".join(f"{number:.6f}".rstrip("0").rstrip(".") for number in numbers)


NAMES = {_spelled(numbers): name for name, numbers in CHROMATICITIES.items()}
"""Names of known chromaticities."""


def linear_pixels(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Convert decoded light to float32 [H, W, 3] in native byte order; SourceError if it is no finite light."""
    actual = f"{pixels.dtype} {list(pixels.shape)}"
    is_float = pixels.dtype.newbyteorder("=") in (np.float16, np.float32)
    if not is_float or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
        raise SourceError("unsupported", f"is {actual}; expected light [H, W, 3] of float16 or float32")
    light = np.ascontiguousarray(pixels, np.float32)
    if not np.isfinite(light).all():
        count = int((~np.isfinite(light)).any(axis=2).sum())
        raise SourceError("corrupt", f"has {count} pixels that are NaN or infinite; expected finite light")
    return light


def linear_photograph(config: SourceConfig, light: Srgb, stated: str = SRGB, note: str = "") -> Photograph:
    """Photograph of light, with its digest, and the downscaling and primaries that its plan has as source."""
    source = SourcePlan(config.downscale, "off", primaries=config.primaries or stated)
    return Photograph(light, 1, note=note, source=source, pixels_xxh3=array_xxh3(light))
