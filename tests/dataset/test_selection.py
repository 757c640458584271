"""Rows are selected by position, source index, range and key, alike in every verb."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
from helpers.records import PAIR, PATCH, PLAN, SHA256, SOURCE

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import csv_lines, write_manifest
from unprocess_gen.dataset.row import COLUMN_NAMES, failed_row, pair_row
from unprocess_gen.dataset.selection import parse_keys, select_pairs, select_rows

DIGESTS = "1" * 32, "2" * 32


def rows() -> list[Row]:
    """Images 0 to 5: 1 failed, 3 has two patches, 4 two draws."""
    made: list[Row] = []
    for index, suffixes in enumerate([[""], None, [""], ["-p0000", "-p0007"], ["-l00d00", "-l00d01"], [""]]):
        source = dataclasses.replace(SOURCE, index=index)
        if suffixes is None:
            made.append(failed_row(source, None, 0, 0, "empty"))
        for suffix in suffixes or ():
            key = f"{index:08d}{suffix}"
            made.append(pair_row(key, source, SHA256, 1, 0, PLAN, PAIR, DIGESTS, PATCH))
    return made


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    write_manifest(tmp_path / "manifest.csv", COLUMN_NAMES, [csv_lines(rows(), COLUMN_NAMES)])
    return tmp_path / "manifest.csv"


@pytest.mark.parametrize(
    ("keys", "selected"),
    [
        ("2", ["00000002"]),
        ("1", ["00000001"]),
        ("3", ["00000003-p0000", "00000003-p0007"]),
        ("3-4", ["00000003-p0000", "00000003-p0007", "00000004-l00d00", "00000004-l00d01"]),
        ("0-2", ["00000000", "00000002"]),
        ("2, 3-3 ,00000004-l00d01", ["00000002", "00000003-p0000", "00000003-p0007", "00000004-l00d01"]),
    ],
)
def test_indices_ranges_and_keys_select_rows(keys: str, selected: list[str], manifest: Path) -> None:
    assert [row["key"] for row in select_rows(manifest, keys)] == selected


@pytest.mark.parametrize(
    ("keys", "selected"),
    [
        ("6", [0, 1, 2, 3]), ("00000006-p0001", [2, 3]), ("00000006-p0001-f01", [3]), ("00000006-p0000-f00", [0]),
    ],
)  # fmt: skip
def test_keys_name_bursts_and_their_frames(keys: str, selected: list[int], tmp_path: Path) -> None:
    source, names = dataclasses.replace(SOURCE, index=6), ["p0000-f00", "p0000-f01", "p0001-f00", "p0001-f01"]
    made = [pair_row(f"00000006-{name}", source, SHA256, 1, 0, PLAN, PAIR, DIGESTS, PATCH) for name in names]
    write_manifest(tmp_path / "manifest.csv", COLUMN_NAMES, [csv_lines(made, COLUMN_NAMES)])
    rows = select_rows(tmp_path / "manifest.csv", keys)
    assert [row["key"] for row in rows] == [made[number]["key"] for number in selected]


def test_failed_rows_inside_a_range_are_skipped_and_counted(manifest: Path) -> None:
    skipped: list[Row] = []
    selected = [row["key"] for row in select_rows(manifest, "0-2", skipped)]
    assert (selected, [row["key"] for row in skipped]) == (["00000000", "00000002"], ["00000001"])
    assert select_pairs(manifest, "0-5").failed == 1


def test_pairs_are_numbered_as_in_raw_pairs(manifest: Path) -> None:
    pairs = select_pairs(manifest, "2-3").rows
    assert {number: row["key"] for number, row in pairs.items()} == {
        1: "00000002",
        2: "00000003-p0000",
        3: "00000003-p0007",
    }


def test_failed_row_named_alone_is_no_pair(manifest: Path) -> None:
    with pytest.raises(ConfigError, match=r"--keys 00000001: failed \(empty\), so it has no frames"):
        select_pairs(manifest, "1")


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ("", "'' is no key; expected source indices"),
        ("-3", "'-3' is no key"),
        ("two", "'two' is no key"),
        ("9" * 30, "is no key"),
        ("7-3", "--keys 7-3: ends before it begins; expected 3-7"),
        ("77", "--keys 77: .* has no such key; it has keys from 00000000 to 00000005"),
        ("00000003-p0001", "--keys 00000003-p0001: .* has no such key"),
    ],
)
def test_selection_without_rows_is_refused(keys: str, problem: str, manifest: Path) -> None:
    with pytest.raises(ConfigError, match=problem):
        list(select_rows(manifest, keys))


def test_huge_range_of_keys_costs_nothing() -> None:
    assert parse_keys("0-999999999999")[1] == {"0-999999999999": range(10**12)}


@pytest.mark.parametrize(
    ("total", "count", "picked"),
    [(10, 3, [0, 3, 6]), (3, 10, [0, 1, 2]), (5, 0, []), (0, 4, []), (7, 7, [0, 1, 2, 3, 4, 5, 6])],
)
def test_evenly_spaced_items_begin_with_the_first(total: int, count: int, picked: list[int]) -> None:
    assert evenly_spaced(range(total), count) == picked
