"""Runs in parts: the bytes of one run, whatever the order, repetition and death of parts; refusals before any write."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from helpers.commands import Cli, RunMain, messages
from helpers.datasets import Make, Settings, TreeHash
from helpers.photographs import fill
from helpers.processes import ONE, POISON, WAIT_S, committed, imported_first, running, slow_shards, unfinished, wait_for
from helpers.promise_report import Figure

from unprocess_gen.config.schema import replaced
from unprocess_gen.config.validation import validate_config
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import parts, run_records
from unprocess_gen.pipeline.parts import left_text, shards_of_part
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.verify import verify

COUNT = 12
ROOT = "source.root=p"


@pytest.fixture(scope="module")
def undisturbed(make: Make, tree_hash: TreeHash, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Make the dataset of twelve photographs in one run, and return its hash."""
    folder = tmp_path_factory.mktemp("undisturbed")
    make(fill(folder / "p", COUNT), folder / "ds", ONE)
    return tree_hash(folder / "ds")


@pytest.fixture(scope="module")
def prepared(settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Prepare a dataset ds of twelve photographs p in six parts, and return the folder of both."""
    folder = tmp_path_factory.mktemp("prepared")
    config = settings(ONE, "n_jobs=1")
    config = replaced(config, {"source.root": str(fill(folder / "p", COUNT)), "out": str(folder / "ds")})
    validate_config(config)
    parts.prepare(config, 6)
    return folder


@pytest.fixture(scope="module")
def made(prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make all parts of a copy of the prepared dataset, and return it."""
    ds = shutil.copytree(prepared / "ds", tmp_path_factory.mktemp("made") / "ds")
    for part in range(6):
        parts.make_part(str(ds), part)
    return ds


@pytest.fixture
def photographs(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(prepared / "p", tmp_path / "p")


def copied(dataset: Path, photographs: Path) -> Path:
    """Copy a dataset to the folder of its photographs."""
    ds = shutil.copytree(dataset, photographs.with_name("ds"))
    edit_json(ds / ".work/plan.json", root=str(photographs))
    return ds


@pytest.fixture
def ds(prepared: Path, photographs: Path) -> Path:
    """Return a dataset that is prepared in six parts."""
    return copied(prepared / "ds", photographs)


@pytest.fixture
def ds_made(made: Path, photographs: Path) -> Path:
    """Return a dataset that is prepared in six parts, all of which are made."""
    return copied(made, photographs)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def edit_json(path: Path, **values: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def replace_text(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


# Same bytes -----------------------------------------------------------------------------------------------------------


def test_shuffled_and_doubled_parts_make_the_bytes_of_one_run(
    ds: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, figure: Figure
) -> None:
    order = [*range(6), *range(6)]
    random.Random(1).shuffle(order)
    assert [run_main("part", "ds", part, "-q").code for part in order] == [0] * 12
    done = run_main("merge", "ds")
    assert (done.code, done.out.split(",")[0]) == (0, "ds: 12 pairs")
    assert tree_hash(ds) == undisturbed
    assert (verify(ds), sorted(os.listdir(ds))) == ([], ["config.yaml", "dataset.json", "manifest.csv", "shards"])
    figure("parts", "same bytes from six parts in shuffled order, each made twice")


@pytest.mark.parametrize(("first", "then"), [("run", "parts"), ("parts", "run")])
def test_run_begun_one_way_is_finished_the_other(
    first: str, then: str, photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, make: Make,
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:  # fmt: skip
    def by_parts(numbers: range) -> None:
        assert run_main("prepare", "parts=6", ROOT, ONE, "n_jobs=1", "out=ds").code == 0
        assert [run_main("part", "ds", part, "-q").code for part in numbers] == [0] * len(numbers)

    if first == "parts":
        by_parts(range(2, 5))
        assert make(photographs, tmp_path / "ds", ONE).made == 6
    else:
        from unprocess_gen.pipeline import generate as runner

        run_tasks = runner.run_tasks

        def stopped(*given: Any) -> Any:
            for number, report in enumerate(run_tasks(*given)):
                if number == 4:
                    raise KeyboardInterrupt
                yield report

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(runner, "run_tasks", stopped)
            make(photographs, tmp_path / "ds", ONE)
        by_parts(range(6))
        assert run_main("merge", "ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


@pytest.fixture
def half_made(photographs: Path, run_main: RunMain, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Start the only part of a dataset ds, and wait until some of its shards are committed."""
    assert run_main("prepare", "parts=1", ROOT, ONE, "n_jobs=1", "out=ds").code == 0
    env = imported_first(tmp_path, unfinished(tmp_path / "ds", COUNT - 4))
    with running("part", "ds", "0", cwd=tmp_path, **env) as process:
        wait_for(lambda: len(records(tmp_path)) >= 3)
        yield process


def records(folder: Path) -> dict[str, int]:
    """Return the name and time of each record of a dataset ds in ``folder``."""
    return {path.name: path.stat().st_mtime_ns for path in (folder / "ds/.work/rows").glob("*")}


@pytest.mark.linux_only("kills a process by a signal")
def test_killed_part_loses_at_most_one_shard(
    half_made: subprocess.Popen[str], run_main: RunMain, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    half_made.kill()
    half_made.wait()
    before = records(tmp_path)
    assert committed(tmp_path / "ds") - len(before) in (0, 1)
    assert run_main("part", "ds", 0, "-q").code == 0
    assert records(tmp_path).items() >= before.items()
    assert run_main("merge", "ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


@pytest.mark.linux_only("ends a process by a signal")
def test_part_ended_at_its_walltime_counts_no_death(
    half_made: subprocess.Popen[str], run_main: RunMain, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    """Batch systems send SIGTERM at the end of the walltime."""
    half_made.terminate()
    assert half_made.wait(WAIT_S) == 143
    assert list((tmp_path / "ds" / run_records.DEATHS_FOLDER).iterdir()) == []
    assert run_main("part", "ds", 0, "-q").code == 0
    assert run_main("merge", "ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


@pytest.mark.slow
@pytest.mark.linux_only("kills processes by a signal")
def test_parts_killed_at_random_moments_end_with_the_same_bytes(
    ds: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash, figure: Figure, tmp_path: Path
) -> None:
    moment, kills = random.Random(5), 0
    env = imported_first(tmp_path, slow_shards(0.3))
    while kills < 20:
        left = left_text(parts.parts_status("ds").left)
        part = moment.choice(left.replace("-", ",").split(",")) if left else "0"
        with running("part", "ds", part, cwd=tmp_path, **env) as process:
            time.sleep(moment.uniform(0, 4))
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
    for part in range(6):
        assert run_main("part", "ds", part, "-q").code == 0
    assert run_main("merge", "ds").code == 0
    assert tree_hash(ds) == undisturbed
    figure("parts", f"same bytes after {kills} kills of parts")


def test_report_names_the_parts_of_a_dataset(ds_made: Path, run_main: RunMain) -> None:
    run_main("merge", "ds")
    assert run_main("report", "ds").code == 0
    assert "merged from 6 parts" in (ds_made / "report.html").read_text()


# What is left ---------------------------------------------------------------------------------------------------------


def test_merge_names_the_parts_left_and_writes_nothing(ds: Path, run_main: RunMain) -> None:
    for part in (1, 2, 5):
        run_main("part", "ds", part, "-q")
    before = files(ds)
    done = run_main("merge", "ds")
    assert (done.code, done.out) == (5, "")
    assert messages(done.err) == [
        "gen-dataset: merge: ds: parts left: 0,3-4 (of 6), 6 of 12 shards; run gen-dataset part ds K for each, "
        "then merge again; nothing was written"
    ]
    assert files(ds) == before
    assert run_main("status", "ds", "--left").out == "0,3-4\n"
    assert run_main("status", "ds") == (0, "ds: 3 of 6 parts done, 6 of 12 shards committed; left: 0,3-4\n", "")


@pytest.mark.parametrize("variable", ["SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX", "JOB_COMPLETION_INDEX"])
def test_batch_system_gives_the_number(
    variable: str, ds: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(variable, "4")
    assert run_main("part", "ds").out.startswith("ds: part 4 of 6: 2 shards committed, 2 of them (2 rows)")


def test_finished_dataset_needs_no_part(photographs: Path, run_main: RunMain, make: Make, tmp_path: Path) -> None:
    make(photographs, tmp_path / "ds", ONE)
    before = files(tmp_path / "ds")
    for arguments in (("part", "ds", 3), ("merge", "ds"), ("prepare", "parts=2", ROOT, ONE, "out=ds")):
        done = run_main(*arguments)
        assert (done.code, "nothing to do" in done.out) == (0, True), arguments
    assert run_main("status", "ds").out == "ds is complete\n"
    assert files(tmp_path / "ds") == before


@pytest.mark.parametrize(("count", "shards"), [(1, 1), (3, 7), (7, 100)])
def test_parts_cover_every_shard_once(count: int, shards: int) -> None:
    ranges = [shards_of_part(part, count, shards) for part in range(count)]
    assert [shard for some in ranges for shard in some] == list(range(shards))
    assert max(map(len, ranges)) - min(map(len, ranges)) <= 1


@pytest.mark.parametrize(("numbers", "text"), [([], ""), ([3], "3"), ([3, 7, 8, 9], "3,7-9"), ([0, 1, 3], "0-1,3")])
def test_ranges_are_written_as_batch_systems_read_them(numbers: list[int], text: str) -> None:
    assert left_text(numbers) == text


# Refusals -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("prepare", "parts=5", ROOT, ONE, "n_jobs=1", "out=ds"),
         "parts=5: ds was prepared with parts=6; expected that number; choose another out"),
        (("prepare", "parts=13", ROOT, ONE, "n_jobs=1", "out=ds"),
         "parts=13: this dataset has 12 shards; expected 1 to 12; lower parts or output.pairs_per_shard"),
        (("prepare", "parts=6", ROOT, ONE, "seed=1", "out=ds"),
         "out=ds: was begun with other settings: seed=1 (there: 0); choose another out, or finish it with its "
         "own settings: gen-dataset again ds out=ds source.root=p"),
        (("part", "ds", "6"), "part 6: ds has 6 parts; expected 0 to 5"),
        (("part", "ds", "0", "n_jobs=0"), "n_jobs=0: expected 1 to 1024 or -1 for one per core"),
        (("part", "ds", "0", "source.root=none"), "source.root=none: no such folder or file; expected an "
         "existing folder of photographs"),
        (("part", "ds", "x"), "part: part=x: expected an integer"),
        (("part", "ds"), "part: its number is missing; expected it after ds, or in one of SLURM_ARRAY_TASK_ID, "
         "PBS_ARRAY_INDEX, JOB_COMPLETION_INDEX"),
        (("part", "p", "0"), "out=p: contains no plan of a run in parts; expected one; run gen-dataset prepare first"),
        (("merge", "p"), "out=p: contains no plan of a run in parts; expected one; run gen-dataset prepare first"),
    ],
)  # fmt: skip
def test_wrong_calls_are_refused_with_2(arguments: tuple[str, ...], message: str, ds: Path, run_main: RunMain) -> None:
    before = files(ds)
    done = run_main(*arguments)
    assert (done.code, messages(done.err)) == (2, [f"gen-dataset: {message}"])
    assert files(ds) == before


CHANGES: list[tuple[str, Callable[[Path], Any], str]] = [
    ("version", lambda ds: edit_json(ds / ".work/plan.json", version="9.9"), "was begun by unprocess_gen 9.9, this is"),
    ("settings", lambda ds: replace_text(ds / "config.yaml", "seed: 0", "seed: 1"),
     "its config.yaml is not the one that was prepared; prepare another out"),
    ("listing", lambda ds: edit_json(ds / ".work/listing.json", sources=11),
     "its listing of sources is not the one that was prepared; prepare another out"),
    ("lost listing", lambda ds: (ds / ".work/listing.json").unlink(),
     "its listing of sources is not the one that was prepared; prepare another out"),
    ("unreadable settings", lambda ds: (ds / "config.yaml").write_bytes(b"\xff"),
     "its config.yaml is not the one that was prepared; prepare another out"),
]  # fmt: skip


@pytest.mark.parametrize(("what", "change", "message"), CHANGES, ids=[what for what, _, _ in CHANGES])
@pytest.mark.parametrize("verb", ["part", "merge"])
def test_other_version_settings_or_listing_is_refused_with_2(
    verb: str, what: str, change: Callable[[Path], Any], message: str, prepared: Path, made: Path, photographs: Path,
    run_main: RunMain,
) -> None:  # fmt: skip
    ds = copied(prepared / "ds" if verb == "part" else made, photographs)
    change(ds)
    before = files(ds)
    done = run_main(*(("part", "ds", "0") if verb == "part" else ("merge", "ds")))
    assert (done.code, len(messages(done.err)), message in done.err) == (2, 1, True), done.err
    assert files(ds) == before


def test_source_that_changed_ends_with_5_and_its_name(ds: Path, photographs: Path, run_main: RunMain) -> None:
    (photographs / "007.png").write_bytes(b"shorter")
    done = run_main("part", "ds", 3)
    assert (done.code, "source 007.png changed since it was listed" in done.err) == (5, True)


def test_photographs_may_be_elsewhere_on_another_host(
    ds: Path, photographs: Path, run_main: RunMain, undisturbed: str, tree_hash: TreeHash
) -> None:
    photographs.rename(photographs.with_name("elsewhere"))
    for part in range(6):
        assert run_main("part", "ds", part, "source.root=elsewhere", "-q").code == 0
    assert run_main("merge", "ds").code == 0
    assert tree_hash(ds) == undisturbed


# Deaths ---------------------------------------------------------------------------------------------------------------


@pytest.mark.linux_only("kills a process by a signal")
@pytest.mark.slow
def test_photograph_that_kills_its_part_gets_provisional_rows(
    photographs: Path, run_main: RunMain, cli: Cli, undisturbed: str, tree_hash: TreeHash, tmp_path: Path
) -> None:
    killer = shutil.copy(photographs / "004.png", tmp_path / "killer.png")
    assert run_main("prepare", "parts=2", ROOT, ONE, "n_jobs=1", "out=ds").code == 0
    env = imported_first(tmp_path, POISON) | {"KILLER": str(killer)}
    codes = [cli("part", "ds", 0, **env).returncode for _ in range(run_records.MAX_DEATHS)]
    assert codes == [-signal.SIGKILL] * run_records.MAX_DEATHS
    done = cli("part", "ds", 0, **env)
    assert done.returncode == 0, done.stderr
    assert (
        "gen-dataset: part 0 of 2: 004.png: its worker died four times; run the same command again to retry it"
        in messages(done.stderr)
    )
    assert run_main("part", "ds", 1, "-q").code == 0
    merged = run_main("merge", "ds")
    assert merged.code == 3
    reasons = [(row["source"], row["reason"]) for row in read_rows(tmp_path / "ds/manifest.csv") if row["reason"]]
    assert reasons == [("004.png", "worker_died")]
    Path(killer).unlink()
    assert run_main("part", "ds", 0, "-q").code == 0
    assert run_main("merge", "ds").code == 0
    assert tree_hash(tmp_path / "ds") == undisturbed


# A lock that does not work --------------------------------------------------------------------------------------------


def test_coordinators_delete_the_same_records_at_once(tmp_path: Path) -> None:
    (tmp_path / "ds/.work/rows").mkdir(parents=True)
    for number in range(500):
        (tmp_path / "ds/.work/rows" / f"{number:05d}.json").touch()
    storages = [Storage(str(tmp_path / "ds")) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(storage.remove_work, keep_records=False) for storage in storages]:
            done.result()
    assert not (tmp_path / "ds/.work/rows").exists()
