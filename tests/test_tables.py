"""Exact tables: curves correctly rounded, normals within their error, the cache harmless."""

from __future__ import annotations

import importlib.util
import itertools
import math
import statistics
import subprocess
import sys
from collections.abc import Iterator
from decimal import Decimal, localcontext
from pathlib import Path
from statistics import NormalDist
from types import ModuleType

import mpmath
import numpy as np
import pytest

from unprocess_gen.core import lookup_tables as tables
from unprocess_gen.core.errors import MachineError

CURVES_8 = [key[:2] for key in tables.PINNED if key[2] == 256]
CURVES_16 = [key[:2] for key in tables.PINNED if key[2] == 65536]
QUICK = [*((*curve, 256) for curve in CURVES_8), ("smoothstep", "2.2", 65536), ("none", "1", 65536)]
"""The small curves, and the big ones that other tests build anyway or that take no time."""
CURVES = [pytest.param(*key, marks=[] if key in QUICK else pytest.mark.slow) for key in tables.PINNED]


def true_value(tone: str, gamma: str, code: int, codes: int) -> mpmath.mpf:
    """The curve by the article's own formulas, in 60 digits, which the cancellation near black cannot eat up."""
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
    """Codes whose entry is more than half a unit in the last place off; the ends, which are exact, left out."""
    table = tables.linear_table(tone, gamma, codes)
    with mpmath.workdps(60):
        return [
            code
            for code in range(1, codes - 1)
            if abs(mpmath.mpf(float(table[code])) - true_value(tone, gamma, code, codes))
            > mpmath.mpf(math.ulp(table[code])) / 2
        ]


# Curves ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("tone", "gamma"), CURVES_8)
def test_every_8_bit_entry_is_correctly_rounded(tone: str, gamma: str) -> None:
    assert wrongly_rounded(tone, gamma, 256) == []


@pytest.mark.parametrize(("tone", "gamma"), CURVES_16)
def test_16_bit_entries_are_correctly_rounded_at_every_97th_code(tone: str, gamma: str) -> None:
    """Entry by entry, since a whole table takes seconds to build."""
    codes = range(97, 65535, 97)
    entries = [float(tables.exact_curve(tone, gamma, code, 65536)) for code in codes]
    with mpmath.workdps(60):
        for code, entry in zip(codes, entries, strict=True):
            error = abs(mpmath.mpf(entry) - true_value(tone, gamma, code, 65536))
            assert error <= mpmath.mpf(math.ulp(entry)) / 2, code


@pytest.mark.slow
@pytest.mark.parametrize(("tone", "gamma"), CURVES_16)
def test_every_16_bit_entry_is_correctly_rounded(tone: str, gamma: str) -> None:
    assert wrongly_rounded(tone, gamma, 65536) == []


@pytest.mark.parametrize("gamma", ["1.8", "2.4", "0.45", "10", "3.3333333333333335"])
def test_a_gamma_of_ones_own_is_correctly_rounded(gamma: str) -> None:
    assert wrongly_rounded("smoothstep", gamma, 256) == []


@pytest.mark.parametrize(("tone", "gamma", "codes"), [*CURVES, ("smoothstep", "10", 256), ("none", "0.1", 256)])
def test_a_curve_starts_at_0_ends_at_1_and_rises_all_the_way(tone: str, gamma: str, codes: int) -> None:
    table = tables.linear_table(tone, gamma, codes)
    assert table.shape == (codes,)
    assert (table[0], table[-1]) == (0.0, 1.0)
    assert (np.diff(table) > 0).all()


@pytest.mark.parametrize(("tone", "gamma", "codes"), CURVES)
def test_a_curve_has_the_published_hash(tone: str, gamma: str, codes: int) -> None:
    assert tables.sha256(tables.linear_table(tone, gamma, codes)) == tables.PINNED[tone, gamma, codes]


def test_the_default_curve_has_the_hash_that_research_found_independently() -> None:
    digest = "d358dd03d38f763306ef83a982403114f2ff8e5397025f2c68dbe50e85503bfa"
    assert tables.sha256(tables.linear_table("smoothstep", 2.2, 256)) == digest


def test_the_default_curve_has_the_spot_values_that_research_found_independently() -> None:
    table = tables.linear_table("smoothstep", 2.2, 256)
    assert table[1] == float.fromhex("0x1.6a87dde8e4622p-11")
    assert table[127] == float.fromhex("0x1.bb298acba41f1p-3")
    assert table[254] == float.fromhex("0x1.d7ac0bca1d3e3p-1")


def test_a_curve_that_comes_out_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch, fresh: None) -> None:
    monkeypatch.setitem(tables.PINNED, ("none", "2.2", 256), "0" * 64)
    with pytest.raises(MachineError, match="expected 0000"):
        tables.linear_table("none", 2.2, 256)


def test_a_table_cannot_be_written_to() -> None:
    for table in (tables.linear_table("none", 1, 256), tables.normal_table()):
        with pytest.raises(ValueError, match="read-only"):
            table[0] = 1


def test_an_unknown_tone_is_named_with_those_that_exist() -> None:
    with pytest.raises(ValueError, match="tone is 'filmic', expected one of smoothstep, none"):
        tables.linear_table("filmic", 2.2, 256)


@pytest.mark.parametrize(
    ("gamma", "text"),
    [(1, "1"), (1.0, "1"), (2.2, "2.2"), (2, "2"), (2.40, "2.4"), ("srgb", "srgb"), (1 / 3, "0.3333333333333333")],
)
def test_gamma_is_spelled_as_the_shortest_number(gamma: float | str, text: str) -> None:
    assert tables.gamma_text(gamma) == text


def test_whole_gammas_are_one_curve_however_they_are_written() -> None:
    assert tables.linear_table("none", 1, 256) is tables.linear_table("none", 1.0, 256)


@pytest.mark.parametrize("code", [1, 100, 32767, 32768, 65534])
def test_the_tone_curve_inverts_the_cubic_to_35_digits(code: int) -> None:
    with localcontext(prec=tables.DIGITS):
        x = Decimal(code) / 65535
        y = tables.smoothstep_inverse(x)
        assert abs(y * y * (3 - 2 * y) - x) < Decimal("1e-35") * x


# Cache ----------------------------------------------------------------------------------------------------------------

CODES = 300
"""More than 256, so the curve goes through the cache; few enough to be built in no time."""


@pytest.fixture
def fresh() -> Iterator[None]:
    """Forget the tables this process holds, before and after."""
    tables._linear_table.cache_clear()
    yield
    tables._linear_table.cache_clear()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh: None) -> Path:
    """An empty cache folder of one's own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "unprocess_gen" / f"curve-none-1.8-{CODES}.bin"


def built(tone: str = "none", gamma: str = "1.8", codes: int = CODES) -> np.ndarray:
    return np.array([float(tables.exact_curve(tone, gamma, code, codes)) for code in range(codes)])


def no_build(tone: str, gamma: str, codes: int) -> np.ndarray:
    raise AssertionError("built anew")


def test_a_big_table_is_kept_and_read_back(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = tables.linear_table("none", 1.8, CODES)
    tables._linear_table.cache_clear()
    monkeypatch.setattr(tables, "_build", no_build)
    second = tables.linear_table("none", 1.8, CODES)
    assert first.tobytes() == second.tobytes() == built().tobytes()


def test_a_kept_table_cannot_be_written_to(cache: Path) -> None:
    tables.linear_table("none", 1.8, CODES)
    tables._linear_table.cache_clear()
    assert not tables.linear_table("none", 1.8, CODES).flags.writeable


def test_nothing_but_the_table_and_its_lock_is_left_behind(cache: Path) -> None:
    tables.linear_table("none", 1.8, CODES)
    assert sorted(path.name for path in cache.parent.iterdir()) == [cache.name, cache.with_suffix(".lock").name]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-1],
        lambda content: content[: 8 * CODES],
        lambda content: content + b"\0",
        lambda content: bytes([content[0] ^ 1]) + content[1:],
        lambda content: content[:-1] + bytes([content[-1] ^ 128]),
        lambda content: content[8:],
        lambda content: bytes(len(content)),
    ],
    ids=["empty", "last byte", "no digest", "byte too many", "bit of a number", "bit of the digest", "short", "zeros"],
)
def test_a_damaged_file_is_built_anew(cache: Path, damage) -> None:
    tables.linear_table("none", 1.8, CODES)
    whole = cache.read_bytes()
    cache.write_bytes(damage(whole))
    tables._linear_table.cache_clear()
    assert tables.linear_table("none", 1.8, CODES).tobytes() == built().tobytes()
    assert cache.read_bytes() == whole


def test_a_whole_file_with_another_curve_in_it_is_built_anew_where_the_hash_is_pinned(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(tables.PINNED, ("none", "1.8", CODES), tables.sha256(built()))
    cache.parent.mkdir()
    tables._write(cache, built(gamma="2.2"))
    assert tables.linear_table("none", 1.8, CODES).tobytes() == built().tobytes()


def test_a_curve_that_comes_out_otherwise_than_pinned_is_refused(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tables.PINNED, ("none", "1.8", CODES), "0" * 64)
    with pytest.raises(MachineError, match="a table came out as"):
        tables.linear_table("none", 1.8, CODES)


def test_a_write_that_fails_leaves_no_file_behind(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tables.os, "replace", full)
    tables.linear_table("none", 1.8, CODES)
    assert [path.suffix for path in cache.parent.iterdir()] == [".lock"]


def test_no_place_to_keep_a_table_costs_time_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fresh: None
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert tables.linear_table("none", 1.8, CODES).tobytes() == built().tobytes()


def test_a_full_disk_costs_time_and_nothing_else(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, table: np.ndarray) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tables, "_write", full)
    assert tables.linear_table("none", 1.8, CODES).tobytes() == built().tobytes()


def test_the_cache_is_below_the_home_folder_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/of/someone")
    for value in ("", None):
        monkeypatch.delenv("XDG_CACHE_HOME") if value is None else monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert tables.cache_folder() == Path("/home/of/someone/.cache/unprocess_gen")


TWINS = f"""
import sys, time
from pathlib import Path
from unprocess_gen.core import lookup_tables as tables
from unprocess_gen.core.errors import MachineError
here, me = Path(sys.argv[1]), sys.argv[2]
build = tables._build
def slow(*curve):
    (here / f"built by {{me}}").touch()
    time.sleep(0.5)
    return build(*curve)
tables._build = slow
(here / f"ready {{me}}").touch()
while len(list(here.glob("ready *"))) < 2:
    time.sleep(0.001)
print(tables.sha256(tables.linear_table("none", 1.8, {CODES})))
"""


def test_of_two_processes_that_need_a_table_at_once_one_builds_it(tmp_path: Path, cache: Path) -> None:
    twins = [
        subprocess.Popen([sys.executable, "-c", TWINS, str(tmp_path), name], stdout=subprocess.PIPE, text=True)
        for name in "ab"
    ]
    digests = {twin.communicate(timeout=60)[0].strip() for twin in twins}
    assert digests == {tables.sha256(built())}
    assert len(list(tmp_path.glob("built by *"))) == 1


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
    """The quantile as `normal_table` describes it: octave, segment, position in the segment."""
    j = np.asarray(j, dtype=np.float64)
    octave = np.floor(np.log2(j))  # exact here: no j < 2**32 lies nearer below a power of two than 1
    position = (j / 2**octave - 1) * tables.SEGMENTS
    segment = np.floor(position)
    t = (position - segment) / tables.SEGMENTS
    c0, c1, c2 = tables.normal_table()[(octave * tables.SEGMENTS + segment).astype(int)].T
    return c0 + t * (c1 + t * c2)


def test_the_normal_table_has_the_published_hash() -> None:
    digest = "1de8806d2534020a52f8f25e981f0bc9f85f65e29bd634c29e7dc0820480ba5a"
    assert tables.sha256(tables.normal_table()) == tables.NORMAL_SHA256 == digest


def test_the_table_is_within_its_error_on_both_sides_of_every_edge() -> None:
    j = np.array([*SMALL_J, *EDGES, 2**32 - 1])
    exact = np.array([-float(tables.normal_quantile(Decimal(int(value)) / 2**33)) for value in j])
    assert np.abs(by_table(j) - exact).max() <= 1.5e-7


def test_the_table_is_within_its_error_all_through_every_segment() -> None:
    within = np.linspace(0, 1, 97)[:-1]
    j = np.concatenate([2.0**octave * (1 + (segment + within) / 32) for octave in range(32) for segment in range(32)])
    quantile = NormalDist().inv_cdf
    exact = np.array([-quantile(value * 2.0**-33) for value in j])
    assert np.abs(by_table(j) - exact).max() <= 1.5e-7


@pytest.mark.parametrize("index", [0, 1, 2**16, 2**30, 2**31 - 1])
def test_the_table_is_within_its_error_against_an_independent_library(index: int) -> None:
    with mpmath.workdps(30):
        exact = mpmath.sqrt(2) * mpmath.erfinv(1 - (2 * index + 1) / mpmath.mpf(2) ** 32)
        assert abs(by_table(np.array(2 * index + 1)) - exact) <= 1.5e-7


def test_the_last_index_is_next_to_the_middle() -> None:
    assert 0 < by_table(np.array(2**32 - 1)) < 1.5e-7


def test_the_quantile_falls_within_every_segment() -> None:
    _, c1, c2 = tables.normal_table().T
    assert (c1 < 0).all()
    assert (c1 + 2 * c2 / tables.SEGMENTS < 0).all()


def test_quantiles_to_25_digits_of_what_the_table_needs() -> None:
    """Against erfinv of another library, the whole range of the table and its mirror."""
    ks = [1, 3, 2**10 + 1, 2**20 + 1, 2**28 - 1, 2**31, 2**32 - 1, 2**32 + 1, 2**33 - 2**20, 2**33 - 3, 2**33 - 1]
    with localcontext(prec=60), mpmath.workdps(60):
        for k in ks:
            exact = mpmath.sqrt(2) * mpmath.erfinv(k / mpmath.mpf(2) ** 32 - 1)
            assert abs(mpmath.mpf(str(tables.normal_quantile(Decimal(k) / 2**33))) - exact) <= mpmath.mpf("1e-25"), k


@pytest.mark.parametrize("k", [1, 2, 2**20 + 1, 2**40 + 1, 2**52 - 1, 2**52 + 1, 2**53 - 2**40, 2**53 - 1])
def test_quantiles_of_every_drawn_uniform_have_digits_to_spare(k: int) -> None:
    """Some 200 terms of the series, each sum rounded to 40 digits of at most ½: 1e-38 of p; the density makes it z."""
    with localcontext(prec=60), mpmath.workdps(60):
        p = mpmath.mpf(k) / 2**53
        exact = mpmath.sqrt(2) * mpmath.erfinv(2 * p - 1)
        error = abs(mpmath.mpf(str(tables.normal_quantile(Decimal(k) / 2**53))) - exact)
        assert error <= mpmath.mpf("1e-38") / mpmath.npdf(exact)


def rows_from(quantiles: np.ndarray) -> np.ndarray:
    """The table's rows from the quantiles at the nodes ``[1024, 3]``: `tables._quadratic`, in its order."""
    t = [node / tables.SEGMENTS for node in tables.NODES]
    z = quantiles.T
    slope01, slope12 = (z[1] - z[0]) / (t[1] - t[0]), (z[2] - z[1]) / (t[2] - t[1])
    c2 = (slope12 - slope01) / (t[2] - t[0])
    c1 = slope01 - c2 * (t[0] + t[1])
    rows = np.stack([z[0] - t[0] * (c1 + t[0] * c2), c1, c2], axis=-1)
    grid = np.array(tables.COEFFICIENT_GRID)
    return np.rint(rows / grid) * grid


def at_nodes(inv_cdf) -> np.ndarray:
    return np.array(
        [
            [-inv_cdf(math.ldexp(1 + segment / 32 + node / 32, octave - 33)) for node in tables.NODES]
            for octave in range(32)
            for segment in range(32)
        ]
    )


SIGNS = list(itertools.product((-1, 1), repeat=3))


def test_four_units_of_noise_in_the_last_place_of_every_quantile_give_the_same_table() -> None:
    """A coefficient is linear in its three quantiles, so the eight corners are the worst there is."""
    z = at_nodes(NormalDist().inv_cdf)
    assert (rows_from(z) == tables.normal_table()).all()
    for signs in SIGNS:
        assert (rows_from(z + 4 * np.spacing(np.abs(z)) * np.array(signs)) == tables.normal_table()).all(), signs


def python_statistics() -> ModuleType:
    """`statistics` without its C accelerator, whose logarithm can be replaced."""
    spec = importlib.util.spec_from_file_location("statistics_in_python", statistics.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "_statistics", None)
        spec.loader.exec_module(module)
    return module


def test_logarithms_up_to_two_units_off_at_any_node_give_the_same_table() -> None:
    """The logarithm is all that a quantile takes from libm; none in use is off by more than one unit."""
    module = python_statistics()
    log = module.log
    z = {}
    for units in (-2, -1, 0, 1, 2):
        module.log = lambda x, units=units: log(x) + units * math.ulp(log(x))
        z[units] = at_nodes(lambda p: module._normal_dist_inv_cdf(p, 0.0, 1.0))
    for units in itertools.product(z, repeat=3):
        quantiles = np.stack([z[unit][:, node] for node, unit in enumerate(units)], axis=-1)
        assert (rows_from(quantiles) == tables.normal_table()).all(), units
