"""Runs: what the data depend on, shards, failed photographs, ``dataset.json``, progress."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import Cli
from helpers.datasets import Make, TreeHash
from helpers.photographs import PHOTOS, fill, pixels
from helpers.processes import wait_for
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.cli.messages import logging_to_stderr
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline import generate as runner
from unprocess_gen.pipeline import worker
from unprocess_gen.pipeline.executors import local
from unprocess_gen.pipeline.tasks import COUNTS

SHARDS_OF_5 = "output.pairs_per_shard=5"


def rows(out: Path) -> list[dict[str, Any]]:
    return [dict(row) for row in read_rows(out / "manifest.csv")]


def facts(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "dataset.json").read_text(encoding="utf-8")))


def sha256(path: Path) -> str:
    return subprocess.run(["sha256sum", path], capture_output=True, text=True, check=True).stdout.split()[0]


# What the data do not depend on ---------------------------------------------------------------------------------------


@pytest.mark.linux_only("sets the umask")
@pytest.mark.parametrize(("n_jobs", "umask"), [(1, 0o022), (2, 0o022), (1, 0o077)])
def test_number_of_workers_and_umask_change_no_byte(
    n_jobs: int, umask: int, make: Make, photos: Path, dataset: Path, tree_hash: TreeHash, tmp_path: Path,
    figure: Figure,
) -> None:  # fmt: skip
    before = os.umask(umask)
    try:
        make(photos, tmp_path / "ds", SHARDS_OF_5, n_jobs=n_jobs)
    finally:
        os.umask(before)
    assert tree_hash(tmp_path / "ds") == tree_hash(dataset)
    figure("workers", f"same bytes in {len(rows(tmp_path / 'ds'))} of {len(rows(dataset))} pairs")


def test_place_locale_clock_and_hash_seed_change_no_byte(
    cli: Cli, photos: Path, dataset: Path, tree_hash: TreeHash, tmp_path: Path, figure: Figure
) -> None:
    (tmp_path / "a/b").mkdir(parents=True)
    root = os.path.relpath(photos, tmp_path / "a/b")
    done = cli(
        f"source.root='{root}'", f"out={tmp_path}/ds", SHARDS_OF_5, "n_jobs=1", cwd=tmp_path / "a/b",
        TZ="Asia/Kathmandu", PYTHONHASHSEED="77", LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert tree_hash(tmp_path / "ds") == tree_hash(dataset)
    figure("workers", f"same bytes in {len(rows(tmp_path / 'ds'))} of {len(rows(dataset))} pairs")


def test_seed_changes_every_noisy_frame(make: Make, photos: Path, dataset: Path, tmp_path: Path) -> None:
    make(photos, tmp_path / "ds", SHARDS_OF_5, "seed=1")
    for mine, theirs in zip(rows(tmp_path / "ds"), rows(dataset), strict=True):
        assert mine["stream_key"] != theirs["stream_key"]
        assert mine["noisy_xxh3"] != theirs["noisy_xxh3"]


# Images are independent -----------------------------------------------------------------------------------------------


def by_source(out: Path) -> dict[str, Any]:
    """Return row and arrays of each image, without its place in the listing."""
    return {
        str(sample.row["source"]): (
            {name: value for name, value in sample.row.items() if name not in ("key", "shard")},
            sample.clean.tobytes(),
            sample.noisy.tobytes(),
        )
        for sample in RawPairs(out)
    }


@pytest.mark.parametrize("shard", [1, 3])
def test_adding_a_file_leaves_other_images_unchanged(shard: int, make: Make, tmp_path: Path, figure: Figure) -> None:
    source = fill(tmp_path / "p", 5)
    make(source, tmp_path / "before", f"output.pairs_per_shard={shard}", "camera=choice", "noise=brooks2019")
    Image.fromarray(pixels(99, 14, 14)).save(source / "000-first.png")
    make(source, tmp_path / "after", f"output.pairs_per_shard={shard}", "camera=choice", "noise=brooks2019")
    before, after = by_source(tmp_path / "before"), by_source(tmp_path / "after")
    assert after.keys() - before.keys() == {"000-first.png"}
    assert {name: after[name] for name in before} == before
    figure("independence", f"{sum(after[name] == before[name] for name in before)} of {len(before)} images unchanged")


def test_source_limit_leaves_kept_images_unchanged(make: Make, dataset: Path, photos: Path, tmp_path: Path) -> None:
    make(photos, tmp_path / "ds", "source.limit=4")
    kept, every = by_source(tmp_path / "ds"), by_source(dataset)
    assert list(kept) == list(PHOTOS[:4])
    assert kept == {name: every[name] for name in kept}


def test_another_noise_profile_leaves_other_draws_unchanged(
    make: Make, photos: Path, dataset: Path, tmp_path: Path
) -> None:
    make(photos, tmp_path / "ds", SHARDS_OF_5, "noise=brooks2019")
    for mine, theirs in zip(rows(tmp_path / "ds"), rows(dataset), strict=True):
        for name in ("red_gain", "blue_gain", "inverse_rgb_gain", "rgb2cam_00", "w_sony_a7r", "clean_xxh3"):
            assert mine[name] == theirs[name]


def test_identical_files_differ_and_the_first_by_name_is_as_if_alone(make: Make, tmp_path: Path) -> None:
    source = fill(tmp_path / "p", 3)
    make(source, tmp_path / "one")
    for name in ("z.png", "a.png"):
        (source / name).write_bytes((source / "001.png").read_bytes())
    make(source, tmp_path / "three")
    same = [row for row in rows(tmp_path / "three") if row["source"] in ("001.png", "a.png", "z.png")]
    assert [len({row[name] for row in same}) for name in ("source_sha256", "stream_key", "noisy_xxh3")] == [1, 3, 3]
    assert by_source(tmp_path / "three")["001.png"] == by_source(tmp_path / "one")["001.png"]


# Rows, shards, failures -----------------------------------------------------------------------------------------------


def test_recorded_source_digests_equal_those_of_the_files(dataset: Path, photos: Path) -> None:
    assert [row["source"] for row in rows(dataset)] == list(PHOTOS)
    files = sorted(
        (path for path in photos.rglob("*.*") if path.name != "notes.txt"), key=lambda p: bytes(p.relative_to(photos))
    )
    assert [row["source_sha256"] for row in rows(dataset)] == [sha256(path) for path in files]
    assert [row["source_bytes"] for row in rows(dataset)] == [path.stat().st_size for path in files]


def test_orientation_is_applied_and_recorded(dataset: Path) -> None:
    found = {row["source"]: (row["orientation"], row["width"], row["height"]) for row in rows(dataset)}
    assert found["turned.jpg"] == (6, 16, 24)
    assert found["comma, and space.jpg"] == (1, 37, 23)


@pytest.fixture(scope="module")
def broken(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a dataset of 9 photographs in shards of 2; all of shard 1 and one of shard 2 fail."""
    source = fill(tmp_path_factory.mktemp("broken") / "p", 9)
    intact = (source / "002.png").read_bytes()
    (source / "002.png").write_bytes(intact[: len(intact) // 2])
    (source / "003.png").write_bytes(b"")
    (source / "005.png").write_bytes(b"not a photograph")
    (source / "006.png").unlink()
    os.mkfifo(source / "006.png")
    (source / "008.png").unlink()
    (source / "008.png").symlink_to("nowhere")
    make(source, source.parent / "ds", "output.pairs_per_shard=2")
    return source.parent / "ds"


def test_failed_photographs_have_rows_with_a_reason_and_no_values_of_a_pair(broken: Path) -> None:
    assert [row["reason"] for row in rows(broken)] == [
        "", "", "truncated", "empty", "", "unsupported", "not_a_file", "", "unreadable",
    ]  # fmt: skip
    assert [row["status"] == "failed" for row in rows(broken)] == [row["reason"] != "" for row in rows(broken)]
    assert [i for i, row in enumerate(rows(broken)) if not row["source_sha256"]] == [3, 6, 8]
    assert [row["key"] for row in rows(broken)] == [f"{i:08d}" for i in range(9)]
    assert [row["shard"] for row in rows(broken)] == [0, 0, 1, 1, 2, 2, 3, 3, 4]
    filled = {name for name, value in rows(broken)[2].items() if value not in (None, "")}
    names = "key", "source", "source_sha256", "source_bytes", "status", "reason", "shard", "seed", "detail"
    assert filled == {*names}
    assert str(broken.parent) not in str(rows(broken)[2]["detail"])


def test_shard_without_pairs_has_an_entry_and_no_file(broken: Path) -> None:
    assert facts(broken)["shards"][1] == {"file": None, "pairs": 0, "failed": 2, "bytes": 0, "sha256": None}
    assert sorted(path.name for path in (broken / "shards").iterdir()) == [
        "shard-00000.tar", "shard-00002.tar", "shard-00003.tar",
    ]  # fmt: skip
    assert facts(broken)["failed"] == {"empty": 1, "not_a_file": 1, "truncated": 1, "unreadable": 1, "unsupported": 1}
    entries = facts(broken)["shards"]
    assert [(entry["pairs"], entry["failed"]) for entry in entries] == [(2, 0), (0, 2), (1, 1), (1, 1), (0, 1)]


def test_dataset_without_pairs_is_complete(make: Make, tmp_path: Path) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p/empty.png").touch()
    summary = make(tmp_path / "p", tmp_path / "ds")
    assert (summary.pairs, summary.failed, summary.shards, summary.bytes) == (0, {"empty": 1}, 1, 0)
    assert len(RawPairs(tmp_path / "ds")) == 0


# The three files ------------------------------------------------------------------------------------------------------


def test_dataset_json_records_digests_source_and_versions(dataset: Path, photos: Path) -> None:
    known = facts(dataset)
    digests = [sha256(dataset / name) for name in ("config.yaml", "manifest.csv")]
    assert [known["config_sha256"], known["manifest_sha256"]] == digests
    assert known["fingerprint"] == hashlib.sha256("{}\n{}\n".format(*digests).encode()).hexdigest()
    assert all(entry["sha256"] == sha256(dataset / entry["file"]) for entry in known["shards"])
    assert sorted(os.listdir(dataset)) == ["config.yaml", "dataset.json", "manifest.csv", "shards"]
    assert (known["not_matched"], known["skipped_links"]) == (1, 0)
    assert known["source"] == {"kind": "folder", "root": str(photos)}
    assert {*runner.PACKAGES, "pillow-heif"} == set(known["versions"])
    assert known["versions"]["numpy"] == np.__version__


@pytest.mark.parametrize("n_jobs", [1, 2])
def test_times_of_stages_are_those_of_all_shards(n_jobs: int, photos: Path, make: Make, tmp_path: Path) -> None:
    started = time.process_time()
    times = make(photos, tmp_path / "ds", "output.pairs_per_shard=2", "noise.draws=2", n_jobs=n_jobs).times
    own_s = time.process_time() - started

    assert times.decode_s > 0
    assert times.simulate_s > 0
    assert n_jobs == 2 or times.decode_s + times.simulate_s < own_s


@pytest.mark.parametrize("name", ["config.yaml", "manifest.csv"])
def test_data_contain_no_path_host_or_version(name: str, dataset: Path, photos: Path) -> None:
    text = (dataset / name).read_text(encoding="utf-8")
    for word in (str(photos), str(dataset), os.uname().nodename + ".", np.__version__):
        assert word not in text


# Synthetic scenes -----------------------------------------------------------------------------------------------------


def test_built_in_scenes_are_the_source_without_a_root(make: Make, tmp_path: Path) -> None:
    summary = make(None, tmp_path / "ds", "source.limit=3")
    assert (summary.pairs, summary.made, summary.rows) == (3, 3, 3)
    assert [row["source"] for row in rows(tmp_path / "ds")] == ["dead_leaves-0", "colour_chart-0", "highlights-0"]
    assert [row["source_bytes"] for row in rows(tmp_path / "ds")] == [0] * 3
    assert facts(tmp_path / "ds")["source"] == {"kind": "synthetic", "root": None}


# Work -----------------------------------------------------------------------------------------------------------------


def test_number_of_workers_follows_from_tasks_and_allowed_cores() -> None:
    assert [local.effective_jobs(4, tasks) for tasks in (0, 1, 3, 9)] == [1, 1, 3, 4]
    assert local.effective_jobs(-1, 10**6) == len(os.sched_getaffinity(0))


def test_progress_is_plain_lines_without_a_terminal(make: Make, photos: Path, tmp_path: Path, capfd: Any) -> None:
    with logging_to_stderr():
        make(photos, tmp_path / "ds")
    out, err = capfd.readouterr()
    assert out == ""
    assert re.fullmatch(r"gen-dataset: 13/13 images, [\d.]+ images/s, 0 failed, 0 s left\n", err)


COMPILING = "gen-dataset: 0/1 images, compiling kernels for this kind of noise and frames, once per environment"


@pytest.mark.parametrize("compiled", [False, True])
def test_run_reports_compiling_unless_kernels_are_compiled(
    compiled: bool, make: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiling is simulated: the self-test, which compiles, ends once its report was printed."""
    shown: list[str] = []

    def is_shown() -> bool:
        shown.append(capsys.readouterr().err)
        return COMPILING in "".join(shown)

    def compile_kernels(*_: object) -> dict[str, str]:
        if not compiled:
            wait_for(is_shown)
        return {}

    monkeypatch.setattr(worker.self_test, "are_compiled", lambda kernels: compiled)
    monkeypatch.setattr(worker.self_test, "failures", compile_kernels)
    with logging_to_stderr():
        make(fill(tmp_path / "p", 1), tmp_path / "ds", "self_test=stop")
    assert (COMPILING in "".join([*shown, capsys.readouterr().err])) is not compiled


def test_summary_adds_up_the_counts_of_the_manifest(dataset: Path) -> None:
    rows = [sample.row for sample in RawPairs(dataset)]
    known = facts(dataset)["sites"]
    assert known["all"] == sum(row["width"] * row["height"] for row in rows)
    assert {name: sum(row[name] or 0 for row in rows) for name in COUNTS} == {name: known[name] for name in COUNTS}
