"""Repair regenerates damaged files to the same bytes, changes no other file, and reports what it cannot regenerate."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, contents, flip
from helpers.photographs import fill
from helpers.processes import held, interrupt
from helpers.promise_report import Figure

from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.folder import OutFolder
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources.names import decode_name

SHARDS = tuple(f"shards/shard-0000{number}.tar" for number in range(4))
OTHERS = ("config.yaml", "manifest.csv", *SHARDS)
"""The files that ``dataset.json`` proves."""


@pytest.fixture(scope="module")
def sources(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the photographs and two files that cannot be used."""
    folder = tmp_path_factory.mktemp("sources") / "photos"
    shutil.copytree(photos, folder)
    (folder / "broken.jpg").write_bytes((folder / "turned.jpg").read_bytes()[:300])
    (folder / "sub" / "empty.png").touch()
    return folder


@pytest.fixture(scope="module")
def intact(sources: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("repair") / "ds"
    make(sources, out, "output.pairs_per_shard=4")
    return out


@pytest.fixture
def copy(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / "ds"))


def assert_repaired(copy: Path, intact: Path, run_main: RunMain) -> None:
    """Repair, and compare with the intact dataset; facts about the run may be lost with ``dataset.json``."""
    done = run_main("verify", copy, "--repair")
    assert done.code == 0, done.err
    found, wanted = contents(copy), contents(intact)
    if json.loads(found["dataset.json"])["run"] is None:
        del found["dataset.json"], wanted["dataset.json"]
        shutil.copy(intact / "dataset.json", copy)
    assert found == wanted
    assert verify(copy) == []


@pytest.mark.parametrize("name", ["config.yaml", "manifest.csv", "dataset.json", SHARDS[1]])
@pytest.mark.parametrize(
    "damage",
    [Path.unlink, lambda path: os.truncate(path, path.stat().st_size // 3), lambda path: flip(path, 625)],
    ids=["missing", "truncated", "flipped"],
)
def test_damaged_file_is_restored(
    damage: Callable[[Path], None], name: str, intact: Path, copy: Path, run_main: RunMain
) -> None:
    damage(copy / name)
    assert_repaired(copy, intact, run_main)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*OTHERS, "dataset.json"])
def test_flipped_bits_are_repaired(name: str, intact: Path, copy: Path, run_main: RunMain, figure: Figure) -> None:
    bits = np.random.default_rng(100).integers(0, 8 * (intact / name).stat().st_size, 100)
    for at, bit in zip(*np.divmod(bits, 8), strict=True):
        flip(copy / name, int(at), int(bit))
        assert_repaired(copy, intact, run_main)
    figure("repair", f"{len(bits)} of {len(bits)} flipped bits repaired")


def test_manifest_and_shards_are_restored_together(intact: Path, copy: Path, run_main: RunMain) -> None:
    (copy / "manifest.csv").unlink()
    (copy / SHARDS[0]).rename(copy / "other")
    (copy / SHARDS[1]).rename(copy / SHARDS[0])
    (copy / "other").rename(copy / SHARDS[1])
    (copy / SHARDS[2]).unlink()
    assert_repaired(copy, intact, run_main)


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: flip(path, 625)], ids=["missing", "flipped"])
def test_manifest_is_restored_from_the_shards_without_sources(
    damage: Callable[[Path], None], make: Make, run_main: RunMain, tmp_path: Path
) -> None:
    """Rows of patches, noise levels, draws and targets are in the shards."""
    sources, out = fill(tmp_path / "p", 5), tmp_path / "ds"
    settings = "noise=sony_a7s2", "noise.levels=[1600,3200]", "noise.draws=2", "source.patch=[random,8,2]"
    make(sources, out, *settings, "output.pairs_per_shard=2", "output.targets=[linear_rgb]")
    shutil.rmtree(sources)
    wanted = contents(out)
    damage(out / "manifest.csv")
    done = run_main("verify", out, "--repair")
    assert (done.code, "manifest.csv: restored from the rows in the shards" in done.out) == (0, True)
    assert contents(out) == wanted


def test_manifest_with_failed_sources_needs_them_or_the_records(
    sources: Path, make: Make, run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run whose rows are provisional keeps its records."""
    own, out = Path(shutil.copytree(sources, tmp_path / "p")), tmp_path / "ds"
    monkeypatch.setattr(OutFolder, "remove_work", lambda folder: None)
    make(own, out)
    shutil.rmtree(own)
    wanted = (out / "manifest.csv").read_bytes()
    (out / "manifest.csv").unlink()
    done = run_main("verify", out, "--repair")
    assert (done.code, "manifest.csv: restored from the rows in .work/rows" in done.out) == (0, True)
    assert (out / "manifest.csv").read_bytes() == wanted
    (out / "manifest.csv").unlink()
    shutil.rmtree(out / ".work")
    before = contents(out)
    refused = run_main("verify", out, "--repair")
    assert (refused.code, f"source.root={own}: " in refused.err) == (2, True)
    assert contents(out) == before


def test_only_sources_without_a_stored_row_are_read(
    intact: Path, copy: Path, sources: Path, run_main: RunMain, tmp_path: Path
) -> None:
    changed = Path(shutil.copytree(sources, tmp_path / "changed"))
    for row in read_rows(intact / "manifest.csv"):
        if row["status"] == "ok":
            (changed / decode_name(str(row["source"]))).write_bytes(b"\0" * int(row["source_bytes"]))
    (copy / "manifest.csv").unlink()
    assert run_main("verify", copy, "--repair", f"source.root={changed}").code == 0
    assert (copy / "manifest.csv").read_bytes() == (intact / "manifest.csv").read_bytes()


def test_lost_dataset_json_is_rewritten_and_reported(
    intact: Path, copy: Path, sources: Path, run_main: RunMain
) -> None:
    (copy / "dataset.json").unlink()
    done = run_main("verify", copy, "--repair", f"source.root={sources}")
    assert (done.code, "host, time and versions of the run are lost" in done.out) == (0, True)
    new, old = (json.loads((folder / "dataset.json").read_text()) for folder in (copy, intact))
    lost = {"dataset_sha256", "not_matched", "run", "skipped_links", "versions"}
    assert {name for name in old if old[name] != new[name]} == lost


def test_manifest_needs_the_place_of_the_sources_if_none_is_recorded(
    copy: Path, intact: Path, sources: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(sources)  # the folder of the command is no place of sources
    for name in ("dataset.json", "manifest.csv"):
        (copy / name).unlink()
        if name == "dataset.json":
            assert run_main("verify", copy, "--repair").code == 0
    refused = run_main("verify", copy, "--repair")
    assert refused.code == 2
    assert "source.root is missing" in refused.err
    assert run_main("verify", copy, "--repair", f"source.root={sources}").code == 0
    assert (copy / "manifest.csv").read_bytes() == (intact / "manifest.csv").read_bytes()


@pytest.mark.parametrize("lost", [True, False], ids=["missing", "damaged"])
@pytest.mark.parametrize("other", ["config.yaml", "manifest.csv"])
def test_damage_that_nothing_proves_is_refused_in_one_line(
    other: str, lost: bool, copy: Path, run_main: RunMain
) -> None:
    dataset, content = copy / "dataset.json", (copy / other).read_bytes()
    changed = content.replace(b"smoothstep", b"smoothstfp") if other == "config.yaml" else content[:-1000]
    (copy / other).write_bytes(changed)
    if lost:
        dataset.unlink()
    else:
        dataset.write_text(dataset.read_text().replace('"host"', '"hosu"'))
    done = run_main("verify", copy, "--repair")
    assert done.code == 4
    assert done.err.splitlines()[-1].startswith(f"gen-dataset: {copy}: dataset.json and another file are damaged; ")
    assert (copy / other).read_bytes() == changed


def test_manifest_is_not_restored_from_other_sources(
    copy: Path, sources: Path, run_main: RunMain, tmp_path: Path
) -> None:
    (copy / "manifest.csv").unlink()
    changed = shutil.copytree(sources, tmp_path / "changed")
    shutil.copy(sources / "wide.png", changed / "new.png")
    done = run_main("verify", copy, "--repair", f"source.root={changed}")
    assert (done.code, "a source was changed, added or deleted" in done.err) == (5, True)
    assert not (copy / "manifest.csv").exists()


def test_changed_source_is_named_and_other_shards_are_repaired(
    copy: Path, intact: Path, run_main: RunMain, sources: Path, tmp_path: Path
) -> None:
    changed = Path(shutil.copytree(sources, tmp_path / "changed"))
    name = next(str(row["source"]) for row in read_rows(intact / "manifest.csv") if row["shard"] == 1)
    shutil.copy(changed / "wide.png", changed / name)
    shutil.rmtree(copy / "shards")
    done = run_main("verify", copy, "--repair", f"source.root={changed}")
    assert done.code == 5
    assert f"{SHARDS[1]}: cannot be regenerated: source {name}" in done.err
    assert all((copy / shard).read_bytes() == (intact / shard).read_bytes() for shard in (SHARDS[0], *SHARDS[2:]))
    assert not (copy / ".work").exists()


def test_dataset_locked_by_a_run_stays_unchanged(copy: Path, run_main: RunMain) -> None:
    flip(copy / SHARDS[0], 999)
    before = contents(copy)
    with held(copy):
        assert run_main("verify", copy, "--repair").code == 11
    shutil.rmtree(copy / ".work")
    assert contents(copy) == before


def test_intact_dataset_is_not_written_to(copy: Path, run_main: RunMain) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    assert run_main("verify", copy, "--repair").out == f"{copy} is intact\n"
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before


def test_interrupted_repair_adds_no_damage(
    intact: Path, copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (SHARDS[0], SHARDS[2]):
        flip(copy / name, 3000)
    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", interrupt)
        assert run_main("verify", copy, "--repair").code == 130
    assert {damage.file for damage in verify(copy)} == {SHARDS[0], SHARDS[2]}
    assert_repaired(copy, intact, run_main)
