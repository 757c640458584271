"""Generate clean and noisy raw pairs from sRGB photographs.

``load_config`` composes a config, ``make_pair`` makes a pair from an array, ``generate`` a dataset from files,
``RawPairs`` reads datasets, ``LivePairs`` makes pairs while a training runs, and ``CameraNoise`` adds noise to sRGB
pictures. The command line is ``gen-dataset``.

Names are imported on first access. ``RawPairs`` needs only NumPy and xxhash.
"""

from __future__ import annotations

import importlib

TYPE_CHECKING = False  # as `typing` has it, whose import takes most of the time until the command handles Ctrl-C
if TYPE_CHECKING:
    from typing import Any

    from unprocess_gen.api import RawPair, develop, generate, make_pair, plan_image, replay, verify
    from unprocess_gen.camera_fit import CameraFit
    from unprocess_gen.camera_noise import CameraNoise
    from unprocess_gen.config.composition import load_config
    from unprocess_gen.config.schema import Config
    from unprocess_gen.core.errors import (
        ConfigError,
        DamageError,
        LockedError,
        MachineError,
        SourceError,
        UnprocessGenError,
    )
    from unprocess_gen.dataset.clips import Clip, RawClips
    from unprocess_gen.dataset.flow import flow
    from unprocess_gen.dataset.inputs import flip
    from unprocess_gen.dataset.reader import RawPairs, Sample
    from unprocess_gen.dataset.sampler import EpochSampler
    from unprocess_gen.dataset.training import noise_std, pack, to_light
    from unprocess_gen.pipeline.live import LivePairs, LiveSample
    from unprocess_gen.simulation.plan import Plan

__version__ = "1.0.0rc1"

__all__ = [
    "CameraFit",
    "CameraNoise",
    "Clip",
    "Config",
    "ConfigError",
    "DamageError",
    "EpochSampler",
    "LivePairs",
    "LiveSample",
    "LockedError",
    "MachineError",
    "Plan",
    "RawClips",
    "RawPair",
    "RawPairs",
    "Sample",
    "SourceError",
    "UnprocessGenError",
    "__version__",
    "develop",
    "flip",
    "flow",
    "generate",
    "load_config",
    "make_pair",
    "noise_std",
    "pack",
    "plan_image",
    "replay",
    "to_light",
    "verify",
]

_MODULES = {
    "api": ("RawPair", "develop", "generate", "make_pair", "plan_image", "replay", "verify"),
    "camera_fit": ("CameraFit",),
    "camera_noise": ("CameraNoise",),
    "config.composition": ("load_config",),
    "config.schema": ("Config",),
    "core.errors": (
        *("ConfigError", "DamageError", "LockedError", "MachineError", "SourceError", "UnprocessGenError"),
    ),
    "dataset.clips": ("Clip", "RawClips"),
    "dataset.flow": ("flow",),
    "dataset.inputs": ("flip",),
    "dataset.reader": ("RawPairs", "Sample"),
    "dataset.sampler": ("EpochSampler",),
    "dataset.training": ("noise_std", "pack", "to_light"),
    "pipeline.live": ("LivePairs", "LiveSample"),
    "simulation.plan": ("Plan",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a name on first access (PEP 562), so that importing the package takes no time."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
