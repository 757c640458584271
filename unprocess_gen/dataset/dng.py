"""Export frames of a dataset as DNG files: uncompressed uint16 mosaics with the colours of their row.

The tags follow the DNG Specification 1.4 and, where it is silent, Adobe's DNG SDK 1.4. With span = white - black:

* ColorMatrix1 converts XYZ under D65 to native camera values: diag(1/red, 1, 1/blue) · rgb2cam · rgb2xyz⁻¹. Rows of
  rgb2cam sum to 1, so D65 becomes (1/red, 1, 1/blue), which is AsShotNeutral. A reader that estimates the white point
  from both finds xy (0.3127, 0.3290).
* BaselineExposure is the brightening in stops: log2(exposure_ratio / largest inverse gain). Readers scale a neutral so
  that white is reached where the first channel saturates (dng_color_spec::SetWhiteXY; LibRaw too); the tag cancels this
  scale. LibRaw and dcraw leave the tag to their callers. LibRaw also takes the brightest DN for white if it exceeds
  three quarters of it; adjust_maximum_thr=0 switches this off.
* NoiseProfile describes the variance of the noise of a site: S·x + O, with x = 0 at black and 1 at white. Therefore
  S = a_dn / span and O = dark_variance_dn2 / span². The tag cannot describe correlations, PRNU and rounding. Readers
  refuse S of 0 or less and O below 0 (dng_noise_function::IsValid). The clean frame and noisy frames with such values
  have no NoiseProfile.
* BlackLevel is the camera's nominal value, equal at all four sites; a black-level error is unknown to the camera.

No tag records how highlights were kept. Above the row's threshold readers show them brighter than the photograph,
channel by channel, so bright colours shift; white stays white. WhiteLevel is the sensor's, even if the full well
saturates below it.

Files contain no time: equal rows and frames give equal bytes. Decisions: ``docs/design/dataset_format.md``.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.arrays import UINT16, Float, Frame
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import array_xxh3, machine_errors
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath, LocalPath
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import CHANNELS, MONO
from unprocess_gen.simulation.reference.colour import RGB2XYZ, Matrix, invert, matrix, multiply
from unprocess_gen.simulation.reference.sensor import quantise

FRAMES = ("clean", "noisy")

LEAST_SIDE_PX, GREATEST_SIDE_PX = 22, 64000
"""Limits of a side, beyond which LibRaw 0.22.2 does not open a file (identify.cpp)."""

MOST_PIXELS = 2**31 - 2**20
"""TIFF has 32-bit offsets: 4 GB for pixels and tags."""

MAKE = "unprocess_gen"
D65 = 21
"""Value of CalibrationIlluminant1 (EXIF LightSource)."""


class DngSummary(NamedTuple):
    """Numbers of files written, of files that existed with the same bytes, of noisy ones without NoiseProfile, and of
    failed rows that were skipped.
    """

    written: int
    present: int
    without_profile: int
    failed: int


def export(folder: AnyPath, keys: str, frames: Sequence[str], to: Path) -> DngSummary:
    """Write frames (names of `FRAMES`) of the pairs that ``keys`` select as ``to/KEY.FRAME.dng``.

    A file that has the bytes to be written is kept. Nothing is written if a key does not exist or failed, a noisy frame
    is not of uint16, a frame is too small or large for a DNG, or another file of that name exists (ConfigError).
    """
    require("tifffile", "dng: tifffile is missing", "dng")
    check_output_folder(to, f"--to {to}")
    pairs, (rows, failed) = RawPairs(folder), select_pairs(folder / "manifest.csv", keys)
    for row in rows.values():
        _check_writable(row)
    files = {f"{row['key']}.{frame}.dng": (number, frame) for number, row in rows.items() for frame in frames}
    present = [name for name in files if (to / name).exists()]
    for name in present:
        if (to / name).read_bytes() != _content(pairs, *files[name]):
            raise ConfigError(f"--to {to}: {name} exists with other bytes; choose another folder")
    written = [name for name in files if name not in present]
    for name in written:
        with machine_errors(to / name):
            to.mkdir(parents=True, exist_ok=True)
            LocalPath(to / name).write(_content(pairs, *files[name]), str(to))
    profiles = [noise_profile(plan_from_row(row)) for row in rows.values() if "noisy" in frames]
    return DngSummary(len(written), len(present), profiles.count(None), failed)


def _check_writable(row: Row) -> None:
    """Raise ConfigError with the reason if the frames of a row cannot be DNG files."""
    key, width, height = row["key"], int(row["width"] or 0), int(row["height"] or 0)
    if row["dtype"] != UINT16:
        raise ConfigError(
            f"--keys {key}: has {row['dtype']} values, which LibRaw would round; a DNG needs output.dtype={UINT16}"
        )
    if row["pattern"] == MONO:
        problem = "has no colour filters, and raw converters differ in what they open as such a DNG"
        raise ConfigError(f"--keys {key}: pattern=MONO: {problem}; expected a Bayer pattern; use RawPairs")
    if min(width, height) < LEAST_SIDE_PX:
        raise ConfigError(
            f"--keys {key}: is {width} x {height}; LibRaw, which most raw converters read with, opens no DNG with a "
            f"side under {LEAST_SIDE_PX} pixels"
        )
    if max(width, height) > GREATEST_SIDE_PX or width * height > MOST_PIXELS:
        raise ConfigError(
            f"--keys {key}: is {width} x {height}; a DNG holds 4 GB, and LibRaw opens none with a side over "
            f"{GREATEST_SIDE_PX} pixels"
        )


def _content(pairs: RawPairs, number: int, name: str) -> bytes:
    sample = pairs[number]
    frame = sample.clean if name == "clean" else sample.noisy
    dn = mosaic_dn(frame, sample.row)
    if dn.dtype != np.uint16:  # the clean frame of clean_dtype=float32
        dn = quantise(dn.astype(np.float64), 0, 2 ** int(sample.row["bits"]) - 1)
    if array_xxh3(frame) != sample.row[f"{name}_xxh3"]:
        raise DamageError(f"{pairs.path}: the {name} frame of {sample.row['key']} differs from the digest in its row")
    return encode(dn, sample.row, name)


# --------------------------------------------------------------------------------------------------------- one file


Tag = tuple[int, int, int, str | bytes | int | tuple[int, ...] | tuple[float, ...]]
"""An entry of the TIFF directory: code, type, number of values (0: length of the text) and values."""

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 10, 12
"""Types of TIFF 6.0, section 2."""


def encode(frame: Frame | Float, row: Row, name: str) -> bytes:
    """DNG file of the frame ``name`` (``clean`` or ``noisy``) of a row's pair, a uint16 mosaic [H, W].

    Raises ConfigError if a colour value of the row exceeds 2^30.
    """
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(
        file,
        frame,
        photometric="cfa",
        compression=None,
        byteorder="<",
        bigtiff=False,
        subfiletype=0,
        metadata=None,
        software=MAKE,
        description=f"{name} frame of {row['key']}",
        extratags=[(*tag, True) for tag in tags(row, name, (frame.shape[0], frame.shape[1]))],
    )
    return file.getvalue()


def tags(row: Row, name: str, shape: tuple[int, int]) -> list[Tag]:
    """Tags that TIFF itself does not require, by increasing code; ``shape`` is (height, width)."""
    plan, (height, width) = plan_from_row(row), shape
    profile = noise_profile(plan) if name == "noisy" else None
    return [
        (271, ASCII, 0, MAKE),  # Make
        (272, ASCII, 0, plan.camera.camera),  # Model
        (274, SHORT, 1, 1),  # Orientation: frames are upright
        (33421, SHORT, 2, (2, 2)),  # CFARepeatPatternDim
        (33422, BYTE, 4, bytes(CHANNELS.index(letter) for letter in plan.sensor.pattern)),  # CFAPattern
        *_exposure(row),
        (50706, BYTE, 4, bytes((1, 4, 0, 0))),  # DNGVersion
        (50707, BYTE, 4, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        (50708, ASCII, 0, f"{MAKE} {plan.camera.camera}"),  # UniqueCameraModel
        (50710, BYTE, 3, bytes((0, 1, 2))),  # CFAPlaneColor: red, green, blue
        (50711, SHORT, 1, 1),  # CFALayout: rectangular
        (50713, SHORT, 2, (2, 2)),  # BlackLevelRepeatDim
        (50714, LONG, 4, (plan.sensor.black_level_dn,) * 4),  # BlackLevel
        (50717, LONG, 1, plan.sensor.white_level_dn),  # WhiteLevel
        (50719, LONG, 2, (0, 0)),  # DefaultCropOrigin
        (50720, LONG, 2, (width, height)),  # DefaultCropSize
        (50721, SRATIONAL, 9, _rationals(color_matrix(plan))),  # ColorMatrix1
        (50728, RATIONAL, 3, _rationals(as_shot_neutral(plan))),  # AsShotNeutral
        (50730, SRATIONAL, 1, rational(baseline_exposure_ev(plan))),  # BaselineExposure
        (50778, SHORT, 1, D65),  # CalibrationIlluminant1
        (50829, LONG, 4, (0, 0, height, width)),  # ActiveArea
        *([(51041, DOUBLE, 6, profile * 3)] if profile else []),  # NoiseProfile: the same for the three planes
    ]


def _exposure(row: Row) -> list[Tag]:
    """EXIF tags of exposure time and ISO, which rows of physical profiles have."""
    iso, seconds = float(row.get("iso") or 0), float(row.get("exposure_s") or 0)
    if not iso or not seconds:
        return []
    short = min(round(iso), 65535)  # the largest of 16 bits refers to ISOSpeed
    speed = [(34867, LONG, 1, round(iso))] if short == 65535 else []
    return [(33434, RATIONAL, 1, rational(seconds)), (34855, SHORT, 1, short), *speed]


def color_matrix(plan: Plan) -> Matrix:
    """Row-major matrix from XYZ under D65 to native camera values, white-balance gains included."""
    native = matrix([as_shot_neutral(plan)[i // 3] * entry for i, entry in enumerate(plan.camera.rgb2cam)])
    return multiply(native, invert(RGB2XYZ))


def as_shot_neutral(plan: Plan) -> tuple[float, float, float]:
    """Native camera values of a neutral colour, relative to green."""
    return 1 / plan.camera.red_gain, 1.0, 1 / plan.camera.blue_gain


def baseline_exposure_ev(plan: Plan) -> float:
    """Stops by which a reader brightens the frame to the brightness of the photograph."""
    return -math.log2(1 / plan.scene.exposure_ratio * max(plan.camera.inverse_gains))


def noise_profile(plan: Plan) -> tuple[float, float] | None:
    """S and O of variance = S·x + O, x = 0 at black and 1 at white; None if readers would refuse them."""
    span_dn = plan.sensor.white_level_dn - plan.sensor.black_level_dn
    scale, offset = plan.noise.variance_line[0] / span_dn, dark_variance_dn2(plan) / span_dn**2
    return (scale, offset) if scale > 0 and offset >= 0 else None


def rational(value: float) -> tuple[int, int]:
    """Nearest fraction of two signed 32-bit integers whose denominator is a power of two.

    The error is at most 2^-31, or 2^-30 of the value if it exceeds 1. Raises ConfigError from 2^30 on.
    """
    bits = 30 - max(math.frexp(value)[1], 0)
    if bits < 0:
        raise ConfigError(f"a colour value of the row is {value:g}; expected less than 2^30, the limit of a DNG")
    return round(math.ldexp(value, bits)), 1 << bits


def _rationals(values: Iterable[float]) -> tuple[int, ...]:
    return tuple(part for value in values for part in rational(value))
