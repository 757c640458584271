"""Turn the file of a raw source into codes of camera RGB, and into the parts of a plan that the file gives.

With ``source.shrink=1`` the codes are the DN of the mosaic, the same in all channels; each site uses the code of its
filter. With 2 they are means of Bayer cells: `SourcePlan.code_levels` has their black and white. Colours decide no
pixel of a pair; pictures are drawn with them.
"""

from __future__ import annotations

import operator
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.limits import MAX_GAIN, MIN_GAIN
from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.core.sequences import add_in_order
from unprocess_gen.simulation.facts import RawParts
from unprocess_gen.simulation.plan import CameraPlan, IspPlan, Levels, SensorPlan, SourcePlan
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.cfa import PATTERNS, plane_sites
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.raw.decode import RawFrame, decode_raw
from unprocess_gen.sources.raw.mosaics import mosaic_pixels
from unprocess_gen.sources.raw.tags import RawMetadata

LONGEST_CAMERA_NAME = 64
"""Characters of the name of a camera in a row."""


def read_raw_source(config: SourceConfig, content: bytes, name: str) -> Photograph:
    """Decode the bytes of a raw source; ``name`` gives the format.

    Raises SourceError if they are damaged or no mosaic, and ConfigError if a library is missing.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in RAW_FILES:
        frame = decode_raw(content, suffix, config.max_pixels, config.raw.white_dn)
    else:
        frame = _mosaic(config, content, suffix)
    facts, (sensor, black, white) = frame.metadata, file_sensor(frame, config.raw)
    digest, stated = array_xxh3(frame.pixels), (facts.iso or 0.0, facts.exposure_s or 0.0)
    source = SourcePlan(1, "off", config.shrink, sensor.pattern, black, white, digest, *stated)
    if config.shrink == 1:
        codes, noise = np.repeat(frame.pixels[..., None], 3, axis=2), _own_noise(facts, config.raw, white[1] - black[1])
    else:
        codes, noise = _cell_means(frame.pixels, source), None
    if config.own_noise == "subtract" and noise is None:
        problem = "states no noise that source.own_noise=subtract could use (NoiseProfile)"
        raise SourceError("unsupported", f"{problem}; give source.raw.a_dn and source.raw.b_dn2, or keep its noise")
    parts = RawParts(source, _camera(facts), IspPlan("none", "srgb"), sensor, noise)
    return Photograph(codes, 1, parts, "; ".join(facts.notes))


def _mosaic(config: SourceConfig, content: bytes, suffix: str) -> RawFrame:
    """Decode a mosaic of 16-bit integers in an NPY, PNG or TIFF file."""
    raw = config.raw
    if raw.pattern is None or raw.black_dn is None or raw.white_dn is None:
        needed = "source.raw.pattern, source.raw.black_dn and source.raw.white_dn"
        raise SourceError("unsupported", f"a {suffix[1:].upper()} file states no levels and no pattern; give {needed}")
    pixels = mosaic_pixels(content, suffix, config.max_pixels)
    if pixels.dtype != np.uint16 or pixels.ndim != 2 or not pixels.size:
        actual = f"{pixels.dtype} {list(pixels.shape)}"
        raise SourceError("unsupported", f"contains {actual}; expected a mosaic [H, W] of uint16")
    if pixels.size > config.max_pixels:
        raise SourceError("too_large", f"has {pixels.size} pixels; expected source.max_pixels={config.max_pixels}")
    return RawFrame(pixels, RawMetadata(pattern=raw.pattern))


def file_sensor(frame: RawFrame, raw: RawConfig) -> tuple[SensorPlan, Levels, Levels]:
    """Sensor of a file with one black and one white level, and the levels of each plane; given ones take precedence.

    Raises SourceError for another pattern than the given one, and for missing or impossible levels.
    """
    facts = frame.metadata
    pattern, expected = facts.pattern or "", PATTERNS if raw.pattern is None else (raw.pattern,)
    if pattern not in expected:
        text = f"has {pattern or 'no'} CFA pattern of 2 x 2 sites; expected {', '.join(expected)}"
        raise SourceError("unsupported", text)
    by_site = facts.black_dn if raw.black_dn is None else (raw.black_dn,) * 4
    level = facts.white_dn if raw.white_dn is None else raw.white_dn
    if by_site is None or level is None:
        missing = "black" if by_site is None else "white"
        raise SourceError("unsupported", f"states no {missing} level; give source.raw.{missing}_dn")
    black, white = tuple(float(by_site[2 * y + x]) for y, x in plane_sites(pattern)), (float(level),) * 4
    if not 0 <= min(black) <= max(black) < white[0] <= 65535:
        text = f"states the black levels {black} and the white level {level:g}; expected black below white"
        raise SourceError("corrupt", f"{text}; give source.raw.black_dn and source.raw.white_dn")
    return SensorPlan(pattern, round(level).bit_length(), round(add_in_order(black) / 4), round(level)), black, white


def _cell_means(pixels: NDArray[np.uint16], source: SourcePlan) -> NDArray[np.uint16]:
    """Means of the sites of each colour in each Bayer cell, as codes [H, W, 3]."""
    height, width = (side // 2 * 2 for side in pixels.shape)
    if not min(height, width):
        raise SourceError("too_small", "has less than one cell of 2 x 2 sites (source.shrink)")
    levels = zip(plane_sites(source.raw_pattern), source.raw_black_dn, source.raw_white_dn, strict=True)
    red, *greens, blue = ((pixels[y:height:2, x:width:2] - black) / (white - black) for (y, x), black, white in levels)
    (black, *_), (white, *_) = source.code_levels
    codes = np.rint(np.stack([red, (greens[0] + greens[1]) / 2, blue], axis=-1) * (white - black) + black)
    return np.clip(codes, 0, 65535).astype(np.uint16)


def _own_noise(facts: RawMetadata, raw: RawConfig, span_dn: float) -> tuple[float, float] | None:
    """S and O of the file's own noise, given or from the tag NoiseProfile; planes are averaged."""
    stated = facts.noise_profile or ()
    if raw.a_dn is not None and raw.b_dn2 is not None:
        return raw.a_dn / span_dn, raw.b_dn2 / (span_dn * span_dn)
    shares = {2: (1.0,), 6: (0.25, 0.5, 0.25), 8: (0.25,) * 4}.get(len(stated))
    if shares is None or not any(stated) or not all(0 <= number < 1 for number in stated):
        return None
    scale, offset = (add_in_order(map(operator.mul, shares, stated[first::2])) for first in (0, 1))
    return scale, offset


def _camera(facts: RawMetadata) -> CameraPlan:
    """Colours of a file: the matrix at its white point and its gains; neutral ones if it states none."""
    matrix, gains = camera_colours(facts)
    red, blue = gains or (1.0, 1.0)
    name = "".join(letter for letter in facts.model or "" if letter.isascii() and letter.isprintable())
    rgb2cam = colour.IDENTITY if matrix is None else colour.rgb2cam(matrix)
    return CameraPlan(
        camera=name[:LONGEST_CAMERA_NAME] or "unknown",
        weights=(0.0, 0.0, 0.0, 0.0),
        rgb2cam=rgb2cam,
        red_gain=red,
        blue_gain=blue,
        inverse_rgb_gain=1.0,
    )


def camera_colours(facts: RawMetadata) -> tuple[colour.Matrix | None, tuple[float, float] | None]:
    """Matrix from XYZ to the camera at the white point of a file, and its gains of red and blue.

    Raises SourceError if its tags contradict each other.
    """
    try:
        tags = facts.colour
        matrix = facts.xyz2cam if tags is None else tags.matrix_at(tags.white())
        gains = facts.gains if tags is None else tags.gains() or facts.gains
        if matrix is not None:
            colour.rgb2cam(matrix)
        if gains is not None and not all(MIN_GAIN <= gain <= MAX_GAIN for gain in gains):
            raise ValueError(f"the gains {gains[0]:g} and {gains[1]:g}")
    except (ValueError, ZeroDivisionError, OverflowError) as error:
        raise SourceError("corrupt", f"its colour tags contradict each other ({error})") from error
    return matrix, gains
