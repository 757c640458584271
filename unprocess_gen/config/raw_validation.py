"""Check the settings of raw sources, and that others do not use them."""

from __future__ import annotations

import operator
from collections.abc import Iterable

from unprocess_gen.config.interpretation import is_physical, uses_dark_frames
from unprocess_gen.config.schema import Config, RawConfig, SourceConfig
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import refusal
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import value_text
from unprocess_gen.simulation.reference.cfa import MONO

PHOTOGRAPH_SETTINGS = {"downscale": 1, "dequantize": "off", "icc": "convert"}
"""Keys of the source that prepare photographs, with the value of raw sources."""
RAW_SETTINGS = {"shrink": 1, "own_noise": "keep", **{f"raw.{name}": None for name in settings_of(RawConfig)}}
"""Keys of raw sources, with the value of photographs."""


def check_raw_source(config: Config) -> None:
    """Raise ConfigError if settings of raw sources and of photographs are mixed, or contradict each other."""
    source, is_raw = config.source, config.source.kind == "raw"
    for name, value in (PHOTOGRAPH_SETTINGS if is_raw else RAW_SETTINGS).items():
        if (setting := operator.attrgetter(name)(source)) != value:
            kind, advice = ("photographs", "use source.shrink") if is_raw else ("raw sources", "set source.kind=raw")
            raise refusal(f"source.{name}", setting, f"is for {kind}; expected {value_text(value)}, or {advice}")
    if is_raw:
        if source.include == SourceConfig.include:
            problem = "the patterns of source.include are those of photographs; expected source=raw, or "
            raise refusal("source.kind", "raw", f"{problem}'- override /source: raw' in the defaults of the file")
        _check_raw_levels(config)
        _check_own_noise(config)
        if config.output.targets and source.shrink == 1:
            problem = "linear_rgb needs all colours at each site; set source.shrink=2, or remove it"
            raise refusal("output.targets", config.output.targets, problem)
    elif config.sensor.levels == "source":
        raise refusal("sensor.levels", "source", "photographs state no levels; choose a sensor, or set source.kind=raw")


NOT_APPLIED = {
    "camera": "colours of a photograph; rows record the matrix of the file",
    "gains": "white balance of a photograph; rows record the gains of the file",
    "isp": "tone curve of a photograph; raw frames have none",
}
"""Groups that undo what a photograph went through."""

SENSOR_LEVELS = tuple(f"sensor.{name}" for name in ("bits", "black_level_dn", "white_level_dn", "pattern"))


def check_raw_overrides(config: Config, overrides: Iterable[str]) -> None:
    """Raise ConfigError for overrides that do not apply to the frames of raw sources."""
    if config.source.kind != "raw":
        return
    for override in overrides:
        key = override.partition("=")[0]
        if (group := key.partition(".")[0]) in NOT_APPLIED:
            raise ConfigError(f"{override}: source.kind=raw: {group} inverts the {NOT_APPLIED[group]}; remove it")
        if key in SENSOR_LEVELS and config.sensor.levels == "source":
            raise ConfigError(f"{override}: sensor=source takes it from each file; choose a sensor, or remove it")
        if key == "sensor.pattern" and config.source.shrink == 1:
            problem = "the mosaic has the pattern of its file; set source.shrink=2, or remove it"
            raise ConfigError(f"{override}: source.kind=raw: {problem}")


def require_photographs(source: SourceConfig, caller: str) -> None:
    """Raise ConfigError if sources are raw frames and ``caller`` works on pixels of photographs only."""
    if source.kind == "raw":
        problem = f"{caller} works on pixels of photographs; expected srgb; generate a dataset of raw frames instead"
        raise refusal("source.kind", "raw", problem)


def _check_raw_levels(config: Config) -> None:
    raw = config.source.raw
    if config.sensor.pattern == MONO:
        raise refusal("sensor.pattern", MONO, "raw sources have the light behind filters; choose a Bayer pattern")
    if raw.black_dn is not None and raw.white_dn is not None and not raw.black_dn < raw.white_dn:
        raise refusal("source.raw.black_dn", raw.black_dn, f"expected less than white_dn={raw.white_dn}")
    if config.sensor.levels == "source" and uses_dark_frames(config.noise):
        problem = "dark frames are converted to the levels of one sensor; choose a sensor"
        raise refusal("sensor.levels", "source", problem)


def _check_own_noise(config: Config) -> None:
    source, noise = config.source, config.noise
    if (source.raw.a_dn is None) != (source.raw.b_dn2 is None):
        raise refusal("source.raw.a_dn", source.raw.a_dn, "expected source.raw.a_dn and source.raw.b_dn2, or none")
    if source.own_noise != "subtract":
        return
    if is_physical(noise) or noise.law != "gaussian":
        problem = f"noise={noise.name} adds Poisson counts, from which no variance can be taken away"
        raise refusal("source.own_noise", "subtract", f"{problem}; expected a profile with two numbers (a, b), or keep")
    if source.shrink != 1:
        problem = "means of green have less noise than those of red and blue; expected source.shrink=1, or keep"
        raise refusal("source.own_noise", "subtract", problem)
