"""Photon transfer: the fitted noise of a dataset agrees with its rows, and wrong rows are detected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings
from helpers.noise_fits import dataset_fits, fit_pair
from helpers.promise_report import Figure

from unprocess_gen import RawPairs, make_pair
from unprocess_gen.sources import synthetic


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("noise=brooks2019",),
        ("noise.law=poisson",),
        pytest.param(("noise=imx385", "noise.iso=12800", "effects.all=on"), marks=pytest.mark.slow),
        pytest.param(("noise=sony_a7s2", "scene=low_light"), marks=pytest.mark.slow),
        ("noise=oppo_reno10x", "noise.iso=1600", "sensor=generic_10bit"),
    ],
)
def test_every_kind_of_noise_agrees_with_its_row(
    overrides: tuple[str, ...], make: Make, tmp_path: Path, figure: Figure
) -> None:
    make(None, tmp_path / "ds", "source.limit=2", *overrides)
    fits = dataset_fits(tmp_path / "ds")
    largest = max(fit.deviation for fit in fits)
    figure("photon-transfer", f"{len(fits)} pairs within {largest:.1f} standard errors")
    assert len(fits) == 2
    assert largest < 5


INTERVALS = {
    "with row noise": (
        *(("noise=sony_a7s2", "scene=night", "effects.row=on"), ("noise=canon_700d", "scene=night", "effects.row=on")),
        ("noise=nikon_d850", "scene=night", "effects.row=on", "sensor=generic_14bit"),
        ("noise=nikon_d850", "scene=night", "effects.row=on", "sensor=generic_14bit", "noise.row_correlation=0.8"),
    ),
    "without row noise": ((), ("noise=sony_a7s2", "scene=night", "effects.row=off"), ("noise=canon_5d4",)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", INTERVALS)
def test_95_percent_intervals_contain_90_to_99_percent(name: str, settings: Settings, figure: Figure) -> None:
    inside: list[bool] = []
    for overrides in INTERVALS[name]:
        config = settings(*overrides)
        for seed in range(240 // len(INTERVALS[name])):
            picture = synthetic.picture(synthetic.NAMES[seed % len(synthetic.NAMES)])
            y, x = np.random.default_rng(seed).integers(0, 64, 2) * 2
            pair = make_pair(np.ascontiguousarray(picture[y : y + 256, x : x + 256]), replace(config, seed=seed))
            fit = fit_pair(pair.clean, pair.noisy, pair.row)
            if fit is not None:
                inside += (np.abs(fit.estimate - fit.expected) < 1.96 * fit.error).tolist()
    figure("photon-transfer", f"{name}: {np.mean(inside):.1%} of {len(inside)} numbers in their 95 % intervals")
    assert len(inside) >= 400
    assert 0.9 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize(("column", "factor"), [("a_dn", 1.05), ("a_dn", 0.95), ("b_dn2", 1.8), ("b_dn2", 0.2)])
def test_wrong_numbers_in_a_row_are_detected(scenes: Path, column: str, factor: float) -> None:
    clean, noisy, row = RawPairs(scenes)[0]
    fit = fit_pair(clean, noisy, row | {column: row[column] * factor})
    assert fit is not None
    assert fit.deviation > 6


@pytest.mark.parametrize(("overrides", "prnu"), [((), 0.005), (("clean.includes_fixed_pattern=true",), 0.0)])
def test_expected_variance_contains_prnu(overrides: tuple[str, ...], prnu: float, settings: Settings) -> None:
    """The variance of 3200 sites has a relative standard error of √(2 / 3200) = 2.5 %; PRNU adds 50 to 200 % here."""
    picture = np.broadcast_to(np.linspace(0, 255, 512)[:, None, None], (512, 512, 3)).astype(np.uint8)
    pair = make_pair(picture, settings("body=sony_a7s2", "scene=daylight", *overrides))
    fit = fit_pair(pair.clean, pair.noisy, pair.row)
    assert fit is not None
    expected_dn2 = np.interp(fit.signal_dn, *fit.line)
    drawn = (fit.signal_dn > 2000) & (fit.signal_dn < 6000)
    assert np.count_nonzero(drawn) >= 200  # of at least 16 sites each
    assert np.mean(fit.variance_dn2[drawn] / expected_dn2[drawn]) == pytest.approx(1, abs=0.1)
    assert fit.prnu == prnu


def test_pair_without_a_range_of_signals_has_no_fit(settings: Settings) -> None:
    pair = make_pair(np.full((64, 64, 3), 90, dtype=np.uint8), settings("camera=identity", "gains=unity"))
    assert fit_pair(pair.clean, pair.noisy, pair.row) is None


@pytest.mark.parametrize(
    "overrides",
    [
        *(("noise=none",), ("effects.heteroscedastic=off",), ("noise=heteroscedastic", "noise.a=0.02", "noise.b=0.01")),
        ("noise=imx385_iso3200_rvdd",),  # negative variance at black
    ],
)
def test_noise_that_rounding_hides_is_not_damage(
    overrides: tuple[str, ...], make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    make(None, tmp_path / "ds", "source.limit=1", *overrides)
    done = run_main("verify", tmp_path / "ds", "--noise")
    assert (done.code, done.err) == (0, "")
