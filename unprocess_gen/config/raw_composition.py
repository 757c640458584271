"""Compose settings of raw sources: what follows from ``source.kind``, and what does not apply to their frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from unprocess_gen.config.defaults import default_options, default_values
from unprocess_gen.config.values import value_text
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.raw_files import SUFFIXES

NOT_APPLIED = {
    "camera": "colours of a photograph; rows record the matrix of the file",
    "gains": "white balance of a photograph; rows record the gains of the file",
    "isp": "tone curve of a photograph; raw frames have none",
}
"""Groups that undo what a photograph went through."""

FILE_SENSOR = "sensor=source"
"""Override that takes the sensor of raw sources from their files."""

SENSOR_LEVELS = tuple(f"sensor.{name}" for name in ("bits", "black_level_dn", "white_level_dn", "pattern"))


def source_overrides(node: DictConfig, overrides: Sequence[str]) -> list[str]:
    """Return the overrides that follow from ``source.kind``; ConfigError for given ones that do not apply to it.

    ``node`` is composed from ``overrides``, and contains Hydra's settings.
    """
    given = {override.lstrip("+~").partition("=")[0]: override for override in overrides}
    is_raw, include = OmegaConf.select(node, "source.kind") == "raw", OmegaConf.select(node, "source.include")
    added = []
    if include is None or (is_raw and "source.include" not in given and include == default_values("source")["include"]):
        patterns = [f"*{suffix}" for suffix in SUFFIXES] if is_raw else default_values("source")["include"]
        added.append(f"source.include={value_text(list(patterns))}")
    if is_raw:
        added += _raw_overrides(node, given)
    return added


def _raw_overrides(node: Any, given: dict[str, str]) -> Iterator[str]:
    for key, override in given.items():
        if (group := key.partition(".")[0]) in NOT_APPLIED:
            raise ConfigError(f"{override}: source.kind=raw: {group} inverts the {NOT_APPLIED[group]}; remove it")
    chosen = node.hydra.runtime.choices.sensor
    if chosen == default_options()["sensor"] and "sensor" not in given:
        chosen = "source"
        yield FILE_SENSOR
    for key in SENSOR_LEVELS:
        if key in given and chosen == "source":
            raise ConfigError(f"{given[key]}: {FILE_SENSOR} takes it from each file; choose a sensor, or remove it")
    if "sensor.pattern" in given and OmegaConf.select(node, "source.shrink") == 1:
        problem = "the mosaic has the pattern of its file; set source.shrink=2, or remove it"
        raise ConfigError(f"{given['sensor.pattern']}: source.kind=raw: {problem}")
