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
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Optional

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from unprocess_gen import bayer, colour
from unprocess_gen.errors import ConfigError
from unprocess_gen.records import Law


@dataclass
class SourceConfig:
    """Where the photographs come from; ``root`` null stands for the built-in scenes."""

    root: Optional[str] = None
    include: list[str] = field(default_factory=list)
    recursive: bool = True
    limit: Optional[int] = None
    max_pixels: int = 2**26
    max_failed: int = 0
    icc: str = "ignore"


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
    """Bits, levels (DN), Bayer pattern, and how noisy frames are clipped."""

    bits: int = 12
    black_level_dn: int = 240
    white_level_dn: int = 4095
    pattern: str = "RGGB"
    clip: str = "sensor"


@dataclass
class NoiseConfig:
    """Variance a·x + b (numbers or laws) in ``units``, with the levels (DN) it was calibrated at."""

    name: str = "none"
    units: Optional[str] = None
    black: Optional[str] = None
    bits: Optional[int] = None
    black_level_dn: Optional[int] = None
    white_level_dn: Optional[int] = None
    a: Any = None
    b: Any = None
    negative_variance: str = "refuse"


@dataclass
class OutputConfig:
    """What the dataset is written as."""

    layout: str = "webdataset"
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
    output: OutputConfig = field(default_factory=OutputConfig)
    seed: int = 0
    out: str = "ds"
    n_jobs: int = -1
    self_test: str = "stop"


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
    if len(numbers) != len(names) or not all(_is_number(number) for number in numbers):
        raise ConfigError(f"{key}={_text(value)}: expected finite numbers: [{kind}, {', '.join(names)}]")
    complaint = rule(*numbers)
    if complaint:
        raise ConfigError(f"{key}={_text(value)}: {complaint}")
    return Law(kind, tuple(float(number) for number in numbers))


def lowest(drawn: Law) -> float:
    """Return a value that no draw of the law lies below."""
    if drawn.kind == "constant":
        return drawn.numbers[0]
    if drawn.kind == "truncated_normal":
        return drawn.numbers[2]
    if drawn.kind == "inverse_truncated_normal":
        return 1 / drawn.numbers[3] if drawn.numbers[2] > 0 else -math.inf
    return drawn.numbers[0] if drawn.kind in ("uniform", "log_uniform") else 0.0


def highest(drawn: Law) -> float:
    """Return a value that no draw of the law lies above."""
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
    _check_noise(config.noise)
    _one_of("output.layout", config.output.layout, ("webdataset",))
    _in_range("output.pairs_per_shard", config.output.pairs_per_shard, 1, MAX_PAIRS_PER_SHARD)


def _check_source(source: SourceConfig) -> None:
    if source.root == "":
        raise ConfigError("source.root='': expected a folder; null stands for the built-in scenes")
    if source.root is not None and not Path(source.root).is_dir():
        raise ConfigError(f"source.root={source.root}: no such folder; null stands for the built-in scenes")
    if not source.include:
        raise ConfigError("source.include=[]: expected at least one pattern such as '*.jpg'")
    if source.limit is not None:
        _in_range("source.limit", source.limit, 1, 10**9, " or null")
    _in_range("source.max_pixels", source.max_pixels, 1, 2**40)
    _in_range("source.max_failed", source.max_failed, 0, 10**9)
    _one_of("source.icc", source.icc, ("ignore", "refuse"))
    if source.icc == "refuse" and find_spec("PIL") is None:
        raise ConfigError("source.icc=refuse: needs Pillow to read colour profiles; pip install pillow")


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
    if sensor.clip == "none":
        raise ConfigError("sensor.clip=none: needs float output, and output.layout=webdataset writes uint16")
    _one_of("sensor.clip", sensor.clip, ("sensor", "black"))


def _check_noise(noise: NoiseConfig) -> None:
    _check_name("noise.name", noise.name)
    _one_of("noise.units", noise.units, ("dn", "normalized"))
    _one_of("noise.black", noise.black, ("subtracted", "included"))
    _one_of("noise.negative_variance", noise.negative_variance, ("refuse", "clip"))
    _, b = noise_laws(noise)
    if noise.units == "normalized":
        if noise.black == "included":
            raise ConfigError("noise.black=included: normalized units have black at 0, so it must be subtracted")
        offset = 0.0
    else:
        _check_calibration(noise)
        offset = _black_share(noise)
    if lowest(b) + offset < 0 and noise.negative_variance == "refuse":
        raise ConfigError(
            f"noise.b={_text(noise.b)}: the variance at black is {lowest(b) + offset:.6g}, below 0; "
            "say noise.negative_variance=clip if max(0, variance) is meant"
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


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_text(item) for item in value) + "]"
    return "null" if value is None else str(value)


# ----------------------------------------------------------------------------------------- the dataset's config.yaml

NOT_DATA = {"": ("out", "n_jobs", "self_test"), "source": ("root", "max_failed")}
"""Keys that do not decide a dataset's bytes, by group; its ``config.yaml`` leaves them out."""


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
    for group, keys in {"gains": ("red", "blue", "inverse_rgb"), "noise": ("a", "b"), "isp": ("gamma",)}.items():
        settings[group] = {key: _canonical(value) if key in keys else value for key, value in groups[group].items()}
    return yaml.safe_dump({"seed": settings.pop("seed"), **settings}, sort_keys=False, allow_unicode=True, width=120)


def _canonical(value: Any) -> Any:
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return float(value) if _is_number(value) else value


def read_dataset_yaml(path: Path) -> tuple[Config, str]:
    """Return the settings a dataset was made with and its source kind; ConfigError where the file cannot be read."""
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
