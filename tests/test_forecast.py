"""What a run would make, told before: which photographs are read, and when a number is exact."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import Door, fill
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Source
from unprocess_gen.reports.estimate import SAMPLE, estimate_run, format_estimate
from unprocess_gen.simulation.reference.noise import EFFECTS

Settings = Callable[..., Any]


def listing(count: int) -> tuple[Source, ...]:
    return tuple(Source(i, f"{i}.png", f"{i}.png", 1) for i in range(count))


@given(total=st.integers(1, 500), count=st.integers(1, 50))
def test_a_spread_is_as_many_different_sources_in_order(total: int, count: int) -> None:
    indices = [source.index for source in evenly_spaced(listing(total), count)]
    assert len(indices) == min(total, count)
    assert indices == sorted(set(indices))


@given(total=st.integers(1, 500), count=st.integers(1, 50))
def test_a_spread_is_even(total: int, count: int) -> None:
    indices = [source.index for source in evenly_spaced(listing(total), count)]
    gaps = [after - before for before, after in zip(indices, [*indices[1:], total], strict=True)]
    assert max(gaps) - min(gaps) <= 1
    assert indices[0] == 0


def test_few_photographs_are_all_read_and_the_bytes_exact(settings: Settings, tmp_path: Path) -> None:
    told = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE)}"), 1, read_all=False)
    assert (told.exact, len(told.looks)) == (True, SAMPLE)


def test_of_many_photographs_a_sample_is_read(settings: Settings, tmp_path: Path) -> None:
    told = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}"), 1, read_all=False)
    assert (told.exact, len(told.looks), told.sources, told.shards) == (False, SAMPLE, SAMPLE + 1, 3)


def test_all_are_read_when_asked(settings: Settings, tmp_path: Path) -> None:
    told = estimate_run(settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}"), 1, read_all=True)
    assert (told.exact, len(told.looks)) == (True, SAMPLE + 1)


def test_about_is_said_where_not_all_were_read(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', SAMPLE + 1)}")
    assert "about" in next(
        line
        for line in format_estimate(config, estimate_run(config, 1, False)).splitlines()
        if line.startswith("bytes")
    )
    assert "about" not in next(
        line for line in format_estimate(config, estimate_run(config, 1, True)).splitlines() if line.startswith("bytes")
    )


def test_time_is_divided_by_the_workers(settings: Settings, tmp_path: Path) -> None:
    told = estimate_run(settings(f"source.root={fill(tmp_path / 'p', 3)}"), 4, read_all=True)
    assert told.seconds == pytest.approx(sum(look.seconds for look in told.looks) / 4)


def test_a_photograph_that_fails_takes_no_bytes_and_keeps_its_reason(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"")
    told = estimate_run(settings(f"source.root={tmp_path / 'p'}"), 1, read_all=True)
    assert (told.bytes, told.looks[0].reason, told.looks[0].levels) == (0, "empty", ())


def test_free_bytes_are_those_of_the_nearest_folder_that_exists(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", f"out={tmp_path}/not/yet/there")
    assert estimate_run(config, 1, True).free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.1)


def test_a_forecast_of_nothing_but_failures_can_be_told(settings: Settings, tmp_path: Path) -> None:
    (fill(tmp_path / "p", 1) / "000.png").write_bytes(b"")
    config = settings(f"source.root={tmp_path / 'p'}")
    assert "fails     000.png: empty" in format_estimate(config, estimate_run(config, 1, True))


def test_skipped_effects_are_told_with_their_reason(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "noise=none")
    assert "skipped   heteroscedastic: noise=none has no variance" in format_estimate(
        config, estimate_run(config, 1, True)
    )


def test_shadows_without_noise_are_told(settings: Settings, tmp_path: Path) -> None:
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", "noise=imx385_iso3200_rvdd")
    assert "no noise up to 15.33 DN above black" in format_estimate(config, estimate_run(config, 1, True))


def test_every_noise_level_is_told(door: Door, tmp_path: Path) -> None:
    levels = "noise.levels=[{a: 1, b: 2},{a: 30, b: 900}]"
    told = door("plan", "source.limit=1", "noise=heteroscedastic", levels, f"out={tmp_path}/ds").out
    assert "a=1, b=2; a=30, b=900 (" in told
    assert "a_dn 1 to 30, b_dn2 2 to 900" in told

    told = door("plan", "source.limit=1", "noise=nikon_d850", "noise.levels=[100,6400]", f"out={tmp_path}/ds").out
    assert "ISO 100 to 6400" in told
    assert " of 2 " in told


def test_an_empty_folder_is_refused(settings: Settings, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no file matches source.include="):
        estimate_run(settings(f"source.root={tmp_path}"), 1, read_all=False)


def test_a_negative_b_without_slope_can_be_told(settings: Settings, tmp_path: Path) -> None:
    overrides = ("noise.a=0", "noise.b=-5", "noise.negative_variance=clip")
    config = settings(f"source.root={fill(tmp_path / 'p', 1)}", *overrides)
    assert "b_dn2 -5" in format_estimate(config, estimate_run(config, 1, True))


def test_of_a_physical_profile_every_effect_is_told_with_its_reason(settings: Settings, tmp_path: Path) -> None:
    config = settings("noise=sony_a7s2", "scene=night", f"source.root={fill(tmp_path / 'p', 2)}")
    told = format_estimate(config, estimate_run(config, 1, True))
    assert "scene     night: ISO 6400" in told
    assert "noise     sony_a7s2: " in told
    for effect in EFFECTS:
        assert re.search(rf"^{effect} .* [0-2] of 2 +[\d.]+ +\S", told, re.MULTILINE), effect
