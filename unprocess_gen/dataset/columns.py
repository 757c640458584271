"""Define the columns of a manifest: names, types, allowed values and the fields that they hold.

`COLUMNS` is the only table. A column with ``of=NoisePlan`` holds a field of `NoisePlan` in the type and spelling given
here.
`manifest.pair_row` writes rows by this table, and `manifest.plan_from_row` reads plans by it. A new parameter is a new
field of its dataclass and one line below.

Allowed values are wider than those that a configuration can lead to. They keep edited files from causing huge
allocations, overflow and endless loops.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.core.types import (
    FLOAT32,
    MOSAIC,
    PACKED,
    TIERS,
    UINT16,
    CameraPlan,
    Counts,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    OutputPlan,
    Patch,
    Plan,
    ScenePlan,
    SensorPlan,
    Source,
    SourcePlan,
    Value,
    gamma_text,
)
from unprocess_gen.simulation.effects import NUMBERS, RECORDED_NUMBERS, Physics

MAX_PATH = 2**15
"""Characters of the percent-encoded path of a source."""

FIRST = "0.1"
"""The version of the first manifests. Every manifest has the columns of this version."""


def number_or_text(cell: str) -> str | int | float:
    """Return the number that a cell holds, or its text."""
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


class Range(NamedTuple):
    """Hold the least and greatest number that a column allows, and words instead; NaN is in no range."""

    low: float
    high: float
    words: tuple[str, ...] = ()
    type: Callable[[str], str | int | float] = float

    def __contains__(self, value: object) -> bool:
        if isinstance(value, str):
            return value in self.words
        kinds = int if self.type is int else int | float
        return isinstance(value, kinds) and not isinstance(value, bool) and self.low <= value <= self.high

    def __str__(self) -> str:
        return " or ".join([f"a number from {self.low:.12g} to {self.high:.12g}", *self.words])


def integers(low: int, high: int) -> Range:
    """Range of integers."""
    return Range(low, high, type=int)


class OneOf(tuple[str, ...]):
    """Hold the words that a column allows."""

    __slots__ = ()
    type = str

    def __str__(self) -> str:
        return " or ".join(filter(None, self))


class Text(NamedTuple):
    """Hold the regular expression that a column's text matches, and its description."""

    pattern: re.Pattern[str]
    description: str
    type: Callable[[str], str] = str

    def __contains__(self, value: object) -> bool:
        return isinstance(value, str) and self.pattern.fullmatch(value) is not None

    def __str__(self) -> str:
        return self.description


class RelativePath:
    """Allow the percent-encoded path of a file below the source folder, so that nothing outside it is looked up."""

    type = str

    def __contains__(self, value: object) -> bool:
        if not isinstance(value, str) or value not in ANY_TEXT or not 0 < len(value) <= MAX_PATH:
            return False
        path = _PERCENT.sub(lambda match: chr(int(match[1], 16)), value)
        return not path.startswith("/") and ".." not in path.split("/") and "\0" not in path

    def __str__(self) -> str:
        return "a path below the source folder, relative and without .. segments"


_PERCENT = re.compile("%([0-9A-F]{2})")

Allowed = Range | OneOf | Text | RelativePath
RecordType = type[Any]
"""Dataclass of `core.types`: a plan or a part of it, `Physics`, `Patch`, `Counts` or `Source`."""


class Spelling(NamedTuple):
    """Hold how a field's value becomes the value of a column, and back."""

    write: Callable[[Any], Value]
    read: Callable[[Any], Any]


TYPE_NAMES: Mapping[Any, str] = {int: "integer", float: "number", str: "text", number_or_text: "number or text"}

FAILED = "the source failed"
"""Condition under which the cells of most columns are empty."""

NO_FRAMES = "the source failed, or output.frames is false"

NO_DARK_FRAME = "there is no dark frame"

NO_RAW = "the source is not raw, or it failed"


HEXADECIMAL = Spelling("{:016x}".format, lambda text: int(text, 16))
LIST = Spelling(";".join, lambda text: tuple(text.split(";")) if text else ())
FLAG = Spelling(int, bool)
LEVEL_LIST = Spelling(lambda levels: ";".join(map(repr, levels)), lambda text: tuple(map(float, text.split(";"))))
GAMMA_SPELLING = Spelling(
    lambda gamma: number_or_text(gamma_text(gamma)), lambda value: value if value == "srgb" else float(value)
)

FINITE = Range(-1.7976931348623157e308, 1.7976931348623157e308)
NOT_NEGATIVE = Range(0, FINITE.high)
COUNT = integers(0, 2**63 - 1)
SHARE = Range(0, 1)
COORDINATE = integers(0, 2**32 - 1)
"""Pixel coordinates and frame numbers are 32-bit counters of the random streams."""
SIDE = integers(1, 2**32)
MATRIX_ENTRY = Range(-1e10, 1e10)
GAINS = Range(1e-4, 1e4)
ANY_TEXT = Text(re.compile("[^\x00-\x1f\x7f\ud800-\udfff]*"), "text without control characters")
KEY_TEXT = Text(re.compile(r"\d{8,12}(-p\d{4,12})?(-l\d\dd\d\d)?"), "eight digits, then -pNNNN and -lNNdNN if present")
HEX_64 = Text(re.compile(r"([0-9a-f]{16})?|none"), "16 hexadecimal digits")
HEX_128 = Text(re.compile(r"([0-9a-f]{32})?"), "32 hexadecimal digits")
HEX_256 = Text(re.compile(r"([0-9a-f]{64})?"), "64 hexadecimal digits")


_LEVEL = r"\d{1,5}(\.\d{1,17})?(e-\d\d)?"
LEVELS_TEXT = Text(re.compile(rf"({_LEVEL}(;{_LEVEL}){{3}})?"), "four numbers, separated by ;")


@dataclass(frozen=True, slots=True)
class Column:
    """Describe one column.

    Attributes
    ----------
    name : str
        Name in the header of ``manifest.csv`` and in ``KEY.json``.
    meaning : str
        One phrase for users.
    allowed : Range, OneOf, Text or RelativePath
        Values other than the empty cell, and their type.
    of : type, optional
        Dataclass whose field the column holds.
    field : str
        Name of that field; empty if it is the name of the column. Columns that share a field hold its items in order.
    spelling : Spelling, optional
        Conversion between field and value; None if both are the same.
    since : str
        First version of unprocess_gen that writes the column. Older manifests do not have it; it then reads as empty.
    in_json : bool
        Whether ``KEY.json`` has the column.
    unit : str
        Unit of a number; empty for text and pure numbers.
    empty_if : str
        Condition under which the cell is empty; ``""`` if it never is.
    """

    name: str
    meaning: str
    allowed: Allowed
    of: RecordType | None = None
    field: str = ""
    spelling: Spelling | None = None
    since: str = FIRST
    in_json: bool = True
    unit: str = ""
    empty_if: str = FAILED

    @property
    def type(self) -> Callable[[str], str | int | float]:
        """Function that converts the text of a cell: `int`, `float`, `str` or `number_or_text`."""
        return self.allowed.type

    @property
    def type_name(self) -> str:
        """Name of the type for users."""
        return TYPE_NAMES[self.type]

    @property
    def empty(self) -> Value:
        """Value of an empty cell, and of a column that a manifest does not have."""
        return "" if self.type is str else None

    @property
    def not_applicable(self) -> Value:
        """Return the value for pairs to which the column does not apply: ``none`` or 0, empty in later columns."""
        if self.since != FIRST:
            return self.empty
        return "none" if self.type is str else self.type("0")

    def parse(self, cell: str) -> Value:
        """Return the value of a cell; ValueError for another type, and for a value that is not allowed."""
        if not cell:
            return self.empty
        try:
            value = self.type(cell)
        except ValueError:
            raise ValueError(f"{self.name}={cell[:40]!r}: expected {self.allowed}") from None
        self.check(value)
        return value

    def check(self, value: Value) -> None:
        """Raise ValueError if the column does not allow a value."""
        if value not in self.allowed:
            raise ValueError(f"{self.name}={_short(value)}: expected {self.allowed}")

    def from_field(self, value: Any) -> Value:
        """Return the value of the column for a value of its field."""
        return self.spelling.write(value) if self.spelling else value

    def to_field(self, row: Mapping[str, Value]) -> Any:
        """Return the value of the field for a row; ValueError if the row's value is missing or not allowed."""
        value = row.get(self.name)
        if value is None or (value == "" and self.spelling is not LIST):
            raise ValueError(f"{self.name} is empty")
        self.check(value)
        return (self.spelling.read if self.spelling else self.type)(value)  # type: ignore[arg-type]


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value) if isinstance(value, int | float) else type(value).__name__
    return repr(text[:40]) if isinstance(value, str) else text[:40]


def _columns_of_numbers(*names: str) -> Iterator[Column]:
    """Yield the columns of numbers of effects, by the fields of `Physics`."""
    for field_name in names:
        number = NUMBERS[field_name]
        allowed = OneOf((*number.words, "none")) if number.words else Range(number.lowest, number.highest)
        since, empty_if = number.since or FIRST, number.empty_if if number.since else FAILED
        for name, meaning in (number.columns or {field_name: number.meaning}).items():
            yield Column(name, meaning, allowed, Physics, field_name, unit=number.unit, since=since, empty_if=empty_if)


COLUMNS = (
    Column("key", "source index as eight digits, then number of patch, level and draw if there are several", KEY_TEXT,
           empty_if=""),
    Column("source", "path below the source folder, percent-encoded where unsafe", RelativePath(), Source, "name",
           empty_if=""),
    Column("source_sha256", "SHA-256 of the source's bytes", HEX_256, empty_if="the source cannot be read"),
    Column("source_bytes", "size of the source; 0 for a built-in scene", COUNT, Source, "size_bytes", unit="bytes",
           empty_if="there is no readable file"),
    Column("status", "ok, failed if the source could not be used, or filtered if source.min_side leaves it out (other "
           "cells are then as for failed)",
           OneOf(("ok", "failed", "filtered")), empty_if=""),
    Column("reason", "reason of the status", Text(re.compile("[a-z0-9_]*"), "a reason such as corrupt"),
           empty_if="the status is ok"),
    Column("width", "width of the frame; packed planes have half of it", SIDE, Patch, unit="pixels"),
    Column("height", "height of the frame; packed planes have half of it", SIDE, Patch, unit="pixels"),
    Column("orientation", "EXIF orientation that was applied to the source, 1 to 8", integers(1, 8)),
    Column("shard", "number of the shard", integers(0, 10**9), empty_if=""),
    Column("seed", "seed of the run", COUNT, Plan, empty_if=""),
    Column("stream_key", "key of the image's random streams, 16 hex digits", HEX_64, Plan, spelling=HEXADECIMAL),
    Column("camera", "convex, or the name of the camera", ANY_TEXT, CameraPlan, "name"),
    *(
        Column(f"w_{camera}", "weight of this camera in the mix; 0 if it is not part of it", SHARE, CameraPlan,
               "weights")
        for camera in ("nexus_6p", "sony_a7r", "olympus_em10", "sony_rx100")
    ),
    *(
        Column(f"rgb2cam_{i}{j}", f"matrix from linear sRGB to the camera, row {i}, column {j}", MATRIX_ENTRY,
               CameraPlan, "rgb2cam")
        for i in range(3) for j in range(3)
    ),
    Column("red_gain", "forward white-balance gain of red", GAINS, CameraPlan),
    Column("blue_gain", "forward white-balance gain of blue", GAINS, CameraPlan),
    Column("inverse_rgb_gain", "inverse of the brightening gain; all channels are multiplied by it", GAINS, CameraPlan),
    Column("tone", "inverted tone curve: smoothstep or none", OneOf(("smoothstep", "none")), IspPlan),
    Column("gamma", "inverted gamma: a number or srgb", Range(0.1, 10, ("srgb",), number_or_text), IspPlan,
           spelling=GAMMA_SPELLING),
    Column("highlight", "preservation of highlights: per_channel, gray_mean or none",
           OneOf(("per_channel", "gray_mean", "none")), CameraPlan),
    Column("highlight_threshold", "linear signal above which highlights are preserved, 1 is white",
           Range(0, math.nextafter(1, 0)), CameraPlan),
    Column("pattern", "CFA pattern of the top-left 2x2 sites, or MONO",
           OneOf(("RGGB", "BGGR", "GRBG", "GBRG", "MONO")), SensorPlan),
    Column("bits", "bits per sample of the sensor", integers(1, 16), SensorPlan),
    Column("black_level_dn", "black level", integers(0, 65534), SensorPlan, unit="DN"),
    Column("white_level_dn", "white level (saturation)", integers(1, 65535), SensorPlan, unit="DN"),
    Column("sensor_clip", "clipping of the noisy frame: sensor, black or none", OneOf(("sensor", "black", "none")),
           NoisePlan),
    Column("noise", "name of the noise profile", ANY_TEXT, NoisePlan, "name"),
    Column("a_dn", "slope of the noise variance, which is a_dn (x - black) + dark_variance_dn2", Range(-1e30, 1e30),
           NoisePlan, unit="DN"),
    Column("b_dn2", "noise variance at black of two-parameter noise, or of read noise; see dark_variance_dn2", FINITE,
           NoisePlan, unit="DN²"),
    Column("effects", "simulated effects, in order, separated by ;", ANY_TEXT, NoisePlan, spelling=LIST,
           empty_if="no effect was simulated, or the source failed"),
    Column("skipped", "skipped effects, each with its reason, separated by ;", ANY_TEXT, NoisePlan, spelling=LIST,
           empty_if="no effect was skipped, or the source failed"),
    Column("accuracy", "accuracy tier", OneOf(TIERS), Plan),
    Column("clean_xxh3", "XXH3-128 of the clean array's little-endian bytes", HEX_128, empty_if=NO_FRAMES),
    Column("noisy_xxh3", "XXH3-128 of the noisy array's little-endian bytes", HEX_128, empty_if=NO_FRAMES),
    *(
        Column(name, meaning, COUNT, Counts, unit="sites", empty_if=NO_FRAMES)
        for name, meaning in (
            ("clean_clipped_low", "clean sites below black before clipping"),
            ("clean_clipped_high", "clean sites above white before clipping"),
            ("noisy_clipped_low", "noisy sites below the lowest DN before clipping"),
            ("noisy_clipped_high", "noisy sites above the highest DN before clipping"),
            ("saturated", "clean sites at the white level"),
            ("zero_variance", "sites at which the noise has no variance"),
        )
    ),
    Column("scene", "name of the scene", ANY_TEXT, ScenePlan, "name"),
    Column("exposure_ratio", "divisor of the light in the photograph", Range(1e-4, 1e7), ScenePlan),
    Column("saturated_as", "noisy sites whose clean site is saturated: noisy, or white where the converter ends",
           OneOf(("noisy", "white")), NoisePlan, "saturated"),
    Column("noise_law", "distribution of a two-parameter profile: gaussian or poisson", OneOf(("gaussian", "poisson")),
           NoisePlan, "law"),
    Column("iso", "ISO of a physical profile", Range(0, 1e9), Physics),
    Column("exposure_s", "exposure time", Range(0, 1e7), Physics, unit="seconds"),
    Column("temperature_c", "temperature of the sensor", Range(-300, 1000), Physics, unit="degrees Celsius"),
    *_columns_of_numbers(*RECORDED_NUMBERS[0]),
    Column("dark_offset", "mean dark current: removed or kept", OneOf(("removed", "kept", "none")), Physics),
    *_columns_of_numbers(*RECORDED_NUMBERS[1]),
    Column("sensor_unit", "camera body", ANY_TEXT, Physics),
    Column("body_key", "key of the fixed patterns, 16 hex digits", HEX_64, Physics, spelling=HEXADECIMAL),
    Column("fixed_pattern_in_clean", "1 if the clean frame has the fixed patterns too", integers(0, 1), Physics,
           spelling=FLAG),
    Column("level", "number of the noise level, from 0", integers(0, 99), NoisePlan),
    Column("draw", "number of the draw at this level, from 0", integers(0, 99), NoisePlan),
    Column("frame", "number of the frame in its clip, from 0", COORDINATE, NoisePlan),
    Column("clip", "name of the clip; none for single photographs", ANY_TEXT, Source),
    Column("downscale", "side of the squares of source pixels that were averaged", integers(1, 64), SourcePlan,
           unit="pixels"),
    Column("dequantize", "dequantization of 8-bit codes: off, dither or dither_all",
           OneOf(("off", "dither", "dither_all")), SourcePlan),
    Column("patch", "number of the patch in its image; 0 for a complete image too", COORDINATE, Patch, "number"),
    Column("patch_y", "first row of the arrays in the full frame; even", COORDINATE, Patch, "y", unit="pixels"),
    Column("patch_x", "first column of the arrays in the full frame; even", COORDINATE, Patch, "x", unit="pixels"),
    Column("dtype", "dtype of the arrays: uint16 (DN), or float32 (0 at black, 1 at white)", OneOf((UINT16, FLOAT32)),
           OutputPlan),
    Column("layout", "layout of the arrays: mosaic, or packed planes", OneOf((MOSAIC, PACKED)), OutputPlan),
    Column("detail", "explanation of the reason, one line", ANY_TEXT, since="0.2", in_json=False,
           empty_if="the status is ok"),
    Column("assumed", "assumed numbers of the profile that the simulated effects use, separated by ;", ANY_TEXT,
           NoisePlan, spelling=LIST, since="0.2", empty_if="no effect uses one"),
    Column("clean_dtype", "dtype of the clean array, if it is not that of dtype", OneOf((FLOAT32,)), OutputPlan,
           since="0.2", empty_if="the clean array has the dtype of the noisy one, or the source failed"),
    *_columns_of_numbers(*RECORDED_NUMBERS[2]),
    *(
        Column(f"frame_{side}", f"{side} of the full frame, to which the lens shading belongs", COORDINATE, Physics,
               "frame_size", unit="pixels", since="0.2", empty_if="there is no lens shading")
        for side in ("height", "width")
    ),
    Column("source_noise_dn", "estimated noise of the source itself, in the green plane of the clean frame",
           NOT_NEGATIVE, unit="DN", since="0.2", in_json=False,
           empty_if="the source failed, is a built-in scene or an array, or no tile of 32 x 32 pixels is free of "
           "clipping"),
    Column("dark_frame", "SHA-256 of the dark frame from which the noise of the read-out is sampled", HEX_256,
           DarkFramePlan, "sha256", since="0.2", empty_if=NO_DARK_FRAME),
    *(
        Column(f"dark_frame_{axis}", f"first {side} of the dark frame that the full frame uses; even", COORDINATE,
               DarkFramePlan, "shift", unit="pixels", since="0.2", empty_if="there is no dark frame, or both are 0")
        for axis, side in (("y", "row"), ("x", "column"))
    ),
    Column("dark_black_dn", "black level of the dark frame", Range(0, 65535), DarkFramePlan, "black_dn",
           unit="DN of the dark frame", since="0.2",
           empty_if="there is no dark frame, or it is 0"),
    Column("dark_scale", "DN of the sensor per DN of the dark frame", Range(1e-9, 1e9), DarkFramePlan,
           "scale", since="0.2", empty_if="there is no dark frame, or it is 1"),
    Column("dark_variance_dn2", "noise variance of a site at black, by all simulated effects except hot pixels, dead "
           "pixels and rounding; ug.noise_std uses it",
           FINITE, unit="DN²", since="0.3", in_json=False, empty_if="the source failed"),
    Column("light_clipped_high", "sites whose light is above white before the exposure ratio divides it", COUNT, Counts,
           unit="sites", since="0.3", in_json=False, empty_if="exposure_ratio is 1, or output.frames is false"),
    *_columns_of_numbers(*(name for name, number in NUMBERS.items() if number.since not in ("", "0.2"))),
    Column("split", "part of the dataset that the image belongs to",
           Text(re.compile(r"[\w-]{1,32}", re.ASCII), "up to 32 letters, digits, _ and -"), Plan, since="0.3",
           empty_if="there are no splits, or the source failed"),
    Column("targets", f"the stored target with dtype and XXH3-128: {LINEAR_RGB}:float32:…",
           Text(re.compile(f"({LINEAR_RGB}:float32:[0-9a-f]{{32}})?"), "name:dtype:digest of a target"), since="0.3",
           empty_if="output.targets is empty, output.frames is false, or the source failed"),
    Column("light", "light from which the white-balance gains follow", ANY_TEXT, CameraPlan, since="0.3", in_json=False,
           empty_if="the gains follow from no light (gains.light=null), or the source failed"),
    Column("cct_k", "correlated colour temperature of the light", Range(1000, 25000), CameraPlan, unit="K", since="0.3",
           in_json=False, empty_if="the gains follow from no light (gains.light=null), or the source failed"),
    Column("shrink", "of a raw source, side of the cells whose sites of one colour were averaged; 1: the mosaic itself",
           integers(1, 2), SourcePlan, since="0.3", empty_if=NO_RAW),
    Column("raw_pattern", "CFA pattern of the raw file", OneOf(("RGGB", "BGGR", "GRBG", "GBRG")), SourcePlan,
           since="0.3", empty_if=NO_RAW),
    *(
        Column(f"raw_{level}_dn", f"{level} levels of the raw file: R, G of the red rows, G of the blue rows, B, "
               "separated by ;",
               LEVELS_TEXT, SourcePlan, spelling=LEVEL_LIST, since="0.3", unit="DN of the file", empty_if=NO_RAW)
        for level in ("black", "white")
    ),
    Column("mosaic_xxh3", "XXH3-128 of the mosaic that the raw file was decoded to", HEX_128, SourcePlan, since="0.3",
           empty_if=NO_RAW),
    Column("source_iso", "ISO of the raw file", Range(0, 1e9), SourcePlan, since="0.3",
           empty_if="the file states none, or the source is not raw"),
    Column("source_exposure_s", "exposure time of the raw file", Range(0, 1e7), SourcePlan, since="0.3", unit="seconds",
           empty_if="the file states none, or the source is not raw"),
    Column("own_a_dn", "noise of the raw source itself in the clean frame, whose variance is own_a_dn (x - black) + "
           "own_b_dn2",
           NOT_NEGATIVE, SourcePlan, since="0.3", unit="DN", empty_if="it is not stated, or the source is not raw"),
    Column("own_b_dn2", "variance at black of the raw source itself in the clean frame", NOT_NEGATIVE, SourcePlan,
           since="0.3", unit="DN²", empty_if="it is not stated, or the source is not raw"),
)  # fmt: skip
"""All columns, in the order of ``manifest.csv``. New columns are appended."""

COLUMN_NAMES = tuple(column.name for column in COLUMNS)

HEADERS = tuple(
    COLUMN_NAMES[: max(place for place, column in enumerate(COLUMNS) if column.since == version) + 1]
    for version in dict.fromkeys(column.since for column in COLUMNS)
)
"""The header that each version wrote, oldest version first; new columns are appended, so each begins with the last."""


COLUMNS_OF: dict[RecordType, dict[str, tuple[Column, ...]]] = {}
"""Columns that hold a record, by field: one for a scalar field, several for a tuple."""

for _column in COLUMNS:
    if _column.of is not None:
        _fields = COLUMNS_OF.setdefault(_column.of, {})
        _fields[_column.field or _column.name] = (*_fields.get(_column.field or _column.name, ()), _column)
