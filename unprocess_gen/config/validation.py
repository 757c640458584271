"""Check a configuration before the first image, so that no run fails on a value that was wrong from the start.

The schema declares the limits of single values. The functions below check values that depend on each other. Noise
profiles: `noise_validation`.
"""

from __future__ import annotations

import itertools
import math
import pickle
from typing import Any

from unprocess_gen.config.interpretation import (
    UNCLIPPED,
    effect_switch,
    gain_distributions,
    is_normalised,
    is_physical,
    lights,
    missing_number,
    noise_levels,
    patch_rule,
    uses_dark_frames,
)
from unprocess_gen.config.limits import CAMERA_LAWS, GAIN_TEXT, ISO, MAX_GAIN, MIN_GAIN, SWITCH
from unprocess_gen.config.noise_validation import check_noise, well_ends_first
from unprocess_gen.config.schema import (
    CameraConfig,
    Config,
    EffectsConfig,
    Group,
)
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.source_validation import check_source
from unprocess_gen.config.values import one_of, refusal
from unprocess_gen.core.arrays import UINT16
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.object_store import StoreAccessError
from unprocess_gen.core.paths import any_path, local_path
from unprocess_gen.core.sequences import Recent
from unprocess_gen.simulation.effects import REPLACED
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.light import LIGHTS, camera_gains

SWITCHES = tuple(
    name for name, setting in settings_of(EffectsConfig).items() if setting.limit is SWITCH and name != "all"
)
"""Effects that have a switch of their own."""

MAX_TARGET_PIXELS = 2**29
"""Pixels of a source up to which its targets fit a member of a shard."""

SEED = settings_of(Config)["seed"]

# --------------------------------------------------------------------------------------------------- public functions


def validate_config(config: Config) -> None:
    """Check a configuration before a run: its values, and whether they fit this machine."""
    check_values(config)
    _check_environment(config)


def check_values(config: Config) -> None:
    """Check the values of a configuration, composed or recorded, independent of files and installed packages."""
    SEED.check("seed", config.seed, config)
    values = pickle.dumps([value for name, value in vars(config).items() if name != "seed"])
    if values not in _allowed:
        _check_values(config)
        _allowed.keep(values, True)


_allowed: Recent[bytes, bool] = Recent(64)
"""Configs without their seeds that were checked, because `unprocess_gen.make_pair` checks in every call. As bytes, 2,
2.0 and true differ."""


def _check_values(config: Config) -> None:
    """Check all values but the seed."""
    _check_settings(config)
    if not config.source.include:
        raise refusal("source.include", [], "expected at least one pattern such as '*.jpg'")
    patch_rule(config.source)
    check_source(config)
    _check_camera(config.camera)
    gain_distributions(config.gains)
    _check_lights(config)
    for noise in noise_levels(config.noise):
        check_noise(noise, config.scene)
    _check_levels(config)
    _check_dark_frames(config)
    _check_effects(config)
    _check_output(config)
    executor = config.executor
    if executor.address is not None and executor.kind != "dask":
        problem = f"executor={executor.kind} connects to no scheduler; set executor=dask"
        raise refusal("executor.address", executor.address, problem)


def _check_settings(group: Any, prefix: str = "") -> None:
    """Check each value of a group against the limit that the schema declares for it, whether it is used or not."""
    settings = settings_of(group)
    for name, value in vars(group).items():
        if name in settings:
            settings[name].check(f"{prefix}{name}", value, group)
        if isinstance(value, Group):
            _check_settings(value, f"{prefix}{name}.")
        for number, item in enumerate(value if isinstance(value, tuple) else ()):
            if isinstance(item, Group):
                _check_settings(item, f"{prefix}{name}[{number}].")


# ---------------------------------------------------------------------------------------- source, camera and sensor


def _check_environment(config: Config) -> None:
    """Check that the files, folders and optional libraries of a run exist."""
    source, noise = config.source, config.noise
    if source.list is not None:
        refused = f"source.list={source.list}: a list is a local text or CSV file; copy it to one"
        if not local_path(source.list, refused).is_file():
            raise ConfigError(f"source.list={source.list}: no such file; expected a text file with a path in each line")
    if source.root is not None:
        _check_root(source.root)
    if source.kind == "raw":
        if source.place is None:
            raise refusal("source.kind", "raw", "synthetic pictures are no frames; expected frames; give source.root=…")
        for library in ("rawpy", "tifffile"):
            require(library, f"source.kind=raw: needs {library}", "raw")
    if config.executor.kind == "dask":
        require("distributed", "executor.kind=dask: needs Dask", "dask", ", or set executor=local")
    if noise.dark_frames is not None:
        given = f"noise.dark_frames={noise.dark_frames}"
        refused = f"{given}: dark frames are read from a local folder only; copy them to one"
        if not local_path(noise.dark_frames, refused).is_dir():
            raise ConfigError(f"{given}: no such folder; expected a folder of dark frames")
    elif noise.dark_frames_sha256 is not None:
        raise ConfigError("noise.dark_frames is missing; expected the folder of the recorded dark frames")


def _check_root(root: str) -> None:
    if not root:
        raise refusal("source.root", "''", "expected a folder or file; null selects the synthetic pictures")
    try:
        exists = any_path(root).exists()
    except StoreAccessError as error:
        raise ConfigError(f"source.root={error}") from None
    if not exists:
        problem = "no such folder or file; expected photographs, or null for the synthetic pictures"
        raise ConfigError(f"source.root={root}: {problem}")


def _check_camera(camera: CameraConfig) -> None:
    matrix, weights = camera.xyz2cam, camera.weights
    if weights is not None and camera.law != "convex":
        raise refusal("camera.weights", weights, f"weights need camera.law=convex, not {camera.law}; set camera=convex")
    if weights is not None and not 0 < sum(weights) < math.inf:
        raise refusal("camera.weights", weights, "their sum is 0 or infinite; expected at least one above 0")
    if camera.law != "custom":
        one_of("camera.name", camera.name, tuple(colour.CAMERAS) if camera.law == "fixed" else (camera.law,))
        if matrix is not None:
            problem = f"a matrix needs camera.law=custom, not {camera.law}; set camera=custom"
            raise refusal("camera.xyz2cam", matrix, problem)
        return
    if matrix is None:
        problem = "camera=custom needs a matrix; expected nine numbers, XYZ to camera, row by row"
        raise refusal("camera.xyz2cam", matrix, problem)
    try:
        colour.rgb2cam(colour.matrix(matrix))
    except ValueError as error:
        raise refusal("camera.xyz2cam", matrix, str(error)) from None
    if camera.name in (*colour.CAMERAS, *CAMERA_LAWS.words) and camera.name != "custom":
        raise refusal("camera.name", camera.name, "is the name of an existing camera; expected a new name")


# ------------------------------------------------------------------------------------- noise levels and dark frames


def _check_levels(config: Config) -> None:
    noise, levels = config.noise, noise_levels(config.noise)
    if len(levels) == 1:
        return
    keeps_well = effect_switch(config.effects, "full_well") != "off"
    if keeps_well and any(well_ends_first(level, config.scene) for level in levels):
        well = f"noise.full_well_e={noise.full_well_e} ends below white there, so the clean frame depends on the ISO"
        advice = "leave noise.levels out, or set effects.full_well=off"
        raise refusal("noise.levels", noise.levels, f"{well}; expected one level; {advice}")
    if config.clean.includes_fixed_pattern:
        problem = "the fixed pattern depends on the ISO; expected one level; leave noise.levels out"
        raise refusal("clean.includes_fixed_pattern", "true", problem)


def _check_dark_frames(config: Config) -> None:
    noise = config.noise
    if not uses_dark_frames(noise):
        if (black_dn := noise.dark_frames_black_dn) is not None:
            problem = "there are no dark frames; give noise.dark_frames=FOLDER"
            raise refusal("noise.dark_frames_black_dn", black_dn, problem)
        return
    frames = noise.dark_frames or noise.dark_frames_sha256
    if not is_physical(noise):
        problem = f"noise={noise.name} gives no DN per electron, from which shot noise follows"
        raise refusal("noise.dark_frames", frames, f"{problem}; expected a physical profile")
    for level in noise_levels(noise):
        iso = config.scene.iso if level.iso is None else level.iso
        if ISO.parse("iso", iso).kind != "constant" or level.iso != noise.iso:
            problem = "the frames are of one ISO, and the run has several; expected one"
            advice = "set noise.iso to that of the frames, and leave noise.levels out"
            raise refusal("noise.dark_frames", frames, f"{problem}; {advice}")
    if config.clean.includes_fixed_pattern:
        problem = "dark frames do not separate the fixed pattern from the noise; expected false"
        raise refusal("clean.includes_fixed_pattern", "true", problem)
    for effect in REPLACED:
        if _named_switch(config, effect) == "on":
            raise refusal(f"effects.{effect}", "on", "the dark frames contain it; expected auto or off")
    if _named_switch(config, "read") == "off":
        raise refusal("effects.read", "off", "dark frames replace the read noise; expected auto, or no dark frames")


def _check_lights(config: Config) -> None:
    """Check that a camera responds to every light that may be drawn: red, green and blue above 0, gains in range."""
    if config.camera.law != "custom":
        return
    matrix = colour.matrix(config.camera.xyz2cam or ())
    for name, _ in lights(config):
        light = LIGHTS[name]
        for step, side in itertools.product(range(9), (-1, 1)):
            try:
                red, blue = camera_gains(matrix, light.xy(light.kelvin(step / 8), side))
            except ValueError as error:
                raise refusal("gains.light", name, f"{error}; expected another light or matrix") from None
            if not (MIN_GAIN <= red <= MAX_GAIN and MIN_GAIN <= blue <= MAX_GAIN):
                raise refusal("gains.light", name, f"gives gains {red:g} and {blue:g}; expected {GAIN_TEXT}")


# ------------------------------------------------------------------------------------------------ effects and output


def _named_switch(config: Config, effect: str) -> str:
    """Switch of an effect, empty unless it is set by name."""
    return effect_switch(config.effects, effect) if getattr(config.effects, effect) else ""


def _check_effects(config: Config) -> None:
    noise = config.noise
    for effect in SWITCHES:
        if _named_switch(config, effect) != "on" or effect == "quantise":
            continue
        if (effect == "heteroscedastic") == is_physical(noise):
            offers = "the physical effects, not this one" if is_physical(noise) else "heteroscedastic only"
            raise refusal(f"effects.{effect}", "on", f"noise={noise.name} offers {offers}")
        if number := missing_number(noise, effect):
            problem = f"noise={noise.name} gives no {number}; set noise.{number}, or leave it off"
            raise refusal(f"effects.{effect}", "on", problem)


def _check_output(config: Config) -> None:
    """Raise ConfigError if the output type cannot represent the frames.

    Integers are rounded and clipped; float32 is not.
    """
    quantise, output = _named_switch(config, "quantise"), config.output
    if output.targets and config.source.max_pixels > MAX_TARGET_PIXELS:
        problem = f"12 bytes a pixel could exceed 8 GiB; expected source.max_pixels up to {MAX_TARGET_PIXELS}"
        raise refusal("output.targets", output.targets, problem)
    if is_normalised(config):
        if config.output.clean_dtype == UINT16:
            problem = "output.dtype=float32 has no rounded clean frame; expected float32 or null"
            raise refusal("output.clean_dtype", UINT16, problem)
        if quantise == "on":
            raise refusal("effects.quantise", "on", "output.dtype=float32 is not rounded; set output.dtype=uint16")
    elif quantise == "off":
        problem = "integer output is always rounded and clipped; set output.dtype=float32"
        raise refusal("effects.quantise", "off", problem)
    elif config.sensor.clip == UNCLIPPED:
        problem = "output.dtype=uint16 holds no values beyond the sensor's range; set output.dtype=float32"
        raise refusal("sensor.clip", UNCLIPPED, problem)
