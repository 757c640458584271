"""Repair restores damaged files to the same bytes, changes no other file, and reports what it cannot restore."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make
from helpers.photographs import fill, pixels
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen.config.composition import load_config
from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.locks import LockFile
from unprocess_gen.pipeline import repair
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources import loader

FILES = ("config.yaml", "manifest.csv", "dataset.json", *(f"shards/shard-0000{number}.tar" for number in range(4)))


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


def assert_repaired(copy: Path, intact: Path, run_main: RunMain, *arguments: object) -> str:
    """Repair, compare with the intact dataset, and return the output."""
    done = run_main("verify", copy, "--repair", *arguments)
    assert done.code == 0, done.err
    assert contents(copy) == contents(intact)
    assert verify(copy) == []
    return done.out


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and "set_aside" not in path.parts)
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def flip(path: Path, bit: int) -> None:
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)


def lost(folder: Path) -> bool:
    """Return whether the facts about the run were lost."""
    return json.loads((folder / "dataset.json").read_text())["run"] is None


def assert_flips_repaired(intact: Path, copy: Path, run_main: RunMain, name: str, count: int, seed: int) -> int:
    """Return the number of repaired bits."""
    rng, repaired = np.random.default_rng(seed), 0
    for bit in rng.integers(0, 8 * (intact / name).stat().st_size, count):
        flip(copy / name, int(bit))
        assert run_main("verify", copy, "--repair").code == 0, f"bit {bit} of {name}"
        assert verify(copy) == []
        found, wanted = contents(copy), contents(intact)
        if name == "dataset.json" and lost(copy):
            del found[name], wanted[name]
            shutil.copy(intact / name, copy / name)
        assert found == wanted
        repaired += 1
    return repaired


@pytest.mark.parametrize("count", [4, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FILES)
def test_flipped_bit_is_repaired(
    name: str, count: int, intact: Path, copy: Path, run_main: RunMain, figure: Figure
) -> None:
    repaired = assert_flips_repaired(intact, copy, run_main, name, count, seed=count)
    figure("repair", f"{repaired} of {count} flipped bits repaired")


@pytest.mark.parametrize("name", [name for name in FILES if name != "dataset.json"])
def test_missing_file_is_restored(name: str, intact: Path, copy: Path, run_main: RunMain) -> None:
    (copy / name).unlink()
    assert_repaired(copy, intact, run_main)


@pytest.mark.parametrize("name", [name for name in FILES if name != "dataset.json"])
@pytest.mark.parametrize("share", [0, 0.3, 0.8])
def test_truncated_file_is_restored(name: str, share: float, intact: Path, copy: Path, run_main: RunMain) -> None:
    os.truncate(copy / name, int(share * (copy / name).stat().st_size))
    assert_repaired(copy, intact, run_main)


@pytest.mark.parametrize("size", [0, 50, 100, 150, 200, 250, 300, 350, 500, 1000, -2])
def test_truncated_dataset_json_is_rebuilt(size: int, intact: Path, copy: Path, run_main: RunMain) -> None:
    os.truncate(copy / "dataset.json", size % (copy / "dataset.json").stat().st_size)

    assert run_main("verify", copy, "--repair").code == 0
    assert verify(copy) == []
    assert {name: copy.joinpath(name).read_bytes() for name in FILES if name != "dataset.json"} == {
        name: intact.joinpath(name).read_bytes() for name in FILES if name != "dataset.json"
    }


def test_all_shards_are_regenerated(intact: Path, copy: Path, run_main: RunMain) -> None:
    shutil.rmtree(copy / "shards")
    assert_repaired(copy, intact, run_main)


def test_manifest_and_shards_are_restored_together(intact: Path, copy: Path, run_main: RunMain) -> None:
    (copy / "manifest.csv").unlink()
    flip(copy / FILES[4], 40_000)
    (copy / FILES[5]).unlink()
    assert_repaired(copy, intact, run_main)


def test_swapped_shards_are_restored(intact: Path, copy: Path, run_main: RunMain) -> None:
    first, second = copy / FILES[3], copy / FILES[4]
    first.rename(copy / "other")
    second.rename(first)
    (copy / "other").rename(second)
    assert_repaired(copy, intact, run_main)


def test_foreign_file_is_moved_and_kept(intact: Path, copy: Path, run_main: RunMain) -> None:
    for content in ("one", "two"):
        (copy / "shards" / "notes.txt").write_text(content)
        output = assert_repaired(copy, intact, run_main)
        assert "shards/notes.txt: moved to" in output
    assert [path.read_text() for path in sorted((copy / "set_aside").iterdir())] == ["one", "two"]


def test_only_damaged_pairs_are_regenerated(
    intact: Path, copy: Path, run_main: RunMain, sources: Path, tmp_path: Path
) -> None:
    """The folder of sources contains only the source of the damaged pair."""
    rows = [json.loads(line) for line in _json_rows(intact, 1)]
    only = tmp_path / "only"
    only.mkdir()
    shutil.copy(sources / rows[1]["source"], only / rows[1]["source"])
    content = (copy / FILES[4]).read_bytes()
    at = content.index(f"{rows[1]['key']}.noisy.npy".encode()) + 512 + 128
    flip(copy / FILES[4], 8 * at + 3)

    output = assert_repaired(copy, intact, run_main, f"source.root={only}")

    assert output.splitlines()[0] == f"{FILES[4]}: 1 of {len(rows)} pairs regenerated, the others kept"


def _json_rows(folder: Path, shard: int) -> list[str]:
    return [json.dumps(json.loads(row)) for row in repair.json_inside(folder / "shards" / f"shard-{shard:05d}.tar")]


def test_lost_manifest_needs_no_source_if_shards_are_intact(
    copy: Path, run_main: RunMain, make: Make, tmp_path: Path
) -> None:
    make(None, tmp_path / "scenes", "source.limit=3")
    before = contents(tmp_path / "scenes")
    (tmp_path / "scenes" / "manifest.csv").unlink()

    done = run_main("verify", tmp_path / "scenes", "--repair")

    assert done.out.splitlines()[0] == "manifest.csv: restored from the rows in the shards"
    assert contents(tmp_path / "scenes") == before


class OldSourceError(SourceError):
    """Fail as version 0.2 did, which had no reason ``too_small``."""

    def __init__(self, reason: str, *given: Any) -> None:
        super().__init__("unsupported" if reason == "too_small" else reason, *given)


def test_reason_of_0_2_for_small_pictures_is_kept(
    run_main: RunMain, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Image.fromarray(pixels(3, 4, 4)).save(fill(tmp_path / "p", 2) / "small.png")
    with monkeypatch.context() as patch:
        patch.setattr(loader, "SourceError", OldSourceError)
        make(tmp_path / "p", tmp_path / "ds", "source.patch=8", "source.max_failed=1")
    before = contents(tmp_path / "ds")
    (tmp_path / "ds/manifest.csv").unlink()

    assert run_main("verify", tmp_path / "ds", "--repair").code == 0
    assert contents(tmp_path / "ds") == before
    done = run_main("again", tmp_path / "ds", f"out={tmp_path / 'new'}", "source.max_failed=1", "n_jobs=1")
    assert (done.code, "the same rows as" in done.out) == (0, True), done.err


def test_lost_dataset_json_is_rebuilt_and_reported(intact: Path, copy: Path, run_main: RunMain) -> None:
    (copy / "dataset.json").unlink()

    done = run_main("verify", copy, "--repair", f"source.root={intact}")

    new, old = (json.loads((folder / "dataset.json").read_text()) for folder in (copy, intact))
    assert done.code == 0
    assert "host, time and versions of the run are lost" in done.out
    assert {name for name in old if old[name] != new[name]} == {
        *("dataset_sha256", "not_matched", "run", "skipped_links", "source", "versions")
    }


def test_changed_source_is_named_and_other_shards_are_repaired(
    copy: Path, intact: Path, run_main: RunMain, sources: Path, tmp_path: Path
) -> None:
    changed = Path(shutil.copytree(sources, tmp_path / "changed"))
    row = json.loads(_json_rows(intact, 1)[0])
    shutil.copy(changed / "wide.png", changed / row["source"])
    (copy / FILES[4]).unlink()
    (copy / FILES[5]).unlink()

    done = run_main("verify", copy, "--repair", f"source.root={changed}")

    assert done.code == 5
    assert f"{FILES[4]}: cannot be repaired: " in done.err
    assert f"cannot be repaired: source {row['source']}" in done.err
    assert (copy / FILES[5]).read_bytes() == (intact / FILES[5]).read_bytes()
    assert not (copy / ".work").exists()


@pytest.mark.parametrize("other", ["config.yaml", "manifest.csv"])
def test_damage_to_both_proofs_is_refused_in_one_line(other: str, copy: Path, run_main: RunMain) -> None:
    flip(copy / other, 8 * (copy / other).read_bytes().index(b"deep.png" if other == "manifest.csv" else b"webp") + 1)
    flip(copy / "dataset.json", 8 * (copy / "dataset.json").read_bytes().index(b'"host"') + 1)

    done = run_main("verify", copy, "--repair")

    assert done.code == 4
    assert done.err.splitlines()[-1].startswith(
        f"gen-dataset: {copy}: both {other} and dataset.json are damaged; regenerate"
    )


def test_dataset_locked_by_a_run_stays_unchanged(copy: Path, run_main: RunMain) -> None:
    flip(copy / FILES[3], 999)
    before = contents(copy)
    (copy / ".work").mkdir()
    lock = LockFile(copy / ".work/lock")
    lock.acquire(wait=False)

    done = run_main("verify", copy, "--repair")

    lock.release()
    (copy / ".work").rmdir()
    assert done.code == 11
    assert contents(copy) == before


def test_intact_dataset_is_not_written_to(intact: Path, copy: Path, run_main: RunMain) -> None:
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    assert run_main("verify", copy, "--repair").out == f"{copy} is intact\n"
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before


def test_interrupted_repair_adds_no_damage(
    intact: Path, copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = (FILES[3], FILES[5])
    for name in damaged:
        flip(copy / name, 77_777 % (8 * (copy / name).stat().st_size))
    with monkeypatch.context() as patched:
        patched.setattr(repair.os, "replace", _interrupt)
        assert run_main("verify", copy, "--repair").code == 130
    assert {damage.file for damage in verify(copy)} == set(damaged)

    assert_repaired(copy, intact, run_main)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def test_rerun_with_a_missing_shard_names_the_repair(copy: Path, sources: Path, make: Make, run_main: RunMain) -> None:
    (copy / FILES[3]).unlink()

    done = run_main(f"source.root={sources}", "out=ds", "output.pairs_per_shard=4")

    assert done.code == 4
    assert "gen-dataset verify ds --repair" in done.err


def test_drawn_lights_return_with_a_lost_manifest(tmp_path: Path) -> None:
    overrides = ["gains=by_light", "scene=night", "source.limit=2", "source.patch=[random,32,2]", "n_jobs=1"]
    generate(load_config([*overrides, f"out={tmp_path / 'ds'}"]))
    before = (tmp_path / "ds/manifest.csv").read_bytes()
    assert b",tungsten," in before or b",daylight," in before
    (tmp_path / "ds/manifest.csv").unlink()
    steps = list(repair.repair(tmp_path / "ds", None))
    assert [step.what for step in steps] == ["restored from the rows in the shards"]
    assert (tmp_path / "ds/manifest.csv").read_bytes() == before
