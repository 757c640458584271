"""Exact tables: correctly rounded curves, package data, and normal quantiles within their error."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from decimal import Decimal, localcontext
from pathlib import Path
from statistics import NormalDist

import mpmath
import numpy as np
import pytest
import yaml
from helpers.promise_report import Figure

from unprocess_gen.core import exact_distributions
from unprocess_gen.core.errors import MachineError
from unprocess_gen.simulation import lookup_tables, tone_curves
from unprocess_gen.simulation.tone_curves import PUBLISHED_SHA256

ROOT = Path(__file__).parents[2]

CURVES_8 = [key[:2] for key in PUBLISHED_SHA256 if key[2] == 256]
CURVES_16 = [key[:2] for key in PUBLISHED_SHA256 if key[2] == 65536]


def true_value(tone: str, gamma: str, code: int, codes: int) -> mpmath.mpf:
    """Return the curve by the formulas of the article, with 60 digits because they cancel near black."""
    with mpmath.workdps(60):
        v = mpmath.mpf(code) / (codes - 1)
        if tone == "smoothstep":
            v = mpmath.mpf("0.5") - mpmath.sin(mpmath.asin(1 - 2 * v) / 3)
        if gamma != "srgb":
            return v ** mpmath.mpf(gamma)
        if v <= mpmath.mpf("0.04045"):
            return v / mpmath.mpf("12.92")
        return ((v + mpmath.mpf("0.055")) / mpmath.mpf("1.055")) ** mpmath.mpf("2.4")


def wrongly_rounded(tone: str, gamma: str, codes: int) -> list[int]:
    """Return the codes, except the ends, whose entry is more than half a unit in the last place off."""
    table = tone_curves.linear_table(tone, gamma, codes)
    with mpmath.workdps(60):
        return [
            code
            for code in range(1, codes - 1)
            if abs(mpmath.mpf(float(table[code])) - true_value(tone, gamma, code, codes))
            > mpmath.mpf(math.ulp(table[code])) / 2
        ]


# Curves ---------------------------------------------------------------------------------------------------------------


CUSTOM = [("smoothstep", gamma) for gamma in ("1.8", "2.4", "0.45", "10", "3.3333333333333335")]


@pytest.mark.parametrize(
    ("tone", "gamma", "codes"),
    [
        *((*curve, 256) for curve in (*CURVES_8, *CUSTOM)),
        *(pytest.param(*curve, 65536, marks=pytest.mark.slow) for curve in CURVES_16),
    ],
)
def test_every_entry_is_correctly_rounded(tone: str, gamma: str, codes: int, figure: Figure) -> None:
    wrong = wrongly_rounded(tone, gamma, codes)
    assert wrong == []
    if (tone, gamma) not in CUSTOM:
        bits = codes.bit_length() - 1
        figure("curves", f"{codes - len(wrong):,} of {codes:,} entries of {bits}-bit curves correctly rounded")


@pytest.mark.parametrize(("tone", "gamma"), CURVES_16)
def test_16_bit_entries_are_correctly_rounded_at_every_97th_code(tone: str, gamma: str) -> None:
    """Single entries are tested, because a complete table takes seconds to compute."""
    codes = range(97, 65535, 97)
    entries = [float(tone_curves.exact_curve(tone, gamma, code, 65536)) for code in codes]
    with mpmath.workdps(60):
        for code, entry in zip(codes, entries, strict=True):
            error = abs(mpmath.mpf(entry) - true_value(tone, gamma, code, 65536))
            assert error <= mpmath.mpf(math.ulp(entry)) / 2, code


def test_a_curve_with_another_hash_is_refused(monkeypatch: pytest.MonkeyPatch, no_cached_curves: None) -> None:
    monkeypatch.setitem(PUBLISHED_SHA256, ("none", "2.2", 256), "0" * 64)
    with pytest.raises(MachineError, match="expected 0000"):
        tone_curves.linear_table("none", 2.2, 256)


def test_an_unknown_tone_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"tone=filmic: .*expected one of smoothstep, none"):
        tone_curves.linear_table("filmic", 2.2, 256)


def test_integer_gammas_share_one_curve() -> None:
    assert tone_curves.linear_table("none", 1, 256) is tone_curves.linear_table("none", 1.0, 256)


# Package data ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def no_cached_curves() -> Iterator[None]:
    """Forget the curves that this process holds, before and after the test."""
    tone_curves.linear_table.cache_clear()
    yield
    tone_curves.linear_table.cache_clear()


@pytest.mark.parametrize(("tone", "gamma"), CURVES_16)
def test_offered_16_bit_curves_are_read_not_computed(
    tone: str, gamma: str, monkeypatch: pytest.MonkeyPatch, no_cached_curves: None
) -> None:
    monkeypatch.setattr(tone_curves, "compute_curve", None)

    assert not tone_curves.linear_table(tone, gamma, 65536).flags.writeable


def test_every_isp_option_has_published_curves() -> None:
    options = [yaml.safe_load(path.read_text()) for path in (ROOT / "conf" / "isp").glob("*.yaml")]
    offered = {(option["tone"], tone_curves.gamma_text(option["gamma"])) for option in options}

    assert offered == set(CURVES_8) == set(CURVES_16)


@pytest.mark.slow
def test_package_data_are_the_computed_curves(tmp_path: Path) -> None:
    tone_curves.store_curves(tmp_path / "curves.npz")

    with np.load(tmp_path / "curves.npz") as computed, np.load(tone_curves.STORED_CURVES) as stored:
        assert set(computed) == set(stored)
        assert all((computed[name] == stored[name]).all() for name in computed)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: None,
        lambda content: content[:-1],
        lambda content: bytes(len(content)),
        lambda content: content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
    ],
    ids=["missing", "without the last byte", "zeros", "one bit changed"],
)
def test_damaged_package_data_are_refused(
    damage: Callable[[bytes], bytes | None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_cached_curves: None
) -> None:
    damaged = damage(tone_curves.STORED_CURVES.read_bytes())
    if damaged is not None:
        (tmp_path / "curves.npz").write_bytes(damaged)
    monkeypatch.setattr(tone_curves, "STORED_CURVES", tmp_path / "curves.npz")

    with pytest.raises(MachineError, match=r"curves\.npz: cannot be read .*; reinstall unprocess_gen"):
        tone_curves.linear_table("smoothstep", 2.2, 65536)


# Normals --------------------------------------------------------------------------------------------------------------

SMALL_J = range(1, 64, 2)
EDGES = [
    2**octave // 32 * (32 + segment) + side
    for octave in range(6, 32)
    for segment in range(32)
    for side in (-1, 1)
    if 2**octave // 32 * (32 + segment) + side > 63
]


def by_table(j: np.ndarray) -> np.ndarray:
    """Return the quantile by octave, segment and position in the segment, as `normal_table` documents it."""
    j = np.asarray(j, dtype=np.float64)
    octave = np.floor(np.log2(j))  # exact here: no j < 2**32 lies nearer below a power of two than 1
    position = (j / 2**octave - 1) * lookup_tables.SEGMENTS
    segment = np.floor(position)
    t = (position - segment) / lookup_tables.SEGMENTS
    c0, c1, c2 = lookup_tables.normal_table()[(octave * lookup_tables.SEGMENTS + segment).astype(int)].T
    return c0 + t * (c1 + t * c2)


def test_the_error_bound_holds_at_every_edge() -> None:
    j = np.array([*SMALL_J, *EDGES, 2**32 - 1])
    exact = np.array([-float(exact_distributions.normal_quantile(Decimal(int(value)) / 2**33)) for value in j])
    assert np.abs(by_table(j) - exact).max() <= 1.5e-7


def test_the_error_bound_holds_within_every_segment(figure: Figure) -> None:
    within = np.linspace(0, 1, 97)[:-1]
    j = np.concatenate([2.0**octave * (1 + (segment + within) / 32) for octave in range(32) for segment in range(32)])
    quantile = NormalDist().inv_cdf
    exact = np.array([-quantile(value * 2.0**-33) for value in j])
    error = np.abs(by_table(j) - exact).max()
    assert error <= 1.5e-7
    figure("normal", f"quadratics: at most {error:.3g} standard deviations off, {j.size} words")


TABLE_WORDS = (1, 3, 2**10 + 1, 2**20 + 1, 2**28 - 1, 2**31, 2**32 - 1, 2**32 + 1, 2**33 - 2**20, 2**33 - 3, 2**33 - 1)
DRAWN = (1, 2, 2**20 + 1, 2**40 + 1, 2**52 - 1, 2**52 + 1, 2**53 - 2**40, 2**53 - 1)


@pytest.mark.parametrize(("k", "bits"), [*((k, 33) for k in TABLE_WORDS), *((k, 53) for k in DRAWN)])
def test_quantiles_have_enough_digits(k: int, bits: int) -> None:
    """About 200 sums of at most ½ with 40 digits err by 1e-38 in p; dividing by the density gives the error of z."""
    with localcontext(prec=60), mpmath.workdps(60):
        exact = mpmath.sqrt(2) * mpmath.erfinv(2 * mpmath.mpf(k) / 2**bits - 1)
        error = abs(mpmath.mpf(str(exact_distributions.normal_quantile(Decimal(k) / 2**bits))) - exact)
        assert error <= min(mpmath.mpf("1e-38") / mpmath.npdf(exact), mpmath.mpf("1e-25" if bits == 33 else 1))


def rows_from(quantiles: np.ndarray) -> np.ndarray:
    """Return the rows of the table from the quantiles at the nodes [1024, 3]."""
    grid = np.array(lookup_tables.COEFFICIENT_GRID)
    return np.rint(np.stack(lookup_tables._interpolate(quantiles.T), axis=-1) / grid) * grid


def at_nodes(inv_cdf) -> np.ndarray:
    return np.array(
        [
            [-inv_cdf(math.ldexp(1 + segment / 32 + node / 32, octave - 33)) for node in lookup_tables.CHEBYSHEV_NODES]
            for octave in range(32)
            for segment in range(32)
        ]
    )


SIGNS = list(itertools.product((-1, 1), repeat=3))


def test_quantiles_four_units_off_give_the_same_table() -> None:
    """A coefficient is linear in its quantiles, so the corners are the worst cases; a libm moves quantiles by less."""
    z = at_nodes(NormalDist().inv_cdf)
    assert (rows_from(z) == lookup_tables.normal_table()).all()
    for signs in SIGNS:
        assert (rows_from(z + 4 * np.spacing(np.abs(z)) * np.array(signs)) == lookup_tables.normal_table()).all(), signs
