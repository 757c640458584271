"""Photon transfer: the fitted noise of a dataset agrees with its rows, and wrong rows are detected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.promise_report import Figure

from unprocess_gen import RawPairs, make_pair
from unprocess_gen.reports import photon_transfer


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    out = tmp_path_factory.mktemp("transfer") / "ds"
    make(None, out, "source.limit=3")
    return out


def test_every_pair_agrees_with_its_row(scenes: Path, figure: Figure) -> None:
    found = list(photon_transfer.iterate_fits(scenes))
    assert len(found) == 3
    assert max(one.deviation for one in found) < 5
    figure("photon-transfer", f"{len(found)} pairs within {max(one.deviation for one in found):.1f} standard errors")


@pytest.mark.parametrize(
    "overrides",
    [
        ("noise=brooks2019",),
        ("noise.law=poisson",),
        ("noise=imx385", "noise.iso=12800", "effects.all=on", "effects.hot_pixels=off", "effects.dead_pixels=off"),
        ("noise=sony_a7s2", "scene=low_light"),
        ("noise=oppo_reno10x", "noise.iso=1600", "sensor=generic_10bit"),
    ],
)
def test_every_kind_of_noise_agrees_with_its_row(
    overrides: tuple[str, ...], make: Make, tmp_path: Path, figure: Figure
) -> None:
    make(None, tmp_path / "ds", "source.limit=2", *overrides)
    found = list(photon_transfer.iterate_fits(tmp_path / "ds"))
    assert len(found) == 2
    assert max(one.deviation for one in found) < 5
    figure("photon-transfer", f"{len(found)} pairs within {max(one.deviation for one in found):.1f} standard errors")


@pytest.mark.parametrize(("column", "factor"), [("a_dn", 1.05), ("a_dn", 0.95), ("b_dn2", 1.8), ("b_dn2", 0.2)])
def test_wrong_numbers_in_a_row_are_detected(scenes: Path, column: str, factor: float) -> None:
    clean, noisy, row = RawPairs(scenes)[0]
    found = photon_transfer.fit_pair(clean, noisy, row | {column: row[column] * factor})
    assert found is not None
    assert found.deviation > 6


def test_standard_errors_match_the_spread_of_repeated_draws(make: Make, tmp_path: Path) -> None:
    """The variance of 16 draws over the squared standard error follows chi squared with 15 degrees of freedom."""
    make(None, tmp_path / "ds", "source.limit=1", "noise.draws=16")
    found = list(photon_transfer.iterate_fits(tmp_path / "ds"))
    for value, error in (("slope", "slope_error"), ("intercept", "intercept_error")):
        spread = np.var([getattr(one, value) for one in found], ddof=1) / found[0].__getattribute__(error) ** 2
        assert 0.2 < spread < 2.7


def test_pair_without_a_range_of_signals_has_no_fit(settings: Settings) -> None:
    pair = make_pair(np.full((64, 64, 3), 90, dtype=np.uint8), settings("camera=identity", "gains=unity"))
    assert photon_transfer.fit_pair(pair.clean, pair.noisy, pair.row) is None


@pytest.mark.parametrize(
    "overrides",
    [("noise=none",), ("effects.heteroscedastic=off",), ("noise=heteroscedastic", "noise.a=0.02", "noise.b=0.01")],
)
def test_noise_below_rounding_is_not_damage(
    overrides: tuple[str, ...], make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    """Below 1 DN, rounding errors depend on the noise."""
    make(None, tmp_path / "ds", "source.limit=1", *overrides)
    done = run_main("verify", tmp_path / "ds", "--noise")
    assert (done.code, done.err) == (0, "")


def test_negative_variance_at_black_is_not_damage(make: Make, run_main: RunMain, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "noise=imx385_iso3200_rvdd")
    done = run_main("verify", tmp_path / "ds", "--noise")
    assert (done.code, done.err) == (0, "")


def test_verify_reports_the_pair_farthest_from_its_row(scenes: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("verify", scenes, "--noise", "--to", tmp_path / "curves.png")
    assert done.code == 0
    assert "noise of 3 pairs fitted" in done.out
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"
