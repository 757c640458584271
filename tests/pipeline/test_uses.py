"""Every kind of dataset is made in parts, verified, replayed, regenerated and repaired to the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import TreeHash
from helpers.kinds import KINDS, Kind

import unprocess_gen as ug

QUICK = ("patches, levels and draws", "clips", "scenes", "dark frames", "filtered", "raw clips", "targets")
RAW = "raw clips"


@pytest.mark.parametrize("kind", slow_except(QUICK, KINDS))
def test_every_kind_has_the_same_bytes_after_every_use(
    kind: str, kind_settings: Callable[[str], tuple[str, ...]], made_kind: Kind, run_main: RunMain,
    tree_hash: TreeHash, tmp_path: Path,
) -> None:  # fmt: skip
    made, settings = made_kind(kind), (*kind_settings(kind), "n_jobs=1", "out=parts")
    calls = ("part", "1/2", *settings), ("part", "0/2", *settings), ("merge", "parts")
    assert [run_main(*call).code for call in calls] == [0] * 3
    assert tree_hash(tmp_path / "parts") == tree_hash(made)
    assert run_main("verify", made, "--regenerate", "8").out.startswith(f"{made} is intact; ")
    assert "; 0 are not" in run_main("replay", made).out
    assert run_main("again", made, "out=again", "n_jobs=1").out.endswith(f"the same as {made}, bit for bit\n")
    for name in ("manifest.csv", "shards/shard-00000.tar"):
        (tmp_path / "again" / name).unlink(missing_ok=True)
    assert run_main("verify", "again", "--repair").code == 0
    assert tree_hash(tmp_path / "again") == tree_hash(made)


def test_clips_levels_draws_and_splits_of_raw_frames_are_in_the_rows(made_kind: Kind) -> None:
    rows = [pair.row for pair in ug.RawPairs(made_kind(RAW))]
    assert len(rows) == 6 * 2 * 2 * 2
    for clip in "ab":
        of_clip = [row for row in rows if row["source"].startswith(f"{clip}/")]
        assert {row["frame"] for row in of_clip} == {0, 1, 2}
        for name in ("patch_y", "patch_x"):
            assert len({row[name] for row in of_clip if row["patch"] == 0}) == 1
        assert len({(row["split"], row["bits"]) for row in of_clip}) == 1
    assert {(row["level"], row["draw"]) for row in rows} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert {(row["bits"], row["black_level_dn"]) for row in rows} == {(14, 501)}


USES = {
    "preview": (("preview", "DS", "--keys", "0", "--to", "pictures"), "pictures"),
    "dng": (("dng", "DS", "--keys", "0", "--to", "dngs"), "16 DNG files written"),
    "report": (("report", "DS", "--to", "page.html"), "page.html"),
    "noise": (("verify", "DS", "--noise"), "0 wrong"),
    "plan": (("plan", "SETTINGS"), "on this sensor (black 501, white 15001)"),
}


@pytest.mark.parametrize("use", slow_except(("preview", "dng", "plan"), USES))
def test_commands_accept_datasets_of_raw_frames(
    use: str, kind_settings: Callable[[str], tuple[str, ...]], made_kind: Kind, run_main: RunMain
) -> None:
    (words, expected), given = USES[use], {"DS": (str(made_kind(RAW)),), "SETTINGS": kind_settings(RAW)}
    done = run_main(*(word for name in words for word in given.get(name, (name,))))
    assert (done.code, expected in done.out) == (0, True), done
