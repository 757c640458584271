"""A dataset's frames as DNG files, for raw converters and for eyes: uint16 mosaics, uncompressed, in the row's colours.

What the tags say, with span = white - black, the inverse gains (inverse_rgb / red, inverse_rgb, inverse_rgb / blue) and
the other numbers of the row (DNG Specification 1.4; what it leaves open, from Adobe's DNG SDK 1.4):

* ColorMatrix1 takes XYZ under D65 to the camera's native numbers: diag(1/red, 1, 1/blue) · rgb2cam · rgb2xyz⁻¹. A row
  of rgb2cam sums to 1, so D65 becomes (1/red, 1, 1/blue), and that is AsShotNeutral: a reader that estimates the white
  point from the two finds xy (0.3127, 0.3290). `rational` says how far a fraction is from its number.
* BaselineExposure is what to brighten by, in stops. A reader scales a neutral so that white is reached where the first
  channel saturates (dng_color_spec::SetWhiteXY; LibRaw too), so it shows the scene times the largest of the inverse
  gains, over the exposure ratio. The tag undoes it: log2(exposure_ratio / largest), above 0 where the photograph was
  darkened. LibRaw and dcraw leave it to their callers; LibRaw also takes the brightest DN for white where it lies above
  three quarters of it, unless told adjust_maximum_thr=0.
* NoiseProfile: variance = S·x + O with x 0 at black and 1 at white, so S = a_dn / span and O = b_dn2 / span², of those
  of shot and read noise that were simulated. It has no place for rows, columns, dark current and unequal responses, and
  rounding adds 1/12 DN². Readers take no S of 0 or below and no O below 0 (dng_noise_function::IsValid), so the clean
  frame has none, nor has a noisy one whose law is not of that kind.
* BlackLevel is what the camera believes, the same at all four sites: an error of the black level is one because no
  camera knows it.

No tag says how highlights were kept: above the row's threshold a reader shows them brighter than the photograph,
channel by channel, so that bright colours shift too; white stays white. WhiteLevel is the sensor's, also where a full
well saturates below it.

The row stands as JSON in the XMP packet (properties Frame and Row of ``urn:unprocess-gen:manifest#``), which converters
keep and show to nobody as a caption. No clock is in a file: the same row and frame are the same bytes.

Not written: 12 bits packed, which some readers misread at odd widths; compression, of which LibRaw reads little for
integers; floats, which it rounds.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np

from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import array_xxh3, commit_file, machine_error
from unprocess_gen.core.types import UINT16, Float, Frame, Plan, Row
from unprocess_gen.dataset.manifest import plan_from_row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.simulation.reference.cfa import CHANNELS
from unprocess_gen.simulation.reference.colour import RGB2XYZ, Matrix, invert, matrix, multiply

FRAMES = ("clean", "noisy")

LEAST_SIDE_PX, GREATEST_SIDE_PX = 22, 64000
"""LibRaw calls a picture with a side beyond these no raw file (identify.cpp; 0.22.2 tried at 21, 22, 64000, 64001)."""

MOST_PIXELS = 2**31 - 2**20
"""TIFF places its data by 32-bit offsets: 4 GB, less the tags."""

MAKE = "unprocess_gen"
D65 = 21
"""CalibrationIlluminant1, an EXIF LightSource."""


class Exported(NamedTuple):
    """How many files were written, how many stood there with just those bytes, and noisy ones without NoiseProfile."""

    written: int
    present: int
    without_profile: int


class _File(NamedTuple):
    """A file to be: the number of its pair in the dataset, the pair's key, and which frame of it."""

    number: int
    key: str
    frame: str

    @property
    def name(self) -> str:
        return f"{self.key}.{self.frame}.dng"


def export(folder: Path, keys: str, frames: Sequence[str], to: Path) -> Exported:
    """Write frames (of `FRAMES`) of a dataset's pairs as ``to/KEY.FRAME.dng``.

    ``keys`` is K,… as `verify.choose` reads it. A file that is there already stays if its bytes are those that would be
    written. Raises ConfigError, with nothing written, where it is another file, and for keys that the dataset does not
    have or that failed, sizes that cannot be read back, frames that are no uint16 mosaic, a folder that cannot be
    written and want of tifffile; DamageError where a frame is not its row's; MachineError where writing fails.
    """
    if find_spec("tifffile") is None:
        raise ConfigError("dng: writing needs tifffile; pip install 'unprocess_gen[dng]'")
    if to.resolve() in (folder.resolve(), (folder / "shards").resolve()):
        raise ConfigError(f"--to {to}: is the dataset's own folder, where foreign files would be damage")
    numbers = _numbers(folder / "manifest.csv", keys)
    files = [_File(number, key, frame) for key, number in numbers.items() for frame in frames]
    pairs = RawPairs(folder)
    present = [file for file in files if (to / file.name).exists()]
    for file in present:
        if (to / file.name).read_bytes() != _content(pairs, file):
            raise ConfigError(f"--to {to}: {file.name} is there and is another file; choose another folder")
    written = [file for file in files if file not in present]
    for file in written:
        _write(to / file.name, _content(pairs, file))
    without = sum(
        file.frame == "noisy" and noise_profile(plan_from_row(pairs[file.number].row)) is None for file in files
    )
    return Exported(len(written), len(present), without)


def _numbers(manifest: Path, keys: str) -> dict[str, int]:
    """Return the key and the number of every selected pair; ConfigError if a frame of one cannot be a DNG file."""
    return {str(_writable(row)["key"]): number for number, row in select_pairs(manifest, keys).rows.items()}


def _writable(row: Row) -> Row:
    """Return a row whose frames can be DNG files; ConfigError says why others cannot."""
    key, width, height = row["key"], int(row["width"] or 0), int(row["height"] or 0)
    if row["dtype"] != UINT16:
        raise ConfigError(
            f"--keys {key}: is of {row['dtype']} numbers, which LibRaw would round; a DNG needs output.dtype={UINT16}"
        )
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
    return row


def _content(pairs: RawPairs, file: _File) -> bytes:
    sample = pairs[file.number]
    frame = sample.clean if file.frame == "clean" else sample.noisy
    content = encode(mosaic_dn(frame, sample.row), sample.row, file.frame)
    if array_xxh3(frame) != sample.row[f"{file.frame}_xxh3"]:
        raise DamageError(f"{pairs.path}: the {file.frame} frame of {file.key} is not the one its row tells of")
    return content


def _write(path: Path, content: bytes) -> None:
    """Write aside, then put in place, so that no moment shows half a file."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--to {path.parent}: cannot be written ({error.strerror})") from error
    aside = path.with_name(f".{path.name}.part")
    try:
        aside.write_bytes(content)
        commit_file(aside, path)
    except PermissionError as error:
        raise ConfigError(f"--to {path.parent}: cannot be written ({error.strerror})") from error
    except OSError as error:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise machine_error(error, path) from error


# --------------------------------------------------------------------------------------------------------- one file


class Tag(NamedTuple):
    """One entry of the file's directory: code, type, how many values it has (0: those of the text), the values."""

    code: int
    type: int
    length: int
    value: str | bytes | int | tuple[int, ...] | tuple[float, ...]
    once: bool = True


BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 10, 12
"""Types of TIFF 6.0, section 2."""


def encode(frame: Frame | Float, row: Row, name: str) -> bytes:
    """Return the file of a frame of the pair that ``row`` tells of; ``name`` is ``clean`` or ``noisy``.

    Raises ConfigError where the frame is not a uint16 mosaic ``[H, W]``, or the row has a number beyond 2^30.
    """
    import tifffile

    if frame.dtype != np.uint16 or frame.ndim != 2:
        found = f"{frame.dtype} {list(frame.shape)}"
        raise ConfigError(f"--keys {row['key']}: its {name} frame is {found}; a DNG is made of uint16 mosaics [H, W]")
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
        description=f"{name} frame of {row['key']}; its manifest row is in the XMP packet",
        extratags=tags(row, name, (frame.shape[0], frame.shape[1])),
    )
    return file.getvalue()


def tags(row: Row, name: str, shape: tuple[int, int]) -> list[Tag]:
    """Return what a file says of its frame besides TIFF's own tags, by rising code; ``shape`` is height, width."""
    plan, packet, (height, width) = plan_from_row(row), xmp(row, name), shape
    profile = noise_profile(plan) if name == "noisy" else None
    return [
        Tag(271, ASCII, 0, MAKE),  # Make
        Tag(272, ASCII, 0, plan.camera),  # Model
        Tag(274, SHORT, 1, 1),  # Orientation: frames are upright
        Tag(700, BYTE, len(packet), packet),  # XMP
        Tag(33421, SHORT, 2, (2, 2)),  # CFARepeatPatternDim
        Tag(33422, BYTE, 4, bytes(CHANNELS.index(letter) for letter in plan.pattern)),  # CFAPattern
        Tag(50706, BYTE, 4, bytes((1, 4, 0, 0))),  # DNGVersion
        Tag(50707, BYTE, 4, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        Tag(50708, ASCII, 0, f"{MAKE} {plan.camera}"),  # UniqueCameraModel
        Tag(50710, BYTE, 3, bytes((0, 1, 2))),  # CFAPlaneColor: red, green, blue
        Tag(50711, SHORT, 1, 1),  # CFALayout: rectangular
        Tag(50713, SHORT, 2, (2, 2)),  # BlackLevelRepeatDim
        Tag(50714, LONG, 4, (plan.black_level_dn,) * 4),  # BlackLevel
        Tag(50717, LONG, 1, plan.white_level_dn),  # WhiteLevel
        Tag(50719, LONG, 2, (0, 0)),  # DefaultCropOrigin
        Tag(50720, LONG, 2, (width, height)),  # DefaultCropSize
        Tag(50721, SRATIONAL, 9, _rationals(color_matrix(plan))),  # ColorMatrix1
        Tag(50728, RATIONAL, 3, _rationals(as_shot_neutral(plan))),  # AsShotNeutral
        Tag(50730, SRATIONAL, 1, rational(baseline_exposure_ev(plan))),  # BaselineExposure
        Tag(50778, SHORT, 1, D65),  # CalibrationIlluminant1
        Tag(50829, LONG, 4, (0, 0, height, width)),  # ActiveArea
        *([Tag(51041, DOUBLE, 6, profile * 3)] if profile else []),  # NoiseProfile: the same for the three planes
    ]


def color_matrix(plan: Plan) -> Matrix:
    """Return the matrix from XYZ under D65 to the camera's native numbers, row by row, with the row's gains."""
    native = matrix([as_shot_neutral(plan)[i // 3] * entry for i, entry in enumerate(plan.rgb2cam)])
    return multiply(native, invert(RGB2XYZ))


def as_shot_neutral(plan: Plan) -> tuple[float, float, float]:
    """Return what a neutral is in native numbers, relative to green."""
    return 1 / plan.red_gain, 1.0, 1 / plan.blue_gain


def baseline_exposure_ev(plan: Plan) -> float:
    """Return the stops by which a reader has to brighten to show the photograph as bright as it was."""
    return -math.log2(plan.exposure * max(plan.inverse_gains))


def noise_profile(plan: Plan) -> tuple[float, float] | None:
    """Return S and O of variance = S·x + O, x 0 at black and 1 at white; None where they are not of the tag's kind."""
    span_dn = plan.white_level_dn - plan.black_level_dn
    slope_dn, intercept_dn2 = plan.variance_line
    scale, offset = slope_dn / span_dn, intercept_dn2 / span_dn**2
    return (scale, offset) if scale > 0 and offset >= 0 else None


def rational(value: float) -> tuple[int, int]:
    """Return numerator and denominator (a power of two) of the nearest fraction that 32 signed bits hold.

    Off by at most 2^-31, and above 1 by at most 2^-30 of the value. Raises ConfigError from 2^30 on.
    """
    bits = 30 - max(math.frexp(value)[1], 0)
    if bits < 0:
        raise ConfigError(f"a colour number of the row, {value:g}, is too large for a DNG, which ends at 2^30")
    return round(math.ldexp(value, bits)), 1 << bits


def _rationals(values: Iterable[float]) -> tuple[int, ...]:
    return tuple(part for value in values for part in rational(value))


def xmp(row: Row, name: str) -> bytes:
    """Return the XMP packet (ISO 16684-1) that holds the row as JSON, and says which frame this is."""
    text = escape(json.dumps(dict(row), separators=(",", ":")))
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '<rdf:Description rdf:about="" xmlns:unprocess="urn:unprocess-gen:manifest#">\n'
        f"<unprocess:Frame>{name}</unprocess:Frame>\n"
        f"<unprocess:Row>{text}</unprocess:Row>\n"
        "</rdf:Description>\n</rdf:RDF>\n</x:xmpmeta>\n"
        '<?xpacket end="w"?>'
    ).encode()
