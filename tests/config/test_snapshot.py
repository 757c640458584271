"""Snapshots of configs: equal bytes for equal content, and no cache that outlives a change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
from helpers.datasets import Settings

from unprocess_gen.config.schema import GROUPS, Config, NoiseConfig
from unprocess_gen.config.snapshot import restored, snapshot
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.types import Facts
from unprocess_gen.planning.plan import plan_pairs

FACTS = Facts(64, 48, 256, 3, 250)
SHA256 = "ab" * 32
PHYSICAL = ("noise=sony_a7s2", "scene=night", "noise.assumed=[]")


def content(config: Config) -> bytes:
    found = snapshot(config)
    assert found is not None
    return found


@pytest.mark.parametrize("overrides", [(), PHYSICAL, ("noise=brooks2019", "seed=7")])
def test_restored_config_equals_the_original_except_its_seed(settings: Settings, overrides: tuple[str, ...]) -> None:
    config = settings(*overrides)
    again = restored(content(config))
    assert again == dataclasses.replace(config, seed=0)
    assert content(again) == content(config)
    assert not any(getattr(again, name) is getattr(config, name) for name in GROUPS)
    assert again.noise.branches is not config.noise.branches


CHANGES: dict[str, Callable[[Config], Any]] = {
    "gain": lambda config: setattr(config.gains, "red", 2.0),
    "end of a list": lambda config: config.gains.red.__setitem__(2, 2.3),
    "true in place of 1": lambda config: setattr(config.scene, "exposure_ratio", True),
    "number of a branch": lambda config: setattr(config.noise.branches[1], "dn_per_e", ["per_iso", 1e-3]),
    "ISO": lambda config: setattr(config.noise, "iso", 3200),
    "switch": lambda config: setattr(config.effects, "prnu", "on"),
    "group": lambda config: setattr(config, "noise", NoiseConfig()),
    "key at the top level": lambda config: setattr(config, "n_jobs", 3),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_any_change_gives_another_snapshot(settings: Settings, change: Callable[[Config], Any]) -> None:
    config = settings(*PHYSICAL)
    before = content(config)
    change(config)
    assert content(config) != before


def test_plan_follows_a_change_of_its_config(settings: Settings) -> None:
    config, other = settings(*PHYSICAL), settings(*PHYSICAL)
    before = plan_pairs(config, SHA256, facts=FACTS)
    for change in ("gain", "end of a list", "number of a branch", "ISO", "switch"):
        CHANGES[change](config if change != "end of a list" else other)
    assert plan_pairs(config, SHA256, facts=FACTS)[0].red_gain == 2.0
    assert plan_pairs(other, SHA256, facts=FACTS)[0].red_gain != before[0].red_gain
    assert plan_pairs(config, SHA256, facts=FACTS) != before
    assert plan_pairs(settings(*PHYSICAL), SHA256, facts=FACTS) == before


def test_change_to_a_wrong_value_is_refused_after_a_valid_one(settings: Settings) -> None:
    config = settings()
    for _ in range(2):
        validate_config(config)
        config.gains.red = "two"
        with pytest.raises(ConfigError, match=r"gains\.red=two: expected"):
            validate_config(config)
        config.gains.red = 2.0


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, "1"])
def test_wrong_seed_of_a_valid_config_is_refused(settings: Settings, seed: Any) -> None:
    config = settings()
    validate_config(config)
    config.seed = seed
    with pytest.raises(ConfigError, match=r"seed=.*: expected 0 to 9223372036854775807"):
        validate_config(config)


def test_value_that_cannot_be_pickled_is_refused_like_any_other(settings: Settings) -> None:
    config = settings()
    config.gains.red = lambda: 2.0
    assert snapshot(config) is None
    with pytest.raises(ConfigError, match=r"gains\.red=.*: expected"):
        validate_config(config)


def test_config_with_a_group_of_another_class_has_no_snapshot(settings: Settings) -> None:
    @dataclasses.dataclass
    class OwnNoise(NoiseConfig):
        pass

    config = settings("noise=imx385_iso3200")
    own = dataclasses.replace(config, noise=OwnNoise(**vars(config.noise)))
    assert snapshot(own) is None
    assert plan_pairs(own, SHA256) == plan_pairs(config, SHA256)
