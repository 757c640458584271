"""Compare a composed config with the body that it names, a real camera whose options fit together."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from unprocess_gen.config.schema import CHOSEN, GROUPS
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.values import value_text

SENSOR_KEYS = ("bits", "black_level_dn", "white_level_dn", "pattern")
"""Keys of the sensor that belong to a body; the others are chosen for a run."""


def replaced_parts(node: DictConfig, hydra: Any) -> list[str]:
    """List the settings of a composed config that take precedence over its body: ``camera=convex``, ``sensor.bits=12``.

    ``hydra`` is Hydra's part of the config, which names the chosen options and the folders of options.
    """
    choices, body = hydra.runtime.choices, hydra.runtime.choices.get("body")
    if body is None:
        return []
    folders = [Path(source.path) for source in hydra.runtime.config_sources if source.schema == "file"]
    replaced: list[str] = []
    for entry in _option(folders, "body", body).get("defaults", []):
        for group, option in ((str(key).removeprefix("override /"), value) for key, value in entry.items()):
            if choices.get(group) != option:
                replaced.append(f"{group}={choices.get(group)}")
            elif group in GROUPS:
                replaced += _changed(group, _option(folders, group, option), node[group])
    return replaced


def _option(folders: list[Path], group: str, option: str) -> dict[str, Any]:
    """Read the file of an option from the first folder that has it."""
    files = (folder / group / f"{option}.yaml" for folder in folders)
    file = next((file for file in files if file.is_file()), None)
    return {} if file is None else _file_content(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=16)
def _file_content(file: Path, modified_ns: int) -> dict[str, Any]:
    """Load a file, again only if it has changed: it takes 20 ms, for each config that a page composes."""
    content = OmegaConf.to_container(OmegaConf.load(file))
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def _changed(group: str, option: dict[str, Any], composed: DictConfig) -> Iterator[str]:
    """Yield the settings of a group that describe the camera and differ from the file of its option."""
    values = OmegaConf.to_container(composed)
    assert isinstance(values, dict)
    settings = settings_of(GROUPS[group])
    for name in SENSOR_KEYS if group == "sensor" else [key for key in option if key in settings]:
        simple = not isinstance(values[name], list) or group == "camera"
        if simple and settings[name].section != CHOSEN and values[name] != option.get(name, values[name]):
            yield f"{group}.{name}={value_text(values[name])}"
