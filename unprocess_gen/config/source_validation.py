"""Check the settings of each kind of source, and that others do not use them."""

from __future__ import annotations

import operator
from collections.abc import Iterable

from unprocess_gen.config.distributions import highest, lowest
from unprocess_gen.config.interpretation import burst_rule, is_physical, patch_rule, uses_dark_frames
from unprocess_gen.config.limits import EV, EXPOSURE_S
from unprocess_gen.config.schema import Config, RawConfig, SourceConfig
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import refusal
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import value_text
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.simulation.reference.primaries import CAMERA

KINDS = {"srgb": "photographs", "raw": "raw sources", "linear": "linear sources"}
"""Sources by ``source.kind``."""
KINDS_OF_SETTINGS = {
    "downscale": ("srgb", "linear"), "dequantize": ("srgb",), "icc": ("srgb",), "primaries": ("linear",),
    **dict.fromkeys(("shrink", "own_noise", *(f"raw.{name}" for name in settings_of(RawConfig))), ("raw",)),
}  # fmt: skip
"""Keys of the source that only some kinds use; others keep their defaults."""


def check_source(config: Config) -> None:
    """Raise ConfigError if settings of several kinds of sources are mixed, or contradict each other."""
    source, kind, unused = config.source, config.source.kind, SourceConfig()
    for name, kinds in KINDS_OF_SETTINGS.items():
        setting, default = (operator.attrgetter(name)(group) for group in (source, unused))
        if kind not in kinds and setting != default:
            users = " and ".join(KINDS[user] for user in kinds)
            advice = "use source.shrink" if kind == "raw" else f"set source.kind={kinds[0]}"
            raise refusal(f"source.{name}", setting, f"is for {users}; expected {value_text(default)}, or {advice}")
    if kind != "linear" and config.scene.ev != 0:
        problem = "photographs and raw frames are exposed already; expected 0, or scene.exposure_ratio"
        raise refusal("scene.ev", config.scene.ev, problem)
    if kind != "srgb" and source.include == SourceConfig.include:
        problem = f"the patterns of source.include are those of photographs; expected source={kind}, or "
        raise refusal("source.kind", kind, f"{problem}'- override /source: {kind}' in the defaults of the file")
    if kind == "linear" and source.primaries == CAMERA and config.sensor.pattern == MONO:
        raise refusal("sensor.pattern", MONO, "source.primaries=camera is light behind filters; choose a Bayer pattern")
    _check_burst(config)
    if kind == "raw":
        _check_raw_levels(config)
        _check_own_noise(config)
        if config.output.targets and source.shrink == 1:
            problem = "linear_rgb needs all colours at each site; set source.shrink=2, or remove it"
            raise refusal("output.targets", config.output.targets, problem)
    elif config.sensor.levels == "source":
        problem = f"{KINDS[kind]} state no levels; choose a sensor, or set source.kind=raw"
        raise refusal("sensor.levels", "source", problem)


def _check_burst(config: Config) -> None:
    """Raise ConfigError for settings with which no burst can be made."""
    source, rule, patch = config.source, burst_rule(config.source), patch_rule(config.source)
    if rule is None:
        return
    if source.kind == "raw":
        problem = "a burst needs all colours at each pixel of the moving scene; expected srgb or linear"
        raise refusal("source.kind", "raw", f"{problem}; or set source.burst=null")
    if source.clips or source.downscale != 1:
        key, value = ("clips", True) if source.clips else ("downscale", source.downscale)
        instead = "expected false" if source.clips else "expected 1; use source.burst.downscale"
        raise refusal(f"source.{key}", value, f"frames of source.burst are simulated from one picture; {instead}")
    for name, length in (("side", patch.side), ("stride", patch.stride)) if patch else ():
        if length % rule.tile:
            problem = (
                f"{name}={length} with source.burst.downscale={rule.downscale}; expected a multiple of {rule.tile}"
            )
            raise refusal("source.patch", source.patch, f"{problem} pixels, 2 x 2 sites of the sensor")
    stops, ev = rule.exposures, EV.parse("scene.ev", config.scene.ev)
    ends = lowest(ev) + min(stops), highest(ev) + max(stops)
    if not EV.numbers.low <= ends[0] <= ends[1] <= EV.numbers.high:
        problem = f"with scene.ev exposures from {ends[0]:g} to {ends[1]:g} stops; expected {EV.numbers}"
        raise refusal("source.burst.ev", list(rule.ev), f"{problem}; change scene.ev")
    if is_physical(config.noise):
        seconds, numbers = EXPOSURE_S.parse("scene.exposure_s", config.scene.exposure_s), EXPOSURE_S.numbers
        ends = lowest(seconds) * 2.0 ** min(stops), highest(seconds) * 2.0 ** max(stops)
        if not numbers.low <= ends[0] <= ends[1] <= numbers.high:
            problem = f"exposure times from {ends[0]:g} to {ends[1]:g} s; expected {numbers}; change scene.exposure_s"
            raise refusal("source.burst.ev", list(rule.ev), problem)


NOT_APPLIED = {
    "raw": {
        "camera": "camera inverts the colours of a photograph; rows record the matrix of the file",
        "gains": "gains inverts the white balance of a photograph; rows record the gains of the file",
        "isp": "isp inverts the tone curve of a photograph; raw frames have none",
    },
    "linear": {
        "isp": "isp inverts the tone curve of a photograph; scene-linear pictures have none",
        "gains.inverse_rgb": "scene-linear pictures were not brightened; use scene.ev",
        "gains.highlight": "scene-linear pictures contain their highlights",
        "gains.threshold": "scene-linear pictures contain their highlights",
    },
}
"""Groups and keys that undo what a photograph went through, by the kind of source that did not."""

SENSOR_LEVELS = tuple(f"sensor.{name}" for name in ("bits", "black_level_dn", "white_level_dn", "pattern"))


def check_overrides(config: Config, overrides: Iterable[str]) -> None:
    """Raise ConfigError for overrides that do not apply to sources of the config's kind."""
    kind = config.source.kind
    for override in overrides if kind in NOT_APPLIED else ():
        key = override.lstrip("+").partition("=")[0]
        for name in (key, key.partition(".")[0]):
            if name in NOT_APPLIED[kind]:
                raise ConfigError(f"{override}: source.kind={kind}: {NOT_APPLIED[kind][name]}; remove it")
        if kind != "raw":
            continue
        if key in SENSOR_LEVELS and config.sensor.levels == "source":
            raise ConfigError(f"{override}: sensor=source takes it from each file; choose a sensor, or remove it")
        if key == "sensor.pattern" and config.source.shrink == 1:
            problem = "the mosaic has the pattern of its file; set source.shrink=2, or remove it"
            raise ConfigError(f"{override}: source.kind=raw: {problem}")


def require_kind(source: SourceConfig, caller: str, *kinds: str) -> None:
    """Raise ConfigError if ``caller`` cannot use sources of this kind, or bursts."""
    if source.kind not in kinds:
        uses, allowed = " or ".join(KINDS[kind] for kind in kinds), " or ".join(kinds)
        problem = f"{caller} works on pixels of {uses}; expected {allowed}; generate a dataset of {KINDS[source.kind]}"
        raise refusal("source.kind", source.kind, f"{problem} instead")
    if source.burst is not None:
        problem = f"{caller} makes single frames; expected null; give the config to ug.generate or ug.LivePairs"
        raise refusal("source.burst", source.burst, problem)


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
