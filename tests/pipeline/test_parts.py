"""Runs in parts: the bytes of one run, whatever the order, repetition and death of parts; refusals before any write."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import Done, RunMain, messages
from helpers.datasets import contents
from helpers.processes import (
    COUNT,
    ONE,
    SLOW_DISK,
    WAIT_S,
    committed,
    imported_first,
    interrupt,
    running,
    slow_shards,
    unfinished,
    wait_for,
)
from helpers.promise_report import Figure

from unprocess_gen.pipeline.deaths import DEATHS
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources import listing

SETTINGS = ("source.root=p", ONE, "n_jobs=1", "out=ds")

Part = Callable[..., Done]
Merge = Callable[[], Done]


@pytest.fixture
def part(run_main: RunMain, photographs: Path) -> Part:
    """Return a function that makes a part of the dataset ds of the photographs p."""
    return lambda text, *more: run_main("part", text, *SETTINGS, *more, "-q")


@pytest.fixture
def merge(run_main: RunMain, assert_undisturbed: Callable[[Path], None], tmp_path: Path) -> Merge:
    """Return a function that merges ds, which then has the bytes of one run."""

    def merged() -> Done:
        done = run_main("merge", "ds")
        assert done.code == 0, done.err
        assert_undisturbed(tmp_path / "ds")
        return done

    return merged


@pytest.fixture
def begun(part: Part, tmp_path: Path) -> Path:
    """Return the dataset ds of which part 1 of 6 is made."""
    assert part("1/6").code == 0
    return tmp_path / "ds"


# Same bytes -----------------------------------------------------------------------------------------------------------


def test_shuffled_and_doubled_parts_make_the_bytes_of_one_run(
    part: Part, merge: Merge, run_main: RunMain, figure: Figure, tmp_path: Path
) -> None:
    order = [*range(5), *range(5)]
    random.Random(1).shuffle(order)
    assert [part(f"{number}/5").code for number in order] == [0] * 10
    assert merge().out.startswith("ds: 12 pairs,")
    assert verify(tmp_path / "ds") == []
    assert run_main("report", "ds").code == 0
    assert "merged from 5 parts" in (tmp_path / "ds/report.html").read_text()
    figure("parts", "same bytes from five parts in shuffled order, each made twice")


def test_part_has_every_nth_shard_and_lists_no_source_again(
    begun: Path, part: Part, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sorted(path.name for path in (begun / "shards").iterdir()) == ["shard-00001.tar", "shard-00007.tar"]
    monkeypatch.setattr(listing, "list_folder", lambda *_: 1 / 0)
    assert part("4/6").code == 0
    assert committed(begun) == 4


@pytest.mark.parametrize("lost", [".work/listing.jsonl", ".work/run.json"])
def test_file_lost_from_a_begun_run_is_created_again(lost: str, begun: Path, part: Part) -> None:
    before = (begun / lost).read_bytes()
    (begun / lost).unlink()
    assert part("2/6").code == 0
    assert (begun / lost).read_bytes() == before


def test_run_that_parts_began_is_finished_by_one_command(
    part: Part, run_main: RunMain, assert_undisturbed: Callable[[Path], None], tmp_path: Path
) -> None:
    assert part("2/6").code == part("3/6").code == 0
    assert "(8 in this run)" in run_main(*SETTINGS).out
    assert_undisturbed(tmp_path / "ds")


def test_run_that_one_command_began_is_finished_by_a_part(
    part: Part, run_main: RunMain, merge: Merge, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("unprocess_gen.pipeline.generate._finish", interrupt)
        assert run_main(*SETTINGS).code == 130
    for name in ("00004", "00009"):
        (tmp_path / f"ds/.work/rows/{name}.json").unlink()
    early = run_main("merge", "ds")
    assert (early.code, "2 of 12 shards missing (4,9); " in early.err) == (5, True)
    assert part("4/5").code == 0
    merge()


@pytest.mark.linux_only("starts processes")
def test_two_writers_of_a_part_both_end_with_0(photographs: Path, merge: Merge, tmp_path: Path) -> None:
    """They begin the run at the same time too."""
    env = imported_first(tmp_path, SLOW_DISK)
    with (
        running("part", "0/1", *SETTINGS, cwd=tmp_path, **env) as one,
        running("part", "0/1", *SETTINGS, cwd=tmp_path, **env) as other,
    ):
        assert (one.wait(WAIT_S), other.wait(WAIT_S)) == (0, 0)
    merge()


def test_part_that_ends_after_the_merge_leaves_no_record(
    begun: Path, part: Part, run_main: RunMain, monkeypatch: pytest.MonkeyPatch,
    assert_undisturbed: Callable[[Path], None],
) -> None:  # fmt: skip
    from unprocess_gen.pipeline import worker

    make_shard = worker.make_shard

    def merged_meanwhile(*given: Any) -> Any:
        monkeypatch.setattr(worker, "make_shard", make_shard)
        made = make_shard(*given)
        assert [part(f"{number}/6").code for number in range(6)] == [0] * 6
        assert run_main("merge", "ds").code == 0
        return made

    monkeypatch.setattr(worker, "make_shard", merged_meanwhile)
    assert part("0/6").code == 0
    assert_undisturbed(begun)


@pytest.fixture
def half_made(photographs: Path, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Start the only part of a dataset ds, and wait until some of its shards are committed."""
    env = imported_first(tmp_path, unfinished(tmp_path / "ds", COUNT - 4))
    with running("part", "0/1", *SETTINGS, cwd=tmp_path, **env) as process:
        wait_for(lambda: len(records(tmp_path)) >= 3)
        yield process


def records(folder: Path) -> dict[str, int]:
    """Return the name and time of each record of a dataset ds in ``folder``."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "ds/.work/rows").glob("*")}


@pytest.mark.linux_only("kills a process by a signal")
@pytest.mark.parametrize(("sent", "deaths"), [(signal.SIGKILL, 1), (signal.SIGTERM, 0)])
def test_ended_part_loses_at_most_one_shard(
    sent: signal.Signals, deaths: int, half_made: subprocess.Popen[str], part: Part, merge: Merge, tmp_path: Path
) -> None:
    """Batch systems send SIGTERM at the end of the walltime, which is no death at a source."""
    half_made.send_signal(sent)
    assert half_made.wait(WAIT_S) == (143 if sent == signal.SIGTERM else -sent)
    before = records(tmp_path)
    assert committed(tmp_path / "ds") - len(before) in (0, 1)
    assert len(list((tmp_path / "ds" / DEATHS).iterdir())) <= deaths
    assert part("0/1").code == 0
    assert records(tmp_path).items() >= before.items()
    merge()


@pytest.mark.slow
@pytest.mark.linux_only("kills processes by a signal")
def test_parts_killed_at_random_moments_end_with_the_same_bytes(
    part: Part, merge: Merge, figure: Figure, tmp_path: Path
) -> None:
    moment, kills = random.Random(5), 20
    env = imported_first(tmp_path, slow_shards(0.3))
    for _ in range(kills):
        with running("part", f"{moment.randrange(6)}/6", *SETTINGS, cwd=tmp_path, **env) as process:
            time.sleep(moment.uniform(0, 4))
            os.kill(process.pid, signal.SIGKILL)
    assert [part(f"{number}/6").code for number in range(6)] == [0] * 6
    merge()
    figure("parts", f"same bytes after {kills} kills of parts")


# What is missing ------------------------------------------------------------------------------------------------------


def test_merge_names_what_is_missing_and_writes_nothing(begun: Path, part: Part, run_main: RunMain) -> None:
    assert part("2/6").code == part("5/6").code == 0
    before = contents(begun)
    done = run_main("merge", "ds")
    assert (done.code, done.out) == (5, "")
    assert messages(done.err) == [
        "gen-dataset: merge: ds: parts 0,3-4 of 6 are not done, with 6 of 12 shards missing (0,3-4,6,9-10); run "
        "gen-dataset part K/6 with the same settings for each, then merge again; nothing was written"
    ]
    assert contents(begun) == before


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: os.truncate(path, 600)], ids=["lost", "cut"])
def test_damaged_shard_of_a_part_is_regenerated(damage: Callable[[Path], None], begun: Path, part: Part) -> None:
    damage(begun / "shards/shard-00007.tar")
    assert "2 shards committed, 1 of them (1 row" in part("1/6").out


@pytest.mark.parametrize("variable", ["SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX"])
def test_batch_system_gives_the_number(variable: str, part: Part, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable, "4")
    assert part("/6").out == "ds: part 4 of 6: 2 shards committed, 2 of them (2 rows) in this run\n"


def test_merge_ends_as_the_run_would(part: Part, run_main: RunMain, tmp_path: Path) -> None:
    """With too many failed sources it exits with 3, also when it is repeated."""
    (tmp_path / "p/003.png").write_bytes(b"no photograph")
    (tmp_path / "p/004.png").write_bytes(b"no photograph")
    assert part("0/1", "source.max_failed=1").code == 0
    for _ in range(2):
        done = run_main("merge", "ds")
        failed = "2 failed (2 unsupported; see ds/manifest.csv), more than source.max_failed=1"
        assert (done.code, failed in done.out) == (3, True)


def test_finished_dataset_needs_no_part(part: Part, run_main: RunMain, tmp_path: Path) -> None:
    assert run_main(*SETTINGS).code == 0
    before = contents(tmp_path / "ds")
    for done in (part("3/6"), run_main("merge", "ds")):
        assert (done.code, "nothing to do" in done.out) == (0, True)
    assert part("3/6", "seed=1").code == 2
    assert contents(tmp_path / "ds") == before


# Refusals -------------------------------------------------------------------------------------------------------------


K_OF_N = (
    "expected K/N, part K (from 0 to N - 1) of N, or /N with K in SLURM_ARRAY_TASK_ID, PBS_ARRAY_INDEX, "
    "JOB_COMPLETION_INDEX"
)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("part", *SETTINGS), "part: expected K/N, part K (from 0) of N; or /N in a job of an array"),
        (("part", "x/6", *SETTINGS), f"part: x/6: {K_OF_N}"),
        (("part", "/6", *SETTINGS), f"part: /6 (K is missing): {K_OF_N}"),
        (("part", "6/6", *SETTINGS), f"part: 6/6: {K_OF_N}"),
        (("part", "0/5", *SETTINGS), "part K/5: ds was begun with 6 parts; expected K/6; choose another out"),
        (("part", "0/13", *SETTINGS, "out=new"), "part 0/13: this dataset has 12 shards; expected N from 1 to 12; "
         "lower N or output.pairs_per_shard"),
        (("part", "0/6", *SETTINGS, "seed=1"), "out=ds: was begun with other settings: seed=1 (there: 0); choose "
         "another out, or finish it with its own settings: gen-dataset again ds out=ds source.root=p"),
        (("merge", "p"), "merge: p: no run has begun there; expected one; run gen-dataset part K/N first"),
    ],
)  # fmt: skip
def test_wrong_calls_are_refused_with_2(
    arguments: tuple[str, ...], message: str, begun: Path, run_main: RunMain
) -> None:
    before = contents(begun)
    done = run_main(*arguments)
    assert (done.code, messages(done.err)) == (2, [f"gen-dataset: {message}"])
    assert contents(begun) == before


def test_another_version_is_refused(begun: Path, part: Part, run_main: RunMain) -> None:
    path = begun / ".work/run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": "9.9"}))
    for done in (part("0/6"), run_main("merge", "ds")):
        assert (done.code, "was begun by unprocess_gen 9.9, this is" in done.err) == (2, True)


@pytest.mark.parametrize("change", [lambda path: path.write_bytes(b"shorter"), Path.unlink], ids=["changed", "deleted"])
def test_source_that_changed_ends_with_5_and_its_name(
    change: Callable[[Path], None], begun: Path, part: Part, tmp_path: Path
) -> None:
    change(tmp_path / "p/006.png")
    done = part("0/6")
    assert (done.code, "006.png" in done.err) == (5, True)


def test_photographs_may_be_elsewhere_on_another_host(begun: Path, part: Part, merge: Merge, tmp_path: Path) -> None:
    (tmp_path / "p").rename(tmp_path / "elsewhere")
    for number in range(6):
        assert part(f"{number}/6", "source.root=elsewhere").code == 0
    merge()


# A lock that does not work --------------------------------------------------------------------------------------------


def test_coordinators_delete_the_same_records_at_once(tmp_path: Path) -> None:
    (tmp_path / "ds/.work/rows").mkdir(parents=True)
    for number in range(500):
        (tmp_path / "ds/.work/rows" / f"{number:05d}.json").touch()
    folders = [OutFolder(str(tmp_path / "ds")) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(folder.remove_work) for folder in folders]:
            done.result()
    assert not (tmp_path / "ds/.work/rows").exists()
