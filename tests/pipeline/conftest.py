"""What tests of runs share: twelve photographs, their dataset, and checks that a run ends with its bytes."""

from __future__ import annotations

import functools
import itertools
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.dark_frames import save_frames
from helpers.datasets import Make, TreeHash
from helpers.kinds import KINDS, SOURCES, Kind
from helpers.photographs import fill
from helpers.processes import COUNT, ONE, assert_complete
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.pipeline.generate import Summary


@pytest.fixture(scope="session")
def twelve(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with twelve photographs p, and their dataset ds with one pair in a shard."""
    folder = tmp_path_factory.mktemp("twelve")
    make(fill(folder / "p", COUNT), folder / "ds", ONE)
    return folder


@pytest.fixture
def photographs(twelve: Path, tmp_path: Path) -> Path:
    """Copy the twelve photographs to p in the folder of the test."""
    return Path(shutil.copytree(twelve / "p", tmp_path / "p"))


@pytest.fixture(scope="session")
def assert_undisturbed(twelve: Path, tree_hash: TreeHash) -> Callable[[Path], None]:
    """Return a function that checks that a folder contains the dataset of `twelve`, to the byte, and nothing else."""

    def check(out: Path) -> None:
        assert tree_hash(out) == tree_hash(twelve / "ds")
        assert_complete(out)

    return check


@pytest.fixture(scope="session")
def resume(twelve: Path, make: Make, assert_undisturbed: Callable[[Path], None]) -> Callable[..., Summary]:
    """Return a function that ends a run of `twelve`, whose photographs may be elsewhere, with the undisturbed bytes."""

    def resumed(out: Path, root: Path = twelve / "p") -> Summary:
        summary = make(root, out, ONE)
        assert_undisturbed(out)
        return summary

    return resumed


@pytest.fixture(scope="session")
def kind_settings(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[str, ...]]:
    """Return a function that returns the settings of a kind of dataset, its sources and dark frames included."""
    folder = tmp_path_factory.mktemp("kinds")
    fill(folder / "photos", 3)
    for clip, number in itertools.product("ab", range(3)):
        for name, dtype, top, shape in (("clips", np.uint8, 256, (40, 50, 3)), ("raw", np.uint16, 15000, (48, 64))):
            (folder / name / clip).mkdir(parents=True, exist_ok=True)
            frame = np.random.default_rng(ord(clip) + number).integers(top // 30, top, shape).astype(dtype)
            Image.fromarray(frame).save(folder / name / clip / f"{number:04}.png")
    save_frames(folder / "darks", 3)

    def settings(kind: str) -> tuple[str, ...]:
        source = SOURCES.get(kind, "photos")
        darks = (f"noise.dark_frames={folder / 'darks'}",) if kind == "dark frames" else ()
        return (*KINDS[kind], *darks, f"source.root={folder / source}" if source else "source.root=null", ONE)

    return settings


@pytest.fixture(scope="session")
def made_kind(kind_settings: Callable[[str], tuple[str, ...]], tmp_path_factory: pytest.TempPathFactory) -> Kind:
    """Return a function that makes a dataset of a kind once."""

    @functools.cache
    def made(kind: str) -> Path:
        out = tmp_path_factory.mktemp("kind") / "ds"
        ug.generate(ug.load_config([*kind_settings(kind), f"out={out}", "n_jobs=1"]))
        return out

    return made
