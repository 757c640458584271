"""Declare the settings under which fields of a plan are columns of a manifest."""

from fnmatch import fnmatch
from typing import Any

from unprocess_gen.core.arrays import FLOAT32
from unprocess_gen.core.fields import Condition

RAW = Condition("source.kind is not raw", lambda config: config.source.kind == "raw")
LINEAR = Condition("source.kind is not linear", lambda config: config.source.kind == "linear")
PHOTOGRAPHS = Condition(
    "the sources are no photographs",
    lambda config: config.source.place is not None and config.source.kind == "srgb",
)
PROFILES = Condition(
    f"source.icc is not convert, or {PHOTOGRAPHS.unless}",
    lambda config: config.source.icc == "convert" and PHOTOGRAPHS.holds(config),
)
HEIF_NAMES = "x.heic", "x.heif", "x.hif", "x.avif"
DECODED = Condition(
    "the sources are neither linear nor photographs, or source.include has no pattern of HEIC or AVIF files",
    lambda config: (
        LINEAR.holds(config)
        or (
            PHOTOGRAPHS.holds(config)
            and any(fnmatch(name, pattern.lower()) for pattern in config.source.include for name in HEIF_NAMES)
        )
    ),
)
BURSTS = Condition("source.burst is null", lambda config: config.source.burst is not None)
CLIPS = Condition(
    f"source.clips is false, and {BURSTS.unless}", lambda config: config.source.clips or BURSTS.holds(config)
)
LIGHT = Condition(f"{LINEAR.unless}, and {BURSTS.unless}", lambda config: LINEAR.holds(config) or BURSTS.holds(config))
SPLITS = Condition("split is null", lambda config: config.split is not None)
LIGHTS = Condition("gains.light is null", lambda config: config.gains.light is not None)
PHYSICAL = Condition("the noise profile is not physical", lambda config: bool(config.noise.branches))
SHADING = Condition("the noise profile has no lens_shading", lambda config: config.noise.lens_shading is not None)
DARK_FRAMES = Condition(
    "noise.dark_frames is null", lambda config: config.noise.dark_frames or config.noise.dark_frames_sha256
)
FLOAT_CLEAN = Condition(
    "clean and noisy frames have one dtype", lambda config: config.output.clean_dtype == FLOAT32 != config.output.dtype
)


def noisy_frames(config: Any) -> int:
    """Number of noisy frames of each clean frame."""
    levels = config.noise.levels
    return int(config.noise.draws * (1 if levels is None else levels if isinstance(levels, int) else len(levels)))


NOISY_FRAMES = Condition("each image has one noisy frame", lambda config: noisy_frames(config) > 1)
