"""Check a configuration before the first image, so that no run fails on a value that was wrong from the start.

The schema declares the limits of single values. The functions below check values that depend on each other. Noise
profiles: `noise_validation`.
"""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from importlib.util import find_spec

from unprocess_gen.config.accuracy import choose_methods
from unprocess_gen.config.distributions import parse_drawn
from unprocess_gen.config.interpretation import (
    NO_CLIP,
    accuracy_budget,
    effect_switch,
    has_float_clean,
    is_normalised,
    is_physical,
    missing_number,
    noise_levels,
    patch_rule,
    shading_place,
    uses_dark_frames,
    uses_physics,
)
from unprocess_gen.config.limits import CAMERA_LAWS, ISO, SWITCH, Drawn, LevelRange
from unprocess_gen.config.noise_validation import check_noise, well_ends_first
from unprocess_gen.config.schema import (
    PHYSICAL,
    CameraConfig,
    Config,
    EffectsConfig,
    ExecutorConfig,
    NoiseConfig,
    OutputConfig,
    SourceConfig,
    all_settings,
)
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import one_of, value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import StoreAccessError
from unprocess_gen.core.paths import any_path, local_path
from unprocess_gen.core.types import UINT16
from unprocess_gen.simulation.effects import REPLACED
from unprocess_gen.simulation.reference import colour

CHECKED_WHERE_USED = ("scene.iso", "noise.iso", "noise.a", "noise.b", "noise.bits")
"""Settings that `noise_validation` checks if the noise profile uses them, as version 0.1 did.

Recorded configs may contain any other value of them, and their datasets must stay usable.
"""

SWITCHES = tuple(
    name for name, setting in settings_of(EffectsConfig).items() if setting.limit is SWITCH and name != "all"
)
"""Effects that have a switch of their own."""

SEED = settings_of(Config)["seed"]

_DIGEST = re.compile("[0-9a-f]{64}")

# --------------------------------------------------------------------------------------------------- public functions


def validate_config(config: Config) -> None:
    """Check a configuration before a run: its values, and whether they fit this machine."""
    check_values(config)
    _check_environment(config)
    check_parquet(config.output)
    _check_dark_folder(config.noise)


def check_values(config: Config) -> None:
    """Check the values of a configuration, composed or recorded, independent of files and installed packages."""
    SEED.check("seed", config.seed)
    _check_values(replace(config, seed=0))


@functools.lru_cache(maxsize=64)
def _check_values(config: Config) -> None:
    """Check all values but the seed, once for each config: `unprocess_gen.make_pair` checks it in every call."""
    _check_settings(config)
    _check_source(config.source)
    _check_camera(config.camera)
    for noise in noise_levels(config.noise):
        check_noise(noise, config.scene)
    _check_levels(config)
    _check_dark_frames(config)
    _check_effects(config)
    choose_methods(
        accuracy_budget(config.accuracy), uses_physics(config.noise), is_normalised(config), has_float_clean(config)
    )
    _check_output(config)
    _check_executor(config.executor)


def check_parquet(output: OutputConfig) -> None:
    """Check that pyarrow is installed if ``manifest.parquet`` is wanted."""
    if output.parquet and find_spec("pyarrow") is None:
        raise ConfigError(
            "output.parquet=true: needs pyarrow; in the source folder, run: pip install '.[parquet]', or set "
            "output.parquet=false"
        )


def _check_settings(config: Config) -> None:
    """Check each value against the limit that the schema declares for it, except values that the profile ignores."""
    physical = is_physical(config.noise)
    for group, name, setting in all_settings():
        values = getattr(config, group) if group else config
        key, value, limit = f"{group}.{name}".lstrip("."), getattr(values, name), setting.limit
        if key in CHECKED_WHERE_USED or (setting.section == PHYSICAL and not physical):
            continue
        if isinstance(limit, Drawn) and not (value is None and setting.null):
            parse_drawn(key, value, limit)
        elif isinstance(limit, LevelRange) and group == "sensor":
            limit.check_in(key, value, values)
        else:
            setting.check(key, value)


# ---------------------------------------------------------------------------------------- source, camera and sensor


def _exists(root: str) -> bool:
    try:
        return any_path(root).exists()
    except StoreAccessError as error:
        raise ConfigError(f"source.root={error}") from None


def _check_environment(config: Config) -> None:
    source = config.source
    if source.root == "":
        raise ConfigError("source.root='': expected a folder or file; null selects the built-in scenes")
    if source.root is not None and not _exists(source.root):
        raise ConfigError(
            f"source.root={source.root}: no such folder or file; expected photographs, or null for the built-in scenes"
        )
    if source.clips and source.root is None:
        raise ConfigError(
            "source.clips=true: the built-in scenes are not clips; expected folders or videos; give source.root=…"
        )
    if source.icc == "refuse" and find_spec("PIL") is None:
        raise ConfigError("source.icc=refuse: needs Pillow to read colour profiles; pip install pillow")
    if config.executor.kind == "dask" and find_spec("distributed") is None:
        raise ConfigError(
            "executor.kind=dask: needs Dask; in the source folder, run: pip install '.[dask]', or set executor=local"
        )


def _check_source(source: SourceConfig) -> None:
    if not source.include and not (source.clips and source.video):
        raise ConfigError("source.include=[]: expected at least one pattern such as '*.jpg'")
    patch_rule(source)


def _check_camera(camera: CameraConfig) -> None:
    if camera.law == "fixed":
        one_of("camera.name", camera.name, tuple(colour.CAMERAS))
    elif camera.law != "custom":
        one_of("camera.name", camera.name, (camera.law,))
    if camera.law != "custom":
        if camera.xyz2cam is not None:
            raise ConfigError(
                f"camera.xyz2cam={value_text(camera.xyz2cam)}: a matrix needs camera.law=custom, not {camera.law}; "
                "set camera=custom"
            )
        return
    if camera.xyz2cam is None:
        raise ConfigError(
            "camera.xyz2cam=null: camera=custom needs a matrix; expected nine numbers, XYZ to camera, row by row"
        )
    try:
        colour.rgb2cam(colour.matrix(camera.xyz2cam))
    except ValueError as error:
        raise ConfigError(f"camera.xyz2cam={value_text(camera.xyz2cam)}: {error}") from error
    if camera.name in (*colour.CAMERAS, *CAMERA_LAWS.words) and camera.name != "custom":
        raise ConfigError(f"camera.name={camera.name}: is the name of an existing camera; expected a new name")


# ------------------------------------------------------------------------------------------------------ noise levels


def _check_levels(config: Config) -> None:
    noise = config.noise
    if len(noise_levels(noise)) == 1:
        return
    if effect_switch(config.effects, "full_well") != "off" and any(
        well_ends_first(level, config.scene) for level in noise_levels(noise)
    ):
        raise ConfigError(
            f"noise.levels={value_text(noise.levels)}: noise.full_well_e={value_text(noise.full_well_e)} ends below "
            "white there, so the clean frame depends on the ISO; expected one level; leave noise.levels out, or set "
            "effects.full_well=off"
        )
    if config.clean.includes_fixed_pattern:
        raise ConfigError(
            "clean.includes_fixed_pattern=true: the fixed pattern depends on the ISO; expected one level; leave "
            "noise.levels out"
        )


# ------------------------------------------------------------------------------------------------------ dark frames


def _check_dark_frames(config: Config) -> None:
    noise, name = config.noise, value_text(config.noise.dark_frames or config.noise.dark_frames_sha256)
    if not uses_dark_frames(noise):
        for key, default in (("dark_shading", "keep"), ("dark_shading_sha256", None), ("dark_frames_black_dn", None)):
            if getattr(noise, key) != default:
                value = value_text(getattr(noise, key))
                raise ConfigError(f"noise.{key}={value}: there are no dark frames; give noise.dark_frames=FOLDER")
        return
    for key in ("dark_frames_sha256", "dark_shading_sha256"):
        digest = getattr(noise, key)
        if digest is not None and not _DIGEST.fullmatch(digest):
            raise ConfigError(f"noise.{key}={value_text(digest)[:80]}: expected 64 hexadecimal digits, or null")
    if noise.dark_shading == "remove" and noise.dark_shading_sha256 is not None:
        raise ConfigError(
            "noise.dark_shading=remove: noise.dark_shading_sha256 names a map; expected its place, or no digest"
        )
    if not is_physical(noise):
        raise ConfigError(
            f"noise.dark_frames={name}: noise={noise.name} gives no DN per electron, from which shot noise follows; "
            "expected a physical profile"
        )
    for level in noise_levels(noise):
        iso = config.scene.iso if level.iso is None else level.iso
        if parse_drawn("iso", iso, ISO).kind != "constant" or level.iso != noise.iso:
            raise ConfigError(
                f"noise.dark_frames={name}: the frames are of one ISO, and the run has several; expected one; set "
                "noise.iso to that of the frames, and leave noise.levels out"
            )
    if config.clean.includes_fixed_pattern:
        raise ConfigError(
            "clean.includes_fixed_pattern=true: dark frames do not separate the fixed pattern from the noise; "
            "expected false; noise.dark_shading=remove subtracts their mean"
        )
    for effect in REPLACED:
        if getattr(config.effects, effect) and effect_switch(config.effects, effect) == "on":
            raise ConfigError(f"effects.{effect}=on: the dark frames contain it; expected auto or off")
    if config.effects.read and effect_switch(config.effects, "read") == "off":
        raise ConfigError("effects.read=off: dark frames replace the read noise; expected auto, or no dark frames")


def _check_dark_folder(noise: NoiseConfig) -> None:
    """Raise ConfigError if dark frames or the map of a recorded config are not given, or do not exist."""
    if noise.dark_frames is None and noise.dark_frames_sha256 is not None:
        raise ConfigError("noise.dark_frames is missing; expected the folder of the recorded dark frames")
    if noise.dark_frames is not None:
        start = f"noise.dark_frames={noise.dark_frames}"
        refusal = f"{start}: dark frames are read from a local folder only; copy them to one"
        if not local_path(noise.dark_frames, refusal).is_dir():
            raise ConfigError(f"{start}: no such folder; expected a folder of dark frames")
    place = shading_place(noise)
    if place is None and noise.dark_shading_sha256 is not None:
        raise ConfigError("noise.dark_shading is missing; expected the place of the recorded dark-shading map")
    if place is not None:
        start = f"noise.dark_shading={place}"
        if not local_path(place, f"{start}: maps are read from a local folder only; copy them to one").exists():
            raise ConfigError(f"{start}: no such file or folder; expected keep, remove, or a dark-shading map")


# ------------------------------------------------------------------------------------------------ effects and output


def _check_effects(config: Config) -> None:
    effects = config.effects
    for effect in SWITCHES:
        if getattr(effects, effect) and effect_switch(effects, effect) == "on" and effect != "quantise":
            _check_switched_on(config, effect)


def _check_switched_on(config: Config, effect: str) -> None:
    noise = config.noise
    if (effect == "heteroscedastic") == is_physical(noise):
        offers = "the physical effects, not this one" if is_physical(noise) else "heteroscedastic only"
        raise ConfigError(f"effects.{effect}=on: noise={noise.name} offers {offers}")
    number = missing_number(noise, effect)
    if number is not None:
        raise ConfigError(
            f"effects.{effect}=on: noise={noise.name} gives no {number}; set noise.{number}, or leave it off"
        )


def _check_executor(executor: ExecutorConfig) -> None:
    if executor.address is not None and executor.kind != "dask":
        raise ConfigError(
            f"executor.address={executor.address}: executor={executor.kind} connects to no scheduler; set executor=dask"
        )


def _check_output(config: Config) -> None:
    """Raise ConfigError if the output type cannot represent the frames.

    Integers are rounded and clipped; float32 is not.
    """
    if is_normalised(config) and config.output.clean_dtype == UINT16:
        raise ConfigError(
            "output.clean_dtype=uint16: output.dtype=float32 has no rounded clean frame; expected float32 or null"
        )
    quantise = config.effects.quantise and effect_switch(config.effects, "quantise")
    if is_normalised(config):
        if quantise == "on":
            raise ConfigError("effects.quantise=on: output.dtype=float32 is not rounded; set output.dtype=uint16")
        return
    if quantise == "off":
        raise ConfigError(
            "effects.quantise=off: integer output is always rounded and clipped; set output.dtype=float32"
        )
    if config.sensor.clip == NO_CLIP:
        raise ConfigError(
            "sensor.clip=none: output.dtype=uint16 holds no values beyond the sensor's range; set output.dtype=float32"
        )
