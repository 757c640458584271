"""The settings: one dataclass for each folder of ``conf/``, their checks, and the ``config.yaml`` of a dataset.

Everything a user can get wrong is refused here, before the first image, in one sentence that names the key, the value
and what is allowed. Types and unknown keys are checked by OmegaConf against these dataclasses; ranges, and what must
fit together, by `check`. The classes are ordinary ones, because Hydra cannot override frozen ones; nothing changes them
after the door.

A parameter that is drawn for every image is written as a number, or as a law: ``[uniform, 1.9, 2.4]``. A list, because
an override then replaces the whole law; a mapping would be merged into a mixture of two.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from decimal import Decimal
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Optional, TypeVar

import yaml

from unprocess_gen.config.accuracy import Budget, choose
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import FLOAT32, MOSAIC, PACKED, UINT16, Law, PatchLaw
from unprocess_gen.simulation.reference import cfa as bayer
from unprocess_gen.simulation.reference import colour


@dataclass
class SourceConfig:
    """Where the photographs come from; ``root`` null stands for the built-in scenes.

    ``clips``: folders are clips, and so are the files that ``video``'s globs match, which else nothing looks at.
    """

    root: Optional[str] = None
    include: list[str] = field(default_factory=list)
    recursive: bool = True
    limit: Optional[int] = None
    max_pixels: int = 2**26
    max_failed: int = 0
    icc: str = "ignore"
    clips: bool = False
    video: list[str] = field(default_factory=list)
    downscale: int = 1
    dequantize: str = "off"
    patch: Any = None


@dataclass
class CameraConfig:
    """Which camera saw the scene: ``law`` is one of `CAMERA_LAWS`; ``xyz2cam`` row by row, for ``custom`` alone."""

    name: str = "convex"
    law: str = "convex"
    xyz2cam: Optional[list[float]] = None


@dataclass
class GainsConfig:
    """Forward gains of red and blue, the inverse brightening gain (numbers or laws), and what highlights do."""

    red: Any = None
    blue: Any = None
    inverse_rgb: Any = None
    highlight: str = "per_channel"
    threshold: float = 0.9


@dataclass
class IspConfig:
    """The tone curve and gamma (a power, or srgb) that the camera's processing applied after the matrix."""

    tone: str = "smoothstep"
    gamma: Any = 2.2


@dataclass
class SensorConfig:
    """Bits, levels (DN), Bayer pattern, how noisy frames are clipped and saturated, and which camera bodies there are.

    ``units``: ``image``, a body of its own for every image, or a number of bodies to draw from.
    """

    bits: int = 12
    black_level_dn: int = 240
    white_level_dn: int = 4095
    pattern: str = "RGGB"
    clip: str = "sensor"
    saturated: str = "noisy"
    dark_offset: str = "removed"
    units: Any = "image"


@dataclass
class BranchConfig:
    """What a physical profile says in one range of ISO; see `FORMS` for what stands where a number depends on ISO."""

    iso: list[float] = field(default_factory=list)
    dn_per_e: Any = None
    read_law: str = "gaussian"
    read_shape: Any = 0.0
    read_std_dn: Any = None
    row_std_dn: Any = None
    column_std_dn: Any = None
    black_error_dn: Any = None


@dataclass
class NoiseConfig:
    """A noise profile, in ``units``, with the levels (DN) it was calibrated at.

    ``levels``: several noise levels of one clean frame, a list of ISOs or of ``{a, b}``, or how many to draw;
    ``draws``: how many noisy frames at each.

    Either variance a·x + b (numbers or laws), or a physical one: ``branches`` by ISO, and what does not depend on it.
    ``assumed`` names the numbers that no source gives; they stay off unless their effect is switched on by name.
    """

    name: str = "none"
    units: Optional[str] = None
    black: Optional[str] = None
    bits: Optional[int] = None
    black_level_dn: Optional[int] = None
    white_level_dn: Optional[int] = None
    a: Any = None
    b: Any = None
    negative_variance: str = "refuse"
    law: str = "gaussian"
    iso: Any = None
    levels: Any = None
    draws: int = 1
    branches: list[BranchConfig] = field(default_factory=list)
    prnu_std: Optional[float] = None
    dark_e_per_s: Optional[float] = None
    dark_reference_c: float = 25.0
    dark_doubling_c: float = 7.0
    hot_pixel_share: Optional[float] = None
    hot_pixel_e_per_s: Optional[float] = None
    dead_pixel_share: Optional[float] = None
    full_well_e: Optional[float] = None
    assumed: list[str] = field(default_factory=list)


@dataclass
class SceneConfig:
    """What a physical profile needs to know of the scene: numbers or laws; exposure_ratio darkens it."""

    name: str = "daylight"
    iso: Any = 100
    exposure_s: Any = 0.001
    temperature_c: Any = 25
    exposure_ratio: Any = 1


@dataclass
class EffectsConfig:
    """Which effects are simulated: auto, on or off; a named one wins over ``all``."""

    all: str = "auto"
    tolerance: float = 0.1
    heteroscedastic: Optional[str] = None
    prnu: Optional[str] = None
    shot: Optional[str] = None
    dark_current: Optional[str] = None
    hot_pixels: Optional[str] = None
    full_well: Optional[str] = None
    read: Optional[str] = None
    row: Optional[str] = None
    column: Optional[str] = None
    black_error: Optional[str] = None
    dead_pixels: Optional[str] = None
    quantise: Optional[str] = None


@dataclass
class CleanConfig:
    """What the clean frame shares with the noisy one beyond the rule."""

    includes_fixed_pattern: bool = False


@dataclass
class AccuracyConfig:
    """What may be given up for speed: the numbers of `methods.Budget`."""

    name: str = "exact"
    readable: bool = False
    clean_dn: float = 0.0
    clean_changed_share: float = 0.0
    normal_error: float = 1e-6
    law_distance: float = 0.0


@dataclass
class OutputConfig:
    """What the dataset is written as: what its numbers are, how the sites of a frame lie, how large shards are."""

    dtype: str = UINT16
    layout: str = MOSAIC
    pairs_per_shard: int = 8


@dataclass
class Config:
    """All settings of a run; those in `NOT_DATA` do not decide the data."""

    source: SourceConfig = field(default_factory=SourceConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    gains: GainsConfig = field(default_factory=GainsConfig)
    isp: IspConfig = field(default_factory=IspConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    effects: EffectsConfig = field(default_factory=EffectsConfig)
    clean: CleanConfig = field(default_factory=CleanConfig)
    accuracy: AccuracyConfig = field(default_factory=AccuracyConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    seed: int = 0
    out: str = "ds"
    n_jobs: int = -1
    self_test: str = "stop"


Option = TypeVar("Option")

CAMERA_LAWS = ("fixed", "convex", "choice", "identity", "custom")
HIGHLIGHTS = ("per_channel", "gray_mean", "none")
SELF_TESTS = ("stop", "go_on")
"""What a failed self-test does to a run."""

MAX_PAIRS_PER_SHARD = 10**6
MIN_GAIN, MAX_GAIN = 1e-3, 1e3
"""Chosen: no camera comes near either, and no product or quotient of them overflows."""

MAX_VARIANCE = 1e15
"""Chosen: far above any sensor, and nothing overflows on the way to DN."""

NAME = re.compile(r"[\w.+-]{1,100}", re.ASCII)
"""What a camera or a noise profile may be called: it stands in every row."""

# ------------------------------------------------------------------------------------------------------------ laws


def _increasing(low: float, high: float) -> str | None:
    return None if low < high else "the lowest value must lie below the highest"


def _truncated(mean: float, std: float, low: float, high: float) -> str | None:
    if std <= 0:
        return "the standard deviation must be above 0"
    if abs(low - mean) > 6 * std or abs(high - mean) > 6 * std:
        return "the limits must lie within six standard deviations of the mean"
    return _increasing(low, high)


def _log_range(low: float, high: float) -> str | None:
    return _increasing(low, high) if low > 0 else "the lowest value must be above 0"


def _line(slope: float, intercept: float, std: float) -> str | None:
    if not (abs(slope) <= 10 and abs(intercept) <= 50 and 0 <= std <= 10):
        return "expected a slope of -10 to 10, an intercept of -50 to 50, a standard deviation of 0 to 10"
    return None


LAW_NUMBERS: dict[str, tuple[tuple[str, ...], Callable[..., str | None]]] = {
    "constant": (("value",), lambda value: None),
    "uniform": (("lowest", "highest"), _increasing),
    "log_uniform": (("lowest", "highest"), _log_range),
    "truncated_normal": (("mean", "standard deviation", "lowest", "highest"), _truncated),
    "inverse_truncated_normal": (("mean", "standard deviation", "lowest", "highest"), _truncated),
    "log_linear_in_a": (("slope", "intercept", "standard deviation"), _line),
    "choice": (("value", "…"), lambda *values: None if values else "expected a value at least"),
}
"""The laws a parameter can be drawn from: their numbers, and what must hold between them (None: all is well)."""


def law(key: str, value: Any, allowed: tuple[str, ...]) -> Law:
    """Read a number or a law ``[kind, number, …]``; ConfigError names ``key``, the value and the ``allowed`` kinds."""
    forms = "; ".join(f"[{kind}, {', '.join(LAW_NUMBERS[kind][0])}]" for kind in allowed)
    if _is_number(value):
        return Law("constant", (float(value),))
    if not isinstance(value, list) or not value or value[0] not in allowed:
        raise ConfigError(f"{key}={_text(value)}: expected a finite number or a law: {forms}")
    kind, numbers = str(value[0]), value[1:]
    names, rule = LAW_NUMBERS[kind]
    if (len(numbers) != len(names) and kind != "choice") or not all(_is_number(number) for number in numbers):
        raise ConfigError(f"{key}={_text(value)}: expected finite numbers: [{kind}, {', '.join(names)}]")
    complaint = rule(*numbers)
    if complaint:
        raise ConfigError(f"{key}={_text(value)}: {complaint}")
    return Law(kind, tuple(float(number) for number in numbers))


def lowest(drawn: Law) -> float:
    """Return a value that no draw of the law lies below."""
    if drawn.kind in ("constant", "choice"):
        return min(drawn.numbers)
    if drawn.kind == "truncated_normal":
        return drawn.numbers[2]
    if drawn.kind == "inverse_truncated_normal":
        return 1 / drawn.numbers[3] if drawn.numbers[2] > 0 else -math.inf
    return drawn.numbers[0] if drawn.kind in ("uniform", "log_uniform") else 0.0


def highest(drawn: Law) -> float:
    """Return a value that no draw of the law lies above."""
    if drawn.kind == "choice":
        return max(drawn.numbers)
    if drawn.kind == "inverse_truncated_normal":
        return 1 / drawn.numbers[2] if drawn.numbers[2] > 0 else math.inf
    return math.inf if drawn.kind == "log_linear_in_a" else drawn.numbers[-1]


GAIN_LAWS = ("uniform", "truncated_normal")
INVERSE_GAIN_LAWS = (*GAIN_LAWS, "inverse_truncated_normal")
A_LAWS = ("uniform", "log_uniform")
B_LAWS = (*A_LAWS, "log_linear_in_a")


def gain_laws(gains: GainsConfig) -> tuple[Law, Law, Law]:
    """Return the laws of the red, blue and inverse brightening gain; ConfigError unless every draw is above 0."""
    laws = (
        law("gains.red", gains.red, GAIN_LAWS),
        law("gains.blue", gains.blue, GAIN_LAWS),
        law("gains.inverse_rgb", gains.inverse_rgb, INVERSE_GAIN_LAWS),
    )
    for name, drawn in zip(("red", "blue", "inverse_rgb"), laws, strict=True):
        if not (lowest(drawn) >= MIN_GAIN and highest(drawn) <= MAX_GAIN):
            value = _text(getattr(gains, name))
            raise ConfigError(f"gains.{name}={value}: a gain must be above 0, from {MIN_GAIN:g} to {MAX_GAIN:g}")
    return laws


def noise_laws(noise: NoiseConfig) -> tuple[Law, Law]:
    """Return the laws of a and b; ConfigError where a can be negative."""
    a, b = law("noise.a", noise.a, A_LAWS), law("noise.b", noise.b, B_LAWS)
    if lowest(a) < 0:
        raise ConfigError(f"noise.a={_text(noise.a)}: the variance's slope must be 0 or more")
    for name, drawn in (("a", a), ("b", b)):
        if max(abs(number) for number in drawn.numbers) > MAX_VARIANCE:
            raise ConfigError(f"noise.{name}={_text(getattr(noise, name))}: expected at most {MAX_VARIANCE:g}")
    if b.kind == "log_linear_in_a" and not lowest(a) > 0:
        raise ConfigError(f"noise.a={_text(noise.a)}: noise.b depends on its logarithm, so it must be above 0")
    return a, b


# ---------------------------------------------------------------------------------------------------------- checks


def check(config: Config) -> None:
    """Refuse settings that cannot be meant: ConfigError with the key, the value and what is allowed."""
    _in_range("seed", config.seed, 0, 2**63 - 1)
    if config.n_jobs != -1:
        _in_range("n_jobs", config.n_jobs, 1, 1024, " or -1 for one a core")
    _one_of("self_test", config.self_test, SELF_TESTS)
    if not config.out:
        raise ConfigError("out='': expected the name of a folder")
    _check_source(config.source)
    _check_camera(config.camera)
    gain_laws(config.gains)
    _one_of("gains.highlight", config.gains.highlight, HIGHLIGHTS)
    if not 0 <= config.gains.threshold < 1:
        raise ConfigError(f"gains.threshold={config.gains.threshold}: expected 0 up to, but not including, 1")
    _one_of("isp.tone", config.isp.tone, ("smoothstep", "none"))
    if config.isp.gamma != "srgb" and not (_is_number(config.isp.gamma) and 0.1 <= config.isp.gamma <= 10):
        raise ConfigError(f"isp.gamma={_text(config.isp.gamma)}: expected a number from 0.1 to 10, or srgb")
    _check_sensor(config.sensor)
    _check_scene(config.scene)
    for noise in noise_levels(config.noise):
        _check_noise(noise, config.scene)
    _check_levels(config)
    _check_effects(config)
    _check_accuracy(config)
    _check_output(config)
    _in_range("output.pairs_per_shard", config.output.pairs_per_shard, 1, MAX_PAIRS_PER_SHARD)


def dequantizing(source: SourceConfig) -> str:
    """Return ``off`` or ``dither``."""
    return YAML_SWITCHES.get(source.dequantize, source.dequantize)


def _check_source(source: SourceConfig) -> None:
    if source.root == "":
        raise ConfigError("source.root='': expected a folder; null stands for the built-in scenes")
    if source.root is not None and not Path(source.root).is_dir():
        raise ConfigError(f"source.root={source.root}: no such folder; null stands for the built-in scenes")
    if not source.include and not (source.clips and source.video):
        raise ConfigError("source.include=[]: expected at least one pattern such as '*.jpg'")
    if source.clips and source.root is None:
        raise ConfigError("source.clips=true: the built-in scenes are no clips; give source.root=…")
    if source.limit is not None:
        _in_range("source.limit", source.limit, 1, 10**9, " or null")
    _in_range("source.max_pixels", source.max_pixels, 1, 2**40)
    _in_range("source.max_failed", source.max_failed, 0, 10**9)
    _in_range("source.downscale", source.downscale, 1, 64)
    _one_of("source.dequantize", dequantizing(source), ("off", "dither"))
    patch_law(source)
    _one_of("source.icc", source.icc, ("ignore", "refuse"))
    if source.icc == "refuse" and find_spec("PIL") is None:
        raise ConfigError("source.icc=refuse: needs Pillow to read colour profiles; pip install pillow")


MIN_PATCH, MAX_PATCH, MOST_RANDOM_PATCHES = 2, 2**15, 10**4
"""Sides and strides of patches in pixels, and how many can be asked for at random places: four digits in a key."""


def patch_law(source: SourceConfig) -> PatchLaw | None:
    """Return how images are cut into patches, None where they stay whole; ConfigError where it cannot be meant."""
    match ["grid", source.patch] if _is_whole(source.patch) else source.patch:
        case None:
            return None
        case ["grid", side] if _is_patch_length(side):
            return PatchLaw("grid", side, stride=side)
        case ["grid", side, stride] if _is_patch_length(side) and _is_patch_length(stride):
            return PatchLaw("grid", side, stride=stride)
        case ["random", side, count] if _is_patch_length(side) and _is_patch_count(count):
            return PatchLaw("random", side, count=count)
    raise ConfigError(
        f"source.patch={_text(source.patch)}: expected null, a side, [grid, side], [grid, side, stride] or "
        f"[random, side, count]; side and stride are even, {MIN_PATCH} to {MAX_PATCH} pixels, "
        f"count is 1 to {MOST_RANDOM_PATCHES}"
    )


def _is_patch_length(value: Any) -> bool:
    return _is_whole(value) and MIN_PATCH <= value <= MAX_PATCH and value % 2 == 0


def _is_patch_count(value: Any) -> bool:
    return _is_whole(value) and 1 <= value <= MOST_RANDOM_PATCHES


def _patch_setting(source: SourceConfig) -> list[Any] | None:
    """Return ``source.patch`` in the one spelling of ``config.yaml``."""
    law = patch_law(source)
    return None if law is None else [law.kind, law.side, law.stride or law.count]


def _check_camera(camera: CameraConfig) -> None:
    _one_of("camera.law", camera.law, CAMERA_LAWS)
    _check_name("camera.name", camera.name)
    if camera.law == "fixed":
        _one_of("camera.name", camera.name, tuple(colour.CAMERAS))
    elif camera.law != "custom":
        _one_of("camera.name", camera.name, (camera.law,))
    if camera.law != "custom":
        if camera.xyz2cam is not None:
            raise ConfigError(f"camera.xyz2cam={camera.xyz2cam}: a matrix needs camera.law=custom, not {camera.law}")
        return
    if camera.xyz2cam is None:
        raise ConfigError("camera.xyz2cam=null: camera=custom needs nine numbers, XYZ to camera, row by row")
    try:
        colour.rgb2cam(colour.matrix(camera.xyz2cam))
    except ValueError as error:
        raise ConfigError(f"camera.xyz2cam={camera.xyz2cam}: {error}") from error
    if camera.name in (*colour.CAMERAS, *CAMERA_LAWS) and camera.name != "custom":
        raise ConfigError(f"camera.name={camera.name}: is taken; give a camera of your own another name")


def _check_sensor(sensor: SensorConfig) -> None:
    _in_range("sensor.bits", sensor.bits, 1, 16)
    _in_range("sensor.black_level_dn", sensor.black_level_dn, 0, 2**sensor.bits - 2)
    _in_range(
        "sensor.white_level_dn",
        sensor.white_level_dn,
        sensor.black_level_dn + 1,
        2**sensor.bits - 1,
        " (above the black level, within the bits)",
    )
    _one_of("sensor.pattern", sensor.pattern, bayer.PATTERNS)
    _one_of("sensor.clip", sensor.clip, ("sensor", "black", NO_CLIP))
    _one_of("sensor.saturated", sensor.saturated, ("noisy", "pinned"))
    _one_of("sensor.dark_offset", sensor.dark_offset, ("removed", "kept"))
    if sensor.units != "image" and not (_is_whole(sensor.units) and 1 <= sensor.units <= 10**6):
        raise ConfigError(f"sensor.units={_text(sensor.units)}: expected image, or a number of bodies, 1 to 1000000")


MOST_LEVELS = 100
"""Levels, and draws at each: two digits in a key."""


def noise_levels(noise: NoiseConfig) -> tuple[NoiseConfig, ...]:
    """Return the profile of each noise level; ConfigError where ``noise.levels`` is no list and no number of levels."""
    levels = 1 if noise.levels is None else noise.levels
    if _is_whole(levels) and 1 <= levels <= MOST_LEVELS:
        return (noise,) * levels
    if not isinstance(levels, list) or not 1 <= len(levels) <= MOST_LEVELS:
        raise ConfigError(
            f"noise.levels={_text(levels)}: expected how many, 1 to {MOST_LEVELS}, or a list of ISOs or {{a, b}}"
        )
    return tuple(_level(noise, level) for level in levels)


def _level(noise: NoiseConfig, level: Any) -> NoiseConfig:
    if is_physical(noise) and _is_number(level):
        return dataclasses.replace(noise, iso=level)
    if not is_physical(noise) and isinstance(level, dict) and level.keys() == {"a", "b"}:
        return dataclasses.replace(noise, a=level["a"], b=level["b"])
    wanted = "an ISO" if is_physical(noise) else "{a: …, b: …}"
    raise ConfigError(f"noise.levels: {_text(level)}: expected {wanted} for noise={noise.name}")


def _check_levels(config: Config) -> None:
    noise = config.noise
    _in_range("noise.draws", noise.draws, 1, MOST_LEVELS)
    if len(noise_levels(noise)) == 1:
        return
    if noise.full_well_e is not None:
        raise ConfigError(
            f"noise.levels={_text(noise.levels)}: with noise.full_well_e the clean frame depends on the ISO"
        )
    if config.clean.includes_fixed_pattern:
        raise ConfigError(
            "clean.includes_fixed_pattern=true: the fixed pattern depends on the ISO; leave noise.levels out"
        )


def uses_physics(noise: NoiseConfig) -> bool:
    """Whether pairs are made by the kernels of the physical effects: counts of electrons, not Gaussian noise alone."""
    return is_physical(noise) or noise.law == "poisson"


def is_physical(noise: NoiseConfig) -> bool:
    """Whether a profile speaks of electrons, not of a variance with two numbers."""
    return bool(noise.branches)


def _check_noise(noise: NoiseConfig, scene: SceneConfig) -> None:
    _check_name("noise.name", noise.name)
    _one_of("noise.units", noise.units, ("dn", "normalized"))
    _one_of("noise.black", noise.black, ("subtracted", "included"))
    _one_of("noise.negative_variance", noise.negative_variance, ("refuse", "clip"))
    _one_of("noise.law", noise.law, ("gaussian", "poisson"))
    if is_physical(noise):
        if noise.law != "gaussian":
            raise ConfigError(
                f"noise.law={noise.law}: is of profiles with two numbers; noise={noise.name} draws electrons"
            )
        _check_physical(noise, scene)
        return
    if noise.iso is not None:
        raise ConfigError(
            f"noise.iso={_text(noise.iso)}: noise={noise.name} holds for one ISO; choose a physical profile"
        )
    _, b = noise_laws(noise)
    if noise.law == "poisson" and (noise.black == "included" or lowest(b) < 0):
        raise ConfigError("noise.law=poisson: needs the black level subtracted and b of 0 or more")
    if noise.units == "normalized":
        if noise.black == "included":
            raise ConfigError("noise.black=included: normalized units have black at 0, so it must be subtracted")
        offset = 0.0
    else:
        _check_calibration(noise)
        offset = _black_share(noise)
    if noise.law == "poisson":
        _check_countable(noise)
    if lowest(b) + offset < 0 and noise.negative_variance == "refuse":
        raise ConfigError(
            f"noise.b={_text(noise.b)}: the variance at black is {lowest(b) + offset:.6g}, below 0; "
            "say noise.negative_variance=clip if max(0, variance) is meant"
        )


SCENE_LAWS = ("uniform", "log_uniform", "choice")
"""What ISO and the numbers of a scene can be drawn from."""


def branch_of(noise: NoiseConfig, iso: float) -> BranchConfig | None:
    """Return what a physical profile says at an ISO; None where it says nothing."""
    return next((branch for branch in noise.branches if branch.iso[0] <= iso <= branch.iso[1]), None)


def _check_physical(noise: NoiseConfig, scene: SceneConfig) -> None:
    for key in ("a", "b"):
        if getattr(noise, key) is not None:
            raise ConfigError(
                f"noise.{key}={_text(getattr(noise, key))}: noise={noise.name} is a physical profile; set iso"
            )
    if noise.units != "dn" or noise.black != "subtracted":
        raise ConfigError(f"noise.units={noise.units}: a physical profile is in dn, with the black level subtracted")
    _check_calibration(noise)
    for number, branch in enumerate(noise.branches):
        _check_branch(f"noise.branches[{number}]", branch)
        _check_gain(f"noise.branches[{number}].dn_per_e", noise, branch)
    for key, low, high in RATES:
        value = getattr(noise, key)
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            raise ConfigError(f"noise.{key}={value}: expected {low:g} to {high:g}")
    for name in noise.assumed:
        _one_of("noise.assumed", name, tuple(key for key, _, _ in RATES))
    _check_iso(noise, scene)
    _check_electrons(noise, scene)


RATES = (
    ("prnu_std", 0.0, 0.5),
    ("dark_e_per_s", 0.0, 1e6),
    ("dark_reference_c", -273.0, 200.0),
    ("dark_doubling_c", 0.1, 100.0),
    ("hot_pixel_share", 0.0, 1.0),
    ("hot_pixel_e_per_s", 0.0, 1e6),
    ("dead_pixel_share", 0.0, 1.0),
    ("full_well_e", 1.0, 1e9),
)
"""Numbers of a physical profile that do not depend on ISO, and what they can be at all (chosen, far beyond sensors)."""

FORM_NUMBERS = {"per_iso": (1, 2), "root": (1, 3), "line": (3, 3), "scale_line": (3, 3)}
"""The forms of `physics.FORMS`, and how many numbers each takes."""


def _check_branch(key: str, branch: BranchConfig) -> None:
    if len(branch.iso) != 2 or not 0 < branch.iso[0] <= branch.iso[1] <= 1e7:
        raise ConfigError(f"{key}.iso={_text(branch.iso)}: expected the lowest and the highest ISO, [100, 6400]")
    _one_of(f"{key}.read_law", branch.read_law, ("gaussian", "tukey"))
    _check_form(f"{key}.dn_per_e", branch.dn_per_e, ("per_iso",))
    _check_form(f"{key}.read_std_dn", branch.read_std_dn, ("root", "line", "scale_line"))
    for name in ("row_std_dn", "column_std_dn"):
        if getattr(branch, name) is not None:
            _check_form(f"{key}.{name}", getattr(branch, name), ("root", "line"))
    shape = law(f"{key}.read_shape", branch.read_shape, ("choice",))
    if not (lowest(shape) > -0.5 and highest(shape) < 10):
        raise ConfigError(
            f"{key}.read_shape={_text(branch.read_shape)}: Tukey's law has a variance for shapes above -0.5 only"
        )
    _check_black_error(f"{key}.black_error_dn", branch.black_error_dn)


MAX_ELECTRONS = 1e9
"""Counts are exact up to this mean (`poisson`), which no pixel holds."""


def _check_countable(noise: NoiseConfig) -> None:
    """Refuse a gain so small that white is more electrons than can be counted; without shot noise nothing is."""
    span = 1 if noise.units == "normalized" else (noise.white_level_dn or 0) - (noise.black_level_dn or 0)
    a = law("noise.a", noise.a, A_LAWS)
    if a.numbers != (0.0,) and lowest(a) * MAX_ELECTRONS < span:
        raise ConfigError(
            f"noise.a={_text(noise.a)}: noise.law=poisson counts up to {MAX_ELECTRONS:g} electrons, so a must be 0, or "
            f"at least {span / MAX_ELECTRONS:g}"
        )


def _check_electrons(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Refuse heat that sets free more electrons than can be counted."""
    seconds = highest(law("scene.exposure_s", scene.exposure_s, SCENE_LAWS))
    celsius = highest(law("scene.temperature_c", scene.temperature_c, SCENE_LAWS))
    for key in ("dark_e_per_s", "hot_pixel_e_per_s"):
        rate = Decimal((getattr(noise, key) or 0.0) * seconds)
        doublings = (Decimal(celsius) - Decimal(noise.dark_reference_c)) / Decimal(noise.dark_doubling_c)
        most = (Decimal(MAX_ELECTRONS) / 8).ln()  # a hot pixel has up to 8 times the mean
        if rate > 0 and rate.ln() + doublings * Decimal(2).ln() > most:
            raise ConfigError(
                f"noise.{key}={getattr(noise, key)}: more than {MAX_ELECTRONS:g} electrons in {seconds:g} s at "
                f"{celsius:g} degrees Celsius"
            )


def _check_gain(key: str, noise: NoiseConfig, branch: BranchConfig) -> None:
    """Refuse a gain of 0, and one so small that white is more electrons than can be counted."""
    assert noise.white_level_dn is not None and noise.black_level_dn is not None
    gain = branch.dn_per_e
    if isinstance(gain, list):
        gain = gain[1] * branch.iso[0] + (gain[2] if len(gain) > 2 else 0.0)
    if not gain * MAX_ELECTRONS >= noise.white_level_dn - noise.black_level_dn:
        raise ConfigError(f"{key}={_text(branch.dn_per_e)}: expected a gain above 0, at which white is countable")


def _check_form(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if _is_number(value) and value >= 0:
        return
    form, numbers = (value[0], value[1:]) if isinstance(value, list) and value else (None, [])
    if form not in allowed:
        raise ConfigError(f"{key}={_text(value)}: expected a number of 0 or more, or a form: {', '.join(allowed)}")
    fewest, most = FORM_NUMBERS[form]
    if not (fewest <= len(numbers) <= most and all(_is_number(number) and abs(number) <= 1e9 for number in numbers)):
        raise ConfigError(f"{key}={_text(value)}: {form} takes {fewest} to {most} finite numbers")
    if form in ("per_iso", "root") and (numbers[0] < 0 or min(numbers) < 0):
        raise ConfigError(f"{key}={_text(value)}: expected numbers of 0 or more")


def _check_black_error(key: str, value: Any) -> None:
    if value is None or _is_number(value):
        return
    by_iso = isinstance(value, list) and bool(value) and value[0] == "by_log_iso"
    rows = value[1:] if by_iso else [value]
    if not rows or not all(isinstance(row, list) and len(row) == 4 and all(map(_is_number, row)) for row in rows):
        raise ConfigError(
            f"{key}={_text(value)[:60]}: expected a number, four (the 2x2 sites), or [by_log_iso, [four], …]"
        )


def _check_iso(noise: NoiseConfig, scene: SceneConfig) -> None:
    """Refuse an ISO at which nothing was calibrated, whether it is named, drawn or comes with the scene."""
    key, value = ("scene.iso", scene.iso) if noise.iso is None else ("noise.iso", noise.iso)
    drawn = law(key, value, SCENE_LAWS)
    ends = drawn.numbers
    inside = all(branch_of(noise, iso) is not None for iso in ends)
    if inside and drawn.kind not in ("constant", "choice"):
        inside = any(branch.iso[0] <= min(ends) and max(ends) <= branch.iso[1] for branch in noise.branches)
    if not inside:
        ranges = ", ".join(
            f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in (b.iso for b in noise.branches)
        )
        way = "" if noise.iso is not None else f" (that of scene={scene.name}); give noise.iso=…"
        raise ConfigError(f"{key}={_text(value)}: noise={noise.name} is calibrated for ISO {ranges}{way}")


def _check_scene(scene: SceneConfig) -> None:
    _check_name("scene.name", scene.name)
    for key, low, high in (("exposure_s", 1e-7, 1e5), ("temperature_c", -100.0, 150.0), ("exposure_ratio", 1e-3, 1e6)):
        drawn = law(f"scene.{key}", getattr(scene, key), SCENE_LAWS)
        if not low <= lowest(drawn) <= highest(drawn) <= high:
            raise ConfigError(f"scene.{key}={_text(getattr(scene, key))}: expected {low:g} to {high:g}")


EFFECT_NUMBERS = {
    "prnu": ("prnu_std",),
    "dark_current": ("dark_e_per_s",),
    "hot_pixels": ("hot_pixel_share", "hot_pixel_e_per_s"),
    "full_well": ("full_well_e",),
    "dead_pixels": ("dead_pixel_share",),
}
"""The numbers of a profile that an effect cannot do without."""

BRANCH_NUMBERS = {"row": "row_std_dn", "column": "column_std_dn", "black_error": "black_error_dn"}
"""The same, of those that depend on ISO."""


def lacks(noise: NoiseConfig, effect: str) -> str | None:
    """Return a number that a physical profile would have to give for an effect and does not; None if all is there."""
    missing = (key for key in EFFECT_NUMBERS.get(effect, ()) if getattr(noise, key) is None)
    if effect in BRANCH_NUMBERS and any(getattr(branch, BRANCH_NUMBERS[effect]) is None for branch in noise.branches):
        return BRANCH_NUMBERS[effect]
    return next(missing, None)


def effect_switch(effects: EffectsConfig, effect: str) -> str:
    """Return auto, on or off for an effect: what is said of it by name, else what ``all`` says."""
    said = getattr(effects, effect) or effects.all
    return YAML_SWITCHES.get(said, said)


def _check_effects(config: Config) -> None:
    effects = config.effects
    _one_of("effects.all", YAML_SWITCHES.get(effects.all, effects.all), SWITCHES)
    if not 0 < effects.tolerance <= 10:
        raise ConfigError(f"effects.tolerance={effects.tolerance}: expected more than 0, up to 10")
    for effect in (one.name for one in dataclasses.fields(effects) if one.name not in ("all", "tolerance")):
        switch = getattr(effects, effect)
        if switch is None:
            continue
        _one_of(f"effects.{effect}", YAML_SWITCHES.get(switch, switch), SWITCHES)
        if effect_switch(effects, effect) == "on" and effect != "quantise":
            _check_switched_on(config, effect)


def budget(accuracy: AccuracyConfig) -> Budget:
    """Return the budget that the settings give."""
    return Budget(**dataclasses.asdict(accuracy))


def _check_accuracy(config: Config) -> None:
    _check_name("accuracy.name", config.accuracy.name)
    for key in ("clean_dn", "clean_changed_share", "normal_error", "law_distance"):
        value = getattr(config.accuracy, key)
        if not (math.isfinite(value) and value >= 0):
            raise ConfigError(f"accuracy.{key}={value}: expected a number of 0 or more")
    choose(budget(config.accuracy), uses_physics(config.noise), is_normalised(config))


NO_CLIP = "none"
"""What `sensor.clip` says where noisy frames are not clipped."""


def is_normalised(config: Config) -> bool:
    """Whether frames are float32, 0 at black and 1 at white, and not rounded."""
    return config.output.dtype == FLOAT32


def _check_output(config: Config) -> None:
    """Refuse a dtype that cannot hold what is asked for: integers are rounded and clipped, floats are not rounded."""
    _one_of("output.dtype", config.output.dtype, (UINT16, FLOAT32))
    _one_of("output.layout", config.output.layout, (MOSAIC, PACKED))
    said = config.effects.quantise is not None and effect_switch(config.effects, "quantise")
    if is_normalised(config):
        if said == "on":
            raise ConfigError("effects.quantise=on: output.dtype=float32 is not rounded; say output.dtype=uint16")
        return
    if said == "off":
        raise ConfigError(
            "effects.quantise=off: integer output is always rounded and clipped; output.dtype=float32 is not rounded"
        )
    if config.sensor.clip == NO_CLIP:
        raise ConfigError(
            "sensor.clip=none: output.dtype=uint16 holds nothing beyond the sensor's ends; say output.dtype=float32"
        )


SWITCHES = ("auto", "on", "off")
YAML_SWITCHES = {"True": "on", "False": "off"}
"""What YAML makes of an unquoted on and off in a file."""


def _check_switched_on(config: Config, effect: str) -> None:
    noise = config.noise
    if (effect == "heteroscedastic") == is_physical(noise):
        offers = "the physical effects" if is_physical(noise) else "heteroscedastic only"
        raise ConfigError(f"effects.{effect}=on: noise={noise.name} offers {offers}")
    number = lacks(noise, effect)
    if number is not None:
        raise ConfigError(
            f"effects.{effect}=on: noise={noise.name} gives no {number}; set noise.{number}, or leave it off"
        )


def _check_calibration(noise: NoiseConfig) -> None:
    levels = (noise.bits, noise.black_level_dn, noise.white_level_dn)
    if any(level is None for level in levels):
        raise ConfigError(
            f"noise.units=dn: {noise.name} must say the bits, black_level_dn and white_level_dn it was calibrated at, "
            f"got {', '.join(_text(level) for level in levels)}"
        )
    assert noise.bits is not None and noise.black_level_dn is not None and noise.white_level_dn is not None
    _in_range("noise.bits", noise.bits, 1, 32)
    _in_range("noise.black_level_dn", noise.black_level_dn, 0, 2**noise.bits - 2)
    _in_range("noise.white_level_dn", noise.white_level_dn, noise.black_level_dn + 1, 2**noise.bits - 1)


def _black_share(noise: NoiseConfig) -> float:
    """What the variance at black gains by an included black level, at the least, in the profile's own DN²."""
    if noise.black != "included" or noise.black_level_dn is None:
        return 0.0
    return lowest(law("noise.a", noise.a, A_LAWS)) * noise.black_level_dn


def _check_name(key: str, name: str) -> None:
    if not NAME.fullmatch(name):
        raise ConfigError(f"{key}={name[:40]!r}: expected up to 100 letters, digits, and . _ + -")


def _one_of(key: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"{key}={_text(value)}: expected one of {', '.join(allowed)}")


def _in_range(key: str, value: int, low: int, high: int, remark: str = "") -> None:
    if not low <= value <= high:
        raise ConfigError(f"{key}={value}: expected {low} to {high}{remark}")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_text(item) for item in value) + "]"
    return "null" if value is None else str(value)


# ----------------------------------------------------------------------------------------- the dataset's config.yaml

NOT_DATA = {"": ("out", "n_jobs", "self_test"), "source": ("root", "max_failed")}
"""Keys that do not decide a dataset's bytes, by group; its ``config.yaml`` leaves them out."""


NUMBERS_OR_LAWS = {
    "gains": ("red", "blue", "inverse_rgb"),
    "noise": ("a", "b", "iso"),
    "isp": ("gamma",),
    "scene": ("iso", "exposure_s", "temperature_c", "exposure_ratio"),
}
"""Keys whose numbers can be spelled in two ways, 1 and 1.0."""


def source_kind(config: Config) -> str:
    """Return ``folder`` or ``synthetic``: derived, so that a dataset remembers which it was."""
    return "synthetic" if config.source.root is None else "folder"


def dataset_yaml(config: Config) -> str:
    """Return the text of a dataset's ``config.yaml``: all that decides its bytes, in one spelling."""
    groups = dataclasses.asdict(config)
    settings = {key: value for key, value in groups.items() if key not in NOT_DATA[""]}
    settings["source"] = {"kind": source_kind(config)} | {
        key: value for key, value in groups["source"].items() if key not in NOT_DATA["source"]
    }
    settings["source"]["patch"] = _patch_setting(config.source)
    for group, keys in NUMBERS_OR_LAWS.items():
        settings[group] = {key: _canonical(value) if key in keys else value for key, value in groups[group].items()}
    return yaml.safe_dump({"seed": settings.pop("seed"), **settings}, sort_keys=False, allow_unicode=True, width=120)


def _canonical(value: Any) -> Any:
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return float(value) if _is_number(value) else value


def read_dataset_yaml(path: Path) -> tuple[Config, str]:
    """Return the settings a dataset was made with and its source kind; ConfigError where the file cannot be read."""
    from omegaconf import OmegaConf  # heavy, and a run whose settings are composed elsewhere has no use for it
    from omegaconf.errors import OmegaConfBaseException

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
        kind = str(loaded["source"].pop("kind"))
        config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Config), loaded))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; expected the config.yaml of a dataset") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise ConfigError(f"{path}: not the config.yaml of a dataset ({one_line(error)})") from error
    assert isinstance(config, Config)
    return config, kind


def read_option(path: Path, group: type[Option]) -> Option:
    """Return an option of a group as its file in ``conf/`` has it; ``group`` is the dataclass of the folder."""
    from omegaconf import OmegaConf

    option = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(group), OmegaConf.load(path)))
    assert isinstance(option, group)
    return option


def differences(ours: str, theirs: str) -> list[str]:
    """Return what differs between two ``config.yaml`` texts, as ``key=value (there: value)``."""
    here, there = _flat(yaml.safe_load(ours)), _flat(yaml.safe_load(theirs))
    return [
        f"{key}={_text(here.get(key))} (there: {_text(there.get(key))})"
        for key in sorted(here.keys() | there.keys())
        if here.get(key) != there.get(key)
    ]


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(settings, dict):
        return {prefix.rstrip("."): settings}
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{prefix}{key}.")
    return flat


def one_line(error: BaseException) -> str:
    """Return an exception's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__
