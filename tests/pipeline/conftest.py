"""What tests of runs share: twelve photographs, their dataset, and checks that a run ends with its bytes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill
from helpers.processes import COUNT, ONE, assert_complete

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
