"""Turn the file of a raw source into codes of camera RGB, and into the parts of a plan that the file gives.

With ``source.shrink=1`` the codes are the DN of the mosaic, the same in all channels; each site uses the code of its
filter. With 2 or 4 they are means of cells: `SourcePlan.code_levels` has their black and white. Colours decide no pixel
of a pair; pictures are drawn with them.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.limits import MAX_GAIN, MIN_GAIN
from unprocess_gen.config.raw_validation import by_plane
from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.raw_files import PICTURE_SUFFIXES, RAW_FILES
from unprocess_gen.core.types import CameraPlan, IspPlan, Levels, Photograph, RawParts, SensorPlan, SourcePlan
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.cfa import PATTERNS, plane_sites
from unprocess_gen.sources.image import decode
from unprocess_gen.sources.raw.decode import XTRANS_CELL, RawFrame, decode_raw
from unprocess_gen.sources.raw.metadata import LOSSY, RawMetadata

XTRANS = "XTRANS"
"""Value of the column ``raw_pattern`` for tiles of 6 x 6 sites."""
LONGEST_CAMERA_NAME = 64
"""Characters of the name of a camera in a row."""


def read_raw_source(config: SourceConfig, content: bytes, name: str) -> Photograph:
    """Decode the bytes of a raw source; ``name`` gives the format.

    Raises SourceError if they are damaged or no mosaic, and ConfigError if a library is missing.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if not content:
        raise SourceError("empty", f"{name} has 0 bytes")
    frame = decode_raw(content, config.max_pixels) if suffix in RAW_FILES else _mosaic(config, content, suffix)
    try:
        return _photograph(config, frame)
    except SourceError as error:
        raise SourceError(error.reason, f"{name} {error.text}") from error


def _photograph(config: SourceConfig, frame: RawFrame) -> Photograph:
    facts, pattern = frame.metadata, file_pattern(frame, config.raw)
    black, white = file_levels(facts, pattern, config.raw)
    if pattern == XTRANS and config.shrink == 1:
        raise SourceError("unsupported", "has an X-Trans mosaic; expected a Bayer mosaic, or source.shrink=2 or 4")
    source = SourcePlan(
        1,
        "off",
        config.shrink,
        pattern,
        black,
        white,
        array_xxh3(frame.pixels),
        facts.iso or 0.0,
        facts.exposure_s or 0.0,
    )
    codes = np.repeat(frame.pixels[..., None], 3, axis=2) if config.shrink == 1 else _cell_means(frame, pattern, source)
    noise = _own_noise(facts, config.raw, (black[1], white[1])) if config.shrink == 1 else None
    sensor = file_sensor(pattern, black, white)
    lossy = LOSSY.get(facts.compression or 0)
    note = f"is compressed with {lossy}, which removes noise and detail" if lossy else ""
    return Photograph(codes, 1, RawParts(source, _camera(facts), IspPlan("none", "srgb"), sensor, noise), note)


def _mosaic(config: SourceConfig, content: bytes, suffix: str) -> RawFrame:
    """Decode a mosaic of 16-bit integers in an NPY, PNG or TIFF file."""
    raw = config.raw
    if raw.pattern is None or raw.black_dn is None or raw.white_dn is None:
        needed = "source.raw.pattern, source.raw.black_dn and source.raw.white_dn"
        raise SourceError("unsupported", f"a {suffix[1:].upper()} file states no levels and no pattern; give {needed}")
    pixels = _picture(config, content) if suffix in PICTURE_SUFFIXES else _read_npy(content)
    if pixels.dtype != np.uint16 or pixels.ndim != 2 or not pixels.size:
        actual = f"{pixels.dtype} {list(pixels.shape)}"
        raise SourceError("unsupported", f"contains {actual}; expected a mosaic [H, W] of uint16")
    if pixels.size > config.max_pixels:
        raise SourceError("too_large", f"has {pixels.size} pixels; expected source.max_pixels={config.max_pixels}")
    return RawFrame(np.ascontiguousarray(pixels), RawMetadata(pattern=raw.pattern))


def _read_npy(content: bytes) -> NDArray[Any]:
    try:
        pixels: NDArray[Any] = np.load(io.BytesIO(content), allow_pickle=False)
        return pixels.astype(pixels.dtype.newbyteorder("="))
    except (ValueError, EOFError, AttributeError) as error:
        is_cut = content.startswith(b"\x93NUMPY") and any(word in str(error) for word in ("EOF", "reshape"))
        text = str(error).splitlines()[0] if str(error) else "no array"
        raise SourceError("truncated" if is_cut else "corrupt", f"its NPY file cannot be read ({text})") from error


def _picture(config: SourceConfig, content: bytes) -> NDArray[Any]:
    """Decode a gray picture with the decoder of photographs, which finds missing parts."""
    picture = decode.decode(content, max_pixels=config.max_pixels, icc="ignore")
    gray = picture.srgb[..., 0]
    if picture.orientation != 1 or (picture.srgb != gray[..., None]).any():
        problem = "is rotated" if picture.orientation != 1 else "has colours"
        raise SourceError("unsupported", f"{problem}; expected a gray picture of 16 bits: the mosaic")
    return gray


def file_pattern(frame: RawFrame, raw: RawConfig) -> str:
    """Return the CFA pattern of the visible part; SourceError if it is another one than the given, or none."""
    pattern = frame.metadata.pattern or "" if frame.xtrans is None else XTRANS
    if pattern not in (*PATTERNS, XTRANS):
        raise SourceError(
            "unsupported", f"has the CFA pattern {pattern or 'of no tile'}; expected {', '.join(PATTERNS)}"
        )
    if raw.pattern not in (None, pattern):
        raise SourceError("unsupported", f"has the CFA pattern {pattern}; expected source.raw.pattern={raw.pattern}")
    return pattern


def file_levels(facts: RawMetadata, pattern: str, raw: RawConfig) -> tuple[Levels, Levels]:
    """Return the levels of each plane: given levels, else the levels of the file."""
    if raw.black_dn is not None:
        black = by_plane(raw.black_dn)
    elif facts.black_dn is None:
        raise SourceError("unsupported", "states no black level; give source.raw.black_dn")
    elif pattern != XTRANS:
        black = tuple(facts.black_dn[2 * y + x] for y, x in plane_sites(pattern))
    elif len(set(facts.black_dn)) == 1:
        black = facts.black_dn
    else:
        raise SourceError("unsupported", f"states the black levels {facts.black_dn}; give source.raw.black_dn")
    if raw.white_dn is None and facts.white_dn is None:
        raise SourceError("unsupported", "states no white level; give source.raw.white_dn")
    white = by_plane(facts.white_dn if raw.white_dn is None else raw.white_dn)  # type: ignore[arg-type]
    if not all(0 <= low < high <= 65535 for low, high in zip(black, white, strict=True)):
        text = f"states the black levels {black} and the white levels {white}; expected black below white"
        raise SourceError("corrupt", f"{text}; give source.raw.black_dn and source.raw.white_dn")
    return black, white


def file_sensor(pattern: str, black: Levels, white: Levels) -> SensorPlan:
    """Return one black and one white level for all planes, the bits that hold them, and a Bayer pattern."""
    levels = round(sum(black) / 4), round(min(white))
    return SensorPlan("RGGB" if pattern == XTRANS else pattern, levels[1].bit_length(), *levels)


def _cell_means(frame: RawFrame, pattern: str, source: SourcePlan) -> NDArray[np.uint16]:
    """Return the means of the sites of each colour in each cell, as codes [H, W, 3]; incomplete cells are left out."""
    cell = XTRANS_CELL if pattern == XTRANS else source.shrink
    height, width = (side // cell for side in frame.pixels.shape)
    if not min(height, width):
        raise SourceError("too_small", f"has less than one cell of {cell} x {cell} sites (source.shrink)")
    pixels, planes = frame.pixels[: height * cell, : width * cell], _tile_planes(frame, pattern)
    light, counts = np.zeros((height, width, 3)), [0, 0, 0]
    for y in range(cell):
        for x in range(cell):
            plane = planes[y % len(planes)][x % len(planes)]
            black, white = source.raw_black_dn[plane], source.raw_white_dn[plane]
            light[..., (plane + 1) // 2] += (pixels[y::cell, x::cell] - black) / (white - black)
            counts[(plane + 1) // 2] += 1
    (black, *_), (white, *_) = source.code_levels
    codes = np.rint(light / np.array(counts, np.float64) * (white - black) + black)
    return np.clip(codes, 0, 65535).astype(np.uint16)


def _tile_planes(frame: RawFrame, pattern: str) -> Sequence[Sequence[int]]:
    """Return the packed plane of each site of the CFA tile."""
    if frame.xtrans is not None:
        return [[(0, 1, 3, 1)[colour] for colour in row] for row in frame.xtrans.tolist()]
    sites = {site: plane for plane, site in enumerate(plane_sites(pattern))}
    return [[sites[y, x] for x in (0, 1)] for y in (0, 1)]


def _own_noise(facts: RawMetadata, raw: RawConfig, levels: tuple[float, float]) -> tuple[float, float] | None:
    """Return S and O of the file's own noise, given or from the tag NoiseProfile; three planes are averaged."""
    span, stated = levels[1] - levels[0], facts.noise_profile or ()
    if raw.a_dn is not None and raw.b_dn2 is not None:
        return raw.a_dn / span, raw.b_dn2 / (span * span)
    if len(stated) not in (2, 6):
        return None
    shares = (1.0,) if len(stated) == 2 else (0.25, 0.5, 0.25)
    scale, offset = (
        sum(share * number for share, number in zip(shares, stated[first::2], strict=True)) for first in (0, 1)
    )
    return (scale, offset) if scale >= 0 and offset >= 0 else None


def _camera(facts: RawMetadata) -> CameraPlan:
    """Return the colours of a file: the matrix at its white point and its gains; neutral ones if it states none."""
    matrix, gains = camera_colours(facts)
    red, blue = gains or (1.0, 1.0)
    name = "".join(letter for letter in facts.model or "" if letter.isascii() and letter.isprintable())
    rgb2cam = colour.IDENTITY if matrix is None else colour.rgb2cam(matrix)
    weights = (0.0, 0.0, 0.0, 0.0)
    return CameraPlan(name[:LONGEST_CAMERA_NAME] or "unknown", weights, rgb2cam, red, blue, 1.0, "per_channel", 0.9)


def camera_colours(facts: RawMetadata) -> tuple[colour.Matrix | None, tuple[float, float] | None]:
    """Return the matrix from XYZ to the camera at the white point of a file, and its gains of red and blue.

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
