"""Pairs are found by their keys and columns, and their rows are a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import Make

import unprocess_gen as ug
from unprocess_gen.core.errors import ConfigError

LEVELS = "noise.levels=[{a: 2, b: 0}, {a: 8, b: 0}]", "noise.draws=2", "source.patch=[random,8,2]"


@pytest.fixture(scope="module")
def ladder(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes in two patches, two levels and two draws."""
    out = tmp_path_factory.mktemp("table") / "ladder"
    make(None, out, "noise=heteroscedastic", *LEVELS, "source.limit=3")
    return out


def keys(pairs: ug.RawPairs) -> list[Any]:
    return [row["key"] for row in pairs.rows]


def test_every_key_names_its_pair(dataset: Path, ladder: Path) -> None:
    for pairs in (ug.RawPairs(dataset), ug.RawPairs(ladder)[::-1][3:20]):
        assert [pairs[key].row["key"] for key in keys(pairs)] == keys(pairs)


@pytest.mark.parametrize("key", ["00000099", "0", "", "00000000-l01d01", "00000002-p0001-l01d02", "9" * 5000, "²" * 8])
def test_unknown_key_is_refused_and_the_range_named(key: str, ladder: Path) -> None:
    expected = "00000000-p0000-l00d00 to 00000002-p0001-l01d01$"
    for error in (KeyError, ConfigError):
        with pytest.raises(error, match=f"no pair has this key; expected {expected}"):
            ug.RawPairs(ladder)[key]


def test_key_of_several_pairs_is_refused(ladder: Path) -> None:
    pairs = ug.RawPairs(ladder)
    with pytest.raises(KeyError, match=r"names 8 pairs \(00000001-p0000-l00d00, .*…\); expected one; give its"):
        pairs["00000001"]
    with pytest.raises(KeyError, match="names 4 pairs"):
        pairs["00000001-p0001"]
    with pytest.raises(
        KeyError, match=r"names 2 pairs \(00000001-p0001-l01d00, 00000001-p0001-l01d00.* select\(dataset=…\)"
    ):
        ug.RawPairs([ladder, ladder])["00000001-p0001-l01d00"]
    assert pairs.select(patch=1, level=1.0, draw=0)["00000001"].row["key"] == "00000001-p0001-l01d00"


def test_rows_are_selected_by_value_and_function(ladder: Path, dataset: Path) -> None:
    pairs = ug.RawPairs([dataset, ladder])
    assert keys(pairs.select(dataset="ladder", a_dn=8)) == keys(ug.RawPairs(ladder).select(level=1))
    assert keys(pairs[::-1].select(lambda row: row["draw"] == 1, patch=1)) == [
        f"{index:08d}-p0001-l{level:02d}d01" for index in (2, 1, 0) for level in (1, 0)
    ]
    assert len(pairs.select()) == len(pairs)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"izo": 3}, r"izo: no such column; expected one of the manifest, or dataset; did you mean iso\?"),
        ({"level": "1"}, r"level='1': no pair is selected; expected level=[01], [01]$"),
        ({"key": "1"}, r"expected key=('\d{8}-p\d{4}-l\d\dd\d\d', ){5}…$"),
        ({"level": 0, "a_dn": 9}, r"level=0, a_dn=9: no pair .* expected level=0, 1; a_dn=2.0, 8.0$"),
    ],
)
def test_what_selects_no_pair_is_refused(columns: dict[str, Any], message: str, ladder: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        ug.RawPairs(ladder).select(**columns)


def test_reader_without_pairs_is_reported(dataset: Path) -> None:
    none = ug.RawPairs(dataset)[13:]
    with pytest.raises(KeyError, match="expected a reader that has pairs"):
        none["00000000"]
    with pytest.raises(ConfigError, match="select: iso=1: no pair is selected; expected what a pair has"):
        none.select(bool, iso=1)
    assert (len(none.rows), none._repr_html_().count("<img")) == (0, 0)


def test_rows_are_a_table(ladder: Path, dataset: Path) -> None:
    pairs = ug.RawPairs([ladder, dataset])
    assert [*pairs.rows] == [{**pair.row, "dataset": pair.dataset} for pair in pairs]
    assert pairs.rows[-2:] == [*pairs[-2:].rows]
    with pytest.raises(IndexError):
        pairs.rows[len(pairs)]
    frame = pytest.importorskip("pandas").DataFrame(pairs.rows)
    assert [*frame.key] == keys(pairs) and [*frame.dataset.unique()] == ["ladder", "ds"]
