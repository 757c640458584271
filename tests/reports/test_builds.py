"""Benchmark builds: the recorded bytes, or a line that says where they differ."""

from __future__ import annotations

import importlib.util
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from helpers.commands import RunMain
from helpers.processes import imported_first, kill_session, running, unfinished, wait_for

import unprocess_gen as ug
from unprocess_gen.reports import builds
from unprocess_gen.reports.builds import build_names, manifests_dir, read_build

SMALL = "photos_patches"
BUILDS = build_names()


@pytest.fixture(scope="session")
def scores() -> ModuleType:
    """Return the script that measures builds."""
    spec = importlib.util.spec_from_file_location("measure", manifests_dir() / "measure.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["measure"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def recorded(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of ``manifests/`` that `read_build` reads."""
    folder = tmp_path_factory.mktemp("recorded") / "manifests"
    shutil.copytree(manifests_dir(), folder)
    monkeypatch.setattr(builds, "manifests_dir", lambda: folder)
    return folder


def edited(file: Path, edit: Callable[[str], str]) -> None:
    file.write_text(edit(file.read_text(encoding="utf-8")), encoding="utf-8")


@pytest.mark.parametrize("name", BUILDS)
def test_every_build_records_rows_and_digests_of_all_files(name: str) -> None:
    build = read_build(name)
    assert len(build.rows()) >= 4
    assert all(row["status"] == "ok" for row in build.rows())
    for dataset in build.datasets:
        assert {Path(dataset, file).as_posix() for file in ("config.yaml", "shards/shard-00000.tar")} <= set(
            build.digests
        )
    photographs = {row["source"] for row in build.rows() if row["source_bytes"]}
    assert photographs == set(build.recipe.photographs)


def test_list_names_every_build(run_main: RunMain) -> None:
    done = run_main("build", "--list")
    assert (done.code, [line.split()[0] for line in done.out.splitlines()]) == (0, BUILDS)
    assert len(BUILDS) >= 8


def test_build_has_the_recorded_bytes_also_when_it_is_repeated(run_main: RunMain, tmp_path: Path) -> None:
    first, second = (run_main("build", SMALL, "--to", "here", "n_jobs=1") for _ in range(2))
    assert (first.code, second.code) == (0, 0)
    assert first.out.splitlines()[-1] == f"here is the build {SMALL}, bit for bit"
    assert "nothing to do" in second.out
    assert len(ug.RawPairs(tmp_path / "here")) == len(read_build(SMALL).rows())


def test_difference_is_named_by_file_key_and_column(run_main: RunMain, tmp_path: Path, recorded: Path) -> None:
    assert run_main("build", SMALL, "--to", "here", "n_jobs=1").code == 0
    shard = tmp_path / "here/shards/shard-00000.tar"
    content = bytearray(shard.read_bytes())
    content[600] ^= 1
    shard.write_bytes(content)
    damaged = run_main("build", SMALL, "--to", "here")
    assert damaged.code == 4
    assert "here: shards/shard-00000.tar: 00000000-p0000.clean.npy: " in damaged.err
    content[600] ^= 1
    shard.write_bytes(content)

    gain = read_build(SMALL).rows()[2]["red_gain"]
    edited(recorded / f"{SMALL}.csv", lambda text: text.replace(str(gain), "1.5"))
    edited(recorded / f"{SMALL}.sha256", lambda text: text.replace(text[:4], "0000", 1))
    differing = run_main("build", SMALL, "--to", "here")
    assert differing.code == 4
    assert f"manifest.csv: 00000000-p0002.red_gain: is {gain}, that of the build is 1.5" in differing.err
    assert "config.yaml: its SHA-256 is " in differing.err


@pytest.mark.parametrize(
    ("arguments", "code", "complaint"),
    [
        (
            ("photo_patches", "--to", "a"),
            2,
            "photo_patches: no such build; expected one of photos_bodies, .*did you mean",
        ),
        (("--to", "a"), 2, "build: NAME is missing"),
        ((SMALL,), 2, "build: --to is missing"),
        (("--list", SMALL), 2, "--list: lists all builds"),
        ((SMALL, "--to", "s3://bucket"), 2, "expected a local path"),
        (
            (SMALL, "--to", "full"),
            2,
            f"--to full: contains mine.txt, which is no part of the build {SMALL}; expected an",
        ),
        (("photos_bodies", "--to", "full"), 2, "--to full: contains mine.txt"),
        ((SMALL, "--to", "full/mine.txt"), 2, "--to full/mine.txt: is a file; expected a folder"),
        ((SMALL, "--to", "other"), 2, "out=other: was begun with other settings: camera.law="),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], code: int, complaint: str, run_main: RunMain, tmp_path: Path
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    if "other" in arguments:
        assert run_main("camera=sony_a7r", "source.limit=1", "n_jobs=1", "out=other").code == 0
    before = sorted(tmp_path.rglob("*"))
    done = run_main("build", *arguments)
    assert (done.code, len(done.err.splitlines())) == (code, 1)
    assert re.search(complaint, done.err)
    assert sorted(tmp_path.rglob("*")) == before


def test_photograph_of_other_bytes_is_refused_in_one_line(
    run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "skimage/data").mkdir(parents=True)
    (tmp_path / "skimage/data/astronaut.png").write_bytes(b"other")
    (tmp_path / "skimage/__init__.py").touch()
    spec = importlib.util.spec_from_file_location("skimage", tmp_path / "skimage/__init__.py")
    assert spec is not None
    monkeypatch.setitem(sys.modules, "skimage", importlib.util.module_from_spec(spec))
    done = run_main("build", SMALL, "--to", "here")
    assert (done.code, len(done.err.splitlines())) == (5, 1)
    assert (
        "skimage/data/astronaut.png: its SHA-256 is d9298a10d1b0735837dc4bd85dac641b0f3cef27a47e5d53a54f2f3f5b2fcffa"
        in done.err
    )
    assert "expected 88431cd9653ccd539741b555fb0a46b61558b301d4110412b5bc28b5e3ea6cb5" in done.err
    assert not (tmp_path / "here").exists()


def test_cards_and_table_follow_from_the_scores(scores: ModuleType) -> None:
    for file, text in scores.texts(scores.read_scores()).items():
        assert (manifests_dir() / file).read_text(encoding="utf-8") == text, (
            f"{file}: run python manifests/measure.py DIR"
        )


def test_scores_of_a_build_are_the_recorded_ones(scores: ModuleType, run_main: RunMain, tmp_path: Path) -> None:
    assert run_main("build", SMALL, "--to", "here", "n_jobs=1").code == 0
    measured = scores.measure(tmp_path / "here")
    (line,) = (line for line in scores.read_scores() if line["build"] == SMALL)
    for name, value in measured.items():
        assert value == pytest.approx(float(line[name]), abs=0.02 if name.endswith("psnr") else 0.002)


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDS)
def test_every_build_has_the_recorded_bytes(name: str, run_main: RunMain) -> None:
    assert run_main("build", name, "--to", "here", "n_jobs=1").code == 0


@pytest.mark.slow
def test_killed_build_resumes(run_main: RunMain, tmp_path: Path) -> None:
    env = imported_first(tmp_path, unfinished(tmp_path / "here", 2))
    with running("build", "scenes_clips_night", "--to", "here", "n_jobs=1", cwd=tmp_path, **env) as process:
        wait_for(lambda: len(list((tmp_path / "here/shards").glob("*.tar"))) == 2)
        kill_session(process.pid)
    assert not (tmp_path / "here/dataset.json").exists()
    done = run_main("build", "scenes_clips_night", "--to", "here", "n_jobs=1")
    assert done.code == 0
    assert "in this run" in done.out
    assert "bit for bit" in done.out
