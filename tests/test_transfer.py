"""A dataset's noise, fitted from its arrays, is what its rows say; and a row that lies is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Door, Make

from unprocess_gen import RawPairs
from unprocess_gen.reports import photon_transfer as transfer


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    out = tmp_path_factory.mktemp("transfer") / "ds"
    make(None, out, "source.limit=3")
    return out


def test_every_pair_fits_its_row(scenes: Path) -> None:
    found = list(transfer.iterate_fits(scenes))
    assert len(found) == 3
    assert max(one.deviation for one in found) < 5


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
def test_every_kind_of_noise_fits_its_row(overrides: tuple[str, ...], make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2", *overrides)
    found = list(transfer.iterate_fits(tmp_path / "ds"))
    assert len(found) == 2
    assert max(one.deviation for one in found) < 5


@pytest.mark.parametrize(("column", "factor"), [("a_dn", 1.05), ("a_dn", 0.95), ("b_dn2", 1.8), ("b_dn2", 0.2)])
def test_a_row_whose_numbers_are_not_those_of_its_arrays_is_found(scenes: Path, column: str, factor: float) -> None:
    clean, noisy, row = RawPairs(scenes)[0]
    found = transfer.fit_pair(clean, noisy, row | {column: row[column] * factor})
    assert found is not None
    assert found.deviation > transfer.ALARM


def test_errors_are_those_of_repeated_draws(make: Make, tmp_path: Path) -> None:
    """Sixteen draws of one image: their spread in units of the stated error, chi squared with 15 degrees of freedom."""
    make(None, tmp_path / "ds", "source.limit=1", "noise.draws=16")
    found = list(transfer.iterate_fits(tmp_path / "ds"))
    for value, error in (("slope", "slope_error"), ("intercept", "intercept_error")):
        spread = np.var([getattr(one, value) for one in found], ddof=1) / found[0].__getattribute__(error) ** 2
        assert 0.2 < spread < 2.7


def test_a_pair_with_no_range_of_signal_is_passed_over() -> None:
    flat = np.full((64, 64), 900, dtype=np.uint16)
    row = {"effects": "heteroscedastic;quantise", "a_dn": 1.0, "b_dn2": 4.0, "black_level_dn": 240, "bits": 12}
    row |= {"white_level_dn": 4095, "sensor_clip": "sensor", "key": "00000000"}
    row |= {"dtype": "uint16", "layout": "mosaic"}
    row |= dict.fromkeys(("dn_per_e", "row_std_dn", "column_std_dn", "dark_e", "prnu_std", "width", "height"), 0.0)
    assert transfer.fit_pair(flat, flat, row) is None


@pytest.mark.parametrize(
    "overrides",
    [("noise=none",), ("effects.heteroscedastic=off",), ("noise=heteroscedastic", "noise.a=0.02", "noise.b=0.01")],
)
def test_noise_that_rounding_hides_is_no_damage(
    overrides: tuple[str, ...], make: Make, door: Door, tmp_path: Path
) -> None:
    """Below 0.7 DN rounding is no noise of its own."""
    make(None, tmp_path / "ds", "source.limit=1", *overrides)
    done = door("verify", tmp_path / "ds", "--noise")
    assert (done.code, done.err) == (0, "")


def test_a_variance_below_zero_is_none(make: Make, door: Door, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=1", "noise=imx385_iso3200_rvdd")
    done = door("verify", tmp_path / "ds", "--noise")
    assert (done.code, done.err) == (0, "")


def test_the_command_says_how_far_the_worst_pair_lies(scenes: Path, door: Door, tmp_path: Path) -> None:
    done = door("verify", scenes, "--noise", "--to", tmp_path / "curves.png")
    assert done.code == 0
    assert "noise of 3 pairs fitted" in done.out
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_the_command_ends_with_4_where_the_noise_is_not_the_rows(
    scenes: Path, door: Door, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = transfer.fit_pair
    monkeypatch.setattr(transfer, "fit_pair", lambda *given: replace(true(*given), expected=(9.0, 38.0)))
    done = door("verify", scenes, "--noise")
    assert done.code == 4
    assert "noise of 00000000: a 6.9" in done.err
