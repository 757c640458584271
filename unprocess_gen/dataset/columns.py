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
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.core.arrays import FLOAT32, MOSAIC, PACKED, UINT16
from unprocess_gen.core.source import Source
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.row import Value
from unprocess_gen.simulation.frames import Counts, Patch
from unprocess_gen.simulation.plan import (
    NUMBERS,
    TIERS,
    CameraPlan,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    OutputPlan,
    Physics,
    Place,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)
from unprocess_gen.simulation.tone_curves import gamma_text

if TYPE_CHECKING:
    from unprocess_gen.config.schema import Config

MAX_PATH = 2**15
"""Characters of the percent-encoded path of a source."""


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
"""A plan or a part of it, `Patch`, `Counts` or `Source`."""


class Spelling(NamedTuple):
    """Hold how a field's value becomes the value of a column, and back."""

    write: Callable[[Any], Value]
    read: Callable[[Any], Any]


TYPE_NAMES: Mapping[Any, str] = {int: "integer", float: "number", str: "text", number_or_text: "number or text"}

FAILED = "the source failed"
"""Condition under which the cells of most columns are empty."""


class Condition(NamedTuple):
    """Settings that columns depend on.

    Attributes
    ----------
    unless : str
        Settings with which manifests do not have the columns.
    holds : callable
        Whether a config fills the columns.
    by_default : bool
        Whether cells are empty at the default of their field.
    """

    unless: str
    holds: Callable[[Config], bool]
    by_default: bool = False


def _noisy_frames(config: Config) -> int:
    """Return the number of noisy frames of each clean frame."""
    levels = config.noise.levels
    return int(config.noise.draws * (1 if levels is None else levels if isinstance(levels, int) else len(levels)))


ALWAYS = Condition("", lambda config: True)
FRAMES = Condition("output.frames is false", lambda config: config.output.frames)
DIVIDED_LIGHT = Condition(
    "scene.exposure_ratio is 1 or output.frames is false",
    lambda config: config.output.frames and config.scene.exposure_ratio != 1,
)
FOUND_FILES = Condition("the sources are synthetic pictures", lambda config: config.source.place is not None)
RAW = Condition("source.kind is not raw", lambda config: config.source.kind == "raw", by_default=True)
CLIPS = Condition("source.clips is false", lambda config: config.source.clips)
PATCHES = Condition("source.patch is null", lambda config: config.source.patch is not None)
LEVELS = Condition("each image has one noisy frame", lambda config: _noisy_frames(config) > 1)
SPLITS = Condition("split is null", lambda config: config.split is not None, by_default=True)
LIGHTS = Condition("gains.light is null", lambda config: config.gains.light is not None, by_default=True)
PHYSICAL = Condition("the noise profile is not physical", lambda config: bool(config.noise.branches))
SHADING = Condition(
    "the noise profile has no lens_shading", lambda config: config.noise.lens_shading is not None, by_default=True
)
DARK_FRAMES = Condition(
    "noise.dark_frames is null",
    lambda config: config.noise.dark_frames is not None or config.noise.dark_frames_sha256 is not None,
)
FLOAT_CLEAN = Condition(
    "clean and noisy frames have one dtype", lambda config: config.output.clean_dtype == FLOAT32 != config.output.dtype
)
STORED_TARGETS = Condition("output.targets is empty", lambda config: bool(config.output.targets))

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
    unit : str
        Unit of a number; empty for text and pure numbers.
    empty_if : str
        When the cell is empty; ``""`` if it never is.
    needs : Condition
        Settings without which all cells are empty; manifests with other settings do not have the column.
    """

    name: str
    meaning: str
    allowed: Allowed
    of: RecordType | None = None
    field: str = ""
    spelling: Spelling | None = None
    unit: str = ""
    empty_if: str = FAILED
    needs: Condition = ALWAYS

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
        if value in (None, ""):
            if self.spelling is not LIST:
                raise ValueError(f"{self.name} is empty")
            value = ""
        self.check(value)
        return (self.spelling.read if self.spelling else self.type)(value)  # type: ignore[arg-type]


def _short(value: object) -> str:
    text = value if isinstance(value, str) else repr(value) if isinstance(value, int | float) else type(value).__name__
    return repr(text[:40]) if isinstance(value, str) else text[:40]


def _columns_of_numbers() -> Iterator[Column]:
    """Yield the columns of the numbers of effects, by the fields of `Physics`."""
    for field_name, number in NUMBERS.items():
        allowed = OneOf(number.words) if number.words else Range(number.lowest, number.highest)
        for name, meaning in (number.columns or {field_name: number.meaning}).items():
            yield Column(name, meaning, allowed, Physics, field_name, unit=number.unit, needs=PHYSICAL)


COLUMNS = (
    Column("key", "source index as eight digits, then number of patch, level and draw if there are several", KEY_TEXT,
           empty_if=""),
    Column("source", "path below the source folder, percent-encoded where unsafe", RelativePath(), Source, "name",
           empty_if=""),
    Column("source_sha256", "SHA-256 of the source's bytes", HEX_256, empty_if="the source cannot be read"),
    Column("source_bytes", "size of the source; 0 for a synthetic picture", COUNT, Source, "size_bytes", unit="bytes",
           empty_if="there is no readable file"),
    Column("status", "ok, failed if the source could not be used, or filtered if source.min_side leaves it out (other "
           "cells are then as for failed)",
           OneOf(("ok", "failed", "filtered")), empty_if=""),
    Column("reason", "reason of the status", Text(re.compile("[a-z0-9_]*"), "a reason such as corrupt"),
           empty_if="the status is ok"),
    Column("detail", "explanation of the reason, one line", ANY_TEXT, empty_if="the status is ok"),
    Column("width", "width of the frame; packed planes have half of it", SIDE, Patch, unit="pixels"),
    Column("height", "height of the frame; packed planes have half of it", SIDE, Patch, unit="pixels"),
    Column("orientation", "EXIF orientation that was applied to the source, 1 to 8", integers(1, 8)),
    Column("shard", "number of the shard", integers(0, 10**9), empty_if=""),
    Column("seed", "seed of the run", COUNT, Plan, empty_if=""),
    Column("stream_key", "key of the image's random streams, 16 hex digits", HEX_64, Plan, spelling=HEXADECIMAL),
    Column("split", "part of the dataset that the image belongs to",
           Text(re.compile(r"[\w-]{1,32}", re.ASCII), "up to 32 letters, digits, _ and -"), Plan, needs=SPLITS),
    Column("clip", "name of the clip", ANY_TEXT, Source, needs=CLIPS),
    Column("frame", "number of the frame in its clip, from 0", COORDINATE, Place, needs=CLIPS),
    Column("patch", "number of the patch in its image, from 0", COORDINATE, Patch, "number", needs=PATCHES),
    Column("patch_y", "first row of the arrays in the full frame; even", COORDINATE, Patch, "y", unit="pixels",
           needs=PATCHES),
    Column("patch_x", "first column of the arrays in the full frame; even", COORDINATE, Patch, "x", unit="pixels",
           needs=PATCHES),
    Column("level", "number of the noise level, from 0", integers(0, 99), Place, needs=LEVELS),
    Column("draw", "number of the draw at this level, from 0", integers(0, 99), Place, needs=LEVELS),
    Column("camera", "convex, or the name of the camera", ANY_TEXT, CameraPlan),
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
    Column("light", "light from which the white-balance gains follow", ANY_TEXT, CameraPlan, needs=LIGHTS),
    Column("cct_k", "correlated colour temperature of the light", Range(1000, 25000), CameraPlan, unit="K",
           needs=LIGHTS),
    Column("red_gain", "forward white-balance gain of red", GAINS, CameraPlan),
    Column("blue_gain", "forward white-balance gain of blue", GAINS, CameraPlan),
    Column("inverse_rgb_gain", "inverse of the brightening gain; all channels are multiplied by it", GAINS, CameraPlan),
    Column("tone", "inverted tone curve: smoothstep or none", OneOf(("smoothstep", "none")), IspPlan),
    Column("gamma", "inverted gamma: a number or srgb", Range(0.1, 10, ("srgb",), number_or_text), IspPlan,
           spelling=GAMMA_SPELLING),
    Column("highlight", "preservation of highlights: per_channel, gray_mean or none",
           OneOf(("per_channel", "gray_mean", "none")), IspPlan),
    Column("highlight_threshold", "linear signal above which highlights are preserved, 1 is white",
           Range(0, math.nextafter(1, 0)), IspPlan),
    Column("downscale", "side of the squares of source pixels that were averaged", integers(1, 64), SourcePlan,
           unit="pixels"),
    Column("dequantize", "dequantization of 8-bit codes: off, dither or dither_all",
           OneOf(("off", "dither", "dither_all")), SourcePlan),
    Column("shrink", "of a raw source, side of the cells whose sites of one colour were averaged; 1: the mosaic itself",
           integers(1, 2), SourcePlan, needs=RAW),
    Column("raw_pattern", "CFA pattern of the raw file", OneOf(("RGGB", "BGGR", "GRBG", "GBRG")), SourcePlan,
           needs=RAW),
    *(
        Column(f"raw_{level}_dn", f"{level} levels of the raw file: R, G of the red rows, G of the blue rows, B, "
               "separated by ;",
               LEVELS_TEXT, SourcePlan, spelling=LEVEL_LIST, unit="DN of the file", needs=RAW)
        for level in ("black", "white")
    ),
    Column("mosaic_xxh3", "XXH3-128 of the mosaic that the raw file was decoded to", HEX_128, SourcePlan, needs=RAW),
    *(
        Column(name, meaning, allowed, SourcePlan, unit=unit, empty_if=f"{FAILED}, or the file does not state it",
               needs=RAW)
        for name, meaning, allowed, unit in (
            ("source_iso", "ISO of the raw file", Range(0, 1e9), ""),
            ("source_exposure_s", "exposure time of the raw file", Range(0, 1e7), "seconds"),
            ("own_a_dn", "noise of the raw source itself in the clean frame, whose variance is own_a_dn (x - black) + "
             "own_b_dn2", NOT_NEGATIVE, "DN"),
            ("own_b_dn2", "variance at black of the raw source itself in the clean frame", NOT_NEGATIVE, "DN²"),
        )
    ),
    Column("pattern", "CFA pattern of the top-left 2x2 sites, or MONO",
           OneOf(("RGGB", "BGGR", "GRBG", "GBRG", "MONO")), SensorPlan),
    Column("bits", "bits per sample of the sensor", integers(1, 16), SensorPlan),
    Column("black_level_dn", "black level", integers(0, 65534), SensorPlan, unit="DN"),
    Column("white_level_dn", "white level (saturation)", integers(1, 65535), SensorPlan, unit="DN"),
    Column("sensor_clip", "clipping of the noisy frame: sensor, black or none", OneOf(("sensor", "black", "none")),
           SensorPlan),
    Column("saturated_as", "noisy sites whose clean site is saturated: noisy, or white where the converter ends",
           OneOf(("noisy", "white")), SensorPlan),
    Column("scene", "name of the scene", ANY_TEXT, ScenePlan),
    Column("exposure_ratio", "divisor of the light in the photograph", Range(1e-4, 1e7), ScenePlan),
    Column("noise", "name of the noise profile", ANY_TEXT, NoisePlan),
    Column("noise_law", "distribution of a two-parameter profile: gaussian or poisson", OneOf(("gaussian", "poisson")),
           NoisePlan),
    Column("a_dn", "slope of the noise variance, which is a_dn (x - black) + dark_variance_dn2", Range(-1e30, 1e30),
           NoisePlan, unit="DN"),
    Column("b_dn2", "noise variance at black of two-parameter noise, or of read noise; see dark_variance_dn2", FINITE,
           NoisePlan, unit="DN²"),
    Column("dark_variance_dn2", "noise variance of a site at black, by all simulated effects except hot pixels, dead "
           "pixels and rounding; ug.noise_std uses it",
           FINITE, unit="DN²"),
    Column("effects", "simulated effects, in order, separated by ;", ANY_TEXT, NoisePlan, spelling=LIST,
           empty_if=f"{FAILED}, or no effect was simulated"),
    Column("skipped", "skipped effects, each with its reason, separated by ;", ANY_TEXT, NoisePlan, spelling=LIST,
           empty_if=f"{FAILED}, or no effect was skipped"),
    Column("assumed", "assumed numbers of the profile that the simulated effects use, separated by ;", ANY_TEXT,
           NoisePlan, spelling=LIST, empty_if=f"{FAILED}, or no effect uses one", needs=PHYSICAL),
    Column("accuracy", "accuracy tier", OneOf(TIERS), Plan),
    Column("iso", "ISO of a physical profile", Range(0, 1e9), Physics, needs=PHYSICAL),
    Column("exposure_s", "exposure time", Range(0, 1e7), Physics, unit="seconds", needs=PHYSICAL),
    Column("temperature_c", "temperature of the sensor", Range(-300, 1000), Physics, unit="degrees Celsius",
           needs=PHYSICAL),
    *_columns_of_numbers(),
    Column("dark_offset", "mean dark current: removed or kept", OneOf(("removed", "kept")), Physics, needs=PHYSICAL),
    Column("sensor_unit", "camera body", ANY_TEXT, Physics, needs=PHYSICAL),
    Column("body_key", "key of the fixed patterns, 16 hex digits", HEX_64, Physics, spelling=HEXADECIMAL,
           needs=PHYSICAL),
    Column("fixed_pattern_in_clean", "1 if the clean frame has the fixed patterns too", integers(0, 1), Physics,
           spelling=FLAG, needs=PHYSICAL),
    *(
        Column(f"frame_{side}", f"{side} of the full frame, to which the lens shading belongs", COORDINATE, Physics,
               "frame_size", unit="pixels", needs=SHADING)
        for side in ("height", "width")
    ),
    Column("dark_frame", "SHA-256 of the dark frame from which the noise of the read-out is sampled", HEX_256,
           DarkFramePlan, needs=DARK_FRAMES),
    *(
        Column(f"dark_frame_{axis}", f"first {side} of the dark frame that the full frame uses; even", COORDINATE,
               DarkFramePlan, "shift", unit="pixels", needs=DARK_FRAMES)
        for axis, side in (("y", "row"), ("x", "column"))
    ),
    Column("dark_black_dn", "black level of the dark frame", Range(0, 65535), DarkFramePlan,
           unit="DN of the dark frame", needs=DARK_FRAMES),
    Column("dark_scale", "DN of the sensor per DN of the dark frame", Range(1e-9, 1e9), DarkFramePlan,
           needs=DARK_FRAMES),
    Column("dtype", "dtype of the arrays: uint16 (DN), or float32 (0 at black, 1 at white)", OneOf((UINT16, FLOAT32)),
           OutputPlan),
    Column("layout", "layout of the arrays: mosaic, or packed planes", OneOf((MOSAIC, PACKED)), OutputPlan),
    Column("clean_dtype", "dtype of the clean array, if it is not that of dtype", OneOf((FLOAT32,)), OutputPlan,
           empty_if=f"{FAILED}, or the clean array has the dtype of the noisy one", needs=FLOAT_CLEAN),
    Column("clean_xxh3", "XXH3-128 of the clean array's little-endian bytes", HEX_128, needs=FRAMES),
    Column("noisy_xxh3", "XXH3-128 of the noisy array's little-endian bytes", HEX_128, needs=FRAMES),
    Column("targets", f"the stored target with dtype and XXH3-128: {LINEAR_RGB}:float32:…",
           Text(re.compile(f"({LINEAR_RGB}:float32:[0-9a-f]{{32}})?"), "name:dtype:digest of a target"),
           needs=STORED_TARGETS),
    *(
        Column(name, meaning, COUNT, Counts, unit="sites", needs=FRAMES)
        for name, meaning in (
            ("clean_clipped_low", "clean sites below black before clipping"),
            ("clean_clipped_high", "clean sites above white before clipping"),
            ("noisy_clipped_low", "noisy sites below the lowest DN before clipping"),
            ("noisy_clipped_high", "noisy sites above the highest DN before clipping"),
            ("saturated", "clean sites at the white level"),
            ("zero_variance", "sites at which the noise has no variance"),
        )
    ),
    Column("light_clipped_high", "sites whose light is above white before the exposure ratio divides it", COUNT, Counts,
           unit="sites", empty_if=f"{FAILED}, or exposure_ratio is 1", needs=DIVIDED_LIGHT),
    Column("source_noise_dn", "estimated noise of the source itself, in the green plane of the clean frame",
           NOT_NEGATIVE, unit="DN", empty_if=f"{FAILED}, or no tile of 32 x 32 pixels is free of clipping",
           needs=FOUND_FILES),
)  # fmt: skip
"""All columns, in the order of ``manifest.csv``."""

COLUMN_NAMES = tuple(column.name for column in COLUMNS)


def columns_of(config: Config) -> tuple[str, ...]:
    """Return the names of the columns of a manifest: those that the settings can fill."""
    return tuple(column.name for column in COLUMNS if column.needs.holds(config))


COLUMNS_OF: dict[RecordType, dict[str, tuple[Column, ...]]] = {}
"""Columns that hold a record, by field: one for a scalar field, several for a tuple."""

for _column in COLUMNS:
    if _column.of is not None:
        _fields = COLUMNS_OF.setdefault(_column.of, {})
        _fields[_column.field or _column.name] = (*_fields.get(_column.field or _column.name, ()), _column)
