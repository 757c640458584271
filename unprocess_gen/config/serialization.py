"""Write the configuration to ``config.yaml`` and read it back."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

import yaml

from unprocess_gen.config.derived import patch_setting
from unprocess_gen.config.schema import Config
from unprocess_gen.config.values import is_number, value_text
from unprocess_gen.core.errors import ConfigError

Option = TypeVar("Option")


NOT_DATA = {"": ("out", "n_jobs", "self_test", "check_disk"), "source": ("root", "max_failed")}
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
    settings["source"]["patch"] = patch_setting(config.source)
    for group, keys in NUMBERS_OR_LAWS.items():
        settings[group] = {key: _canonical(value) if key in keys else value for key, value in groups[group].items()}
    return yaml.safe_dump({"seed": settings.pop("seed"), **settings}, sort_keys=False, allow_unicode=True, width=120)


def _canonical(value: Any) -> Any:
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return float(value) if is_number(value) else value


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
        raise ConfigError(f"{path}: not the config.yaml of a dataset ({error_in_one_line(error)})") from error
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
        f"{key}={value_text(here.get(key))} (there: {value_text(there.get(key))})"
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


def error_in_one_line(error: BaseException) -> str:
    """Return an exception's message on one line."""
    return " ".join(str(error).split()) or type(error).__name__
