"""What a run loads before its first pair, and how settings are composed beside that."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import pytest

from unprocess_gen.cli import hydra_app as room
from unprocess_gen.cli.hydra_app import compose, compose_beside
from unprocess_gen.config import validation as settings_room
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError

RUN = """
import os, sys
cores, *sys.argv[1:] = sys.argv[1:]
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:int(cores)])
from unprocess_gen.cli import main as cli
assert cli.main() == 0
print(*sys.modules)
"""

NEVER = {"joblib", "asyncio", "matplotlib", "PIL", "av"}
"""What a run of one job from a folder of photographs has no use for, and what is slow or large to load."""

HYDRAS = {"hydra", "omegaconf", "antlr4"}

two_cores = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="needs two cores"
)


def run(cores: int, *arguments: str) -> set[str]:
    """Run the tool in a process of its own, and return what it had loaded at the end."""
    command = [sys.executable, "-c", RUN, str(cores), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


@two_cores
def test_a_run_loads_only_what_it_needs_and_the_same_dataset_comes_of_it(
    photos: Path, tmp_path: Path, tree_hash: Callable[[Path], str]
) -> None:
    said = (f"source.root={photos}", "n_jobs=1")
    run(1, f"out={tmp_path / 'before'}", *said)  # compiles what is not kept

    beside, alone = (run(cores, f"out={tmp_path / str(cores)}", *said) for cores in (2, 1))

    assert not beside & (NEVER | HYDRAS)
    assert not alone & NEVER
    assert alone >= HYDRAS
    assert tree_hash(tmp_path / "2") == tree_hash(tmp_path / "1")


# -------------------------------------------------------------------------------------- composed by a child, beside

ForkedChildren = list[int]


@pytest.fixture
def children(monkeypatch: pytest.MonkeyPatch) -> ForkedChildren:
    """Have settings composed by a child whatever this process has loaded, and return the children's ids."""
    found: ForkedChildren = []
    fork = os.fork

    def told() -> int:
        child = fork()
        if child:
            found.append(child)
        return child

    monkeypatch.setattr(room, "_may_fork", lambda: True)
    monkeypatch.setattr(os, "fork", told)
    return found


def all_gone(children: ForkedChildren) -> bool:
    for child in children:
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)
    return bool(children)


def test_a_child_composes_what_is_composed_here(children: ForkedChildren) -> None:
    overrides, here, done = ["seed=3", "noise=sony_a7s2", "camera=choice", "source.patch=[grid,8]"], [], []
    room.compose_one([], overrides, lambda config: (here.append(config) or 0, None))  # type: ignore[func-returns-value]

    config = compose_beside(overrides, [lambda: done.append("meanwhile")])

    assert config == here[0]
    assert done == ["meanwhile"]
    assert all_gone(children)


@pytest.mark.parametrize(
    "override", ["seed=x", "seeds=1", "camera=none_such", "gains.red=-1", "out=[", "sensor.bits=0"]
)
def test_settings_that_a_child_refuses_are_refused_in_the_same_words(override: str, children: ForkedChildren) -> None:
    with pytest.raises(ConfigError) as here:
        room.compose_one([], [override], lambda config: (0, None))

    with pytest.raises(ConfigError) as beside:
        compose_beside([override], [lambda: None])

    assert str(beside.value) == str(here.value)
    assert all_gone(children)


def test_where_no_child_can_be_made_settings_are_composed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused() -> NoReturn:
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(os, "fork", refused)
    before = os.listdir("/proc/self/fd")

    assert compose_beside([], [lambda: None]) is None
    assert os.listdir("/proc/self/fd") == before


IGNORING = """
import signal, sys
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
from unprocess_gen.cli.main import main
sys.argv = ["gen-dataset", *sys.argv[1:]]
sys.exit(main())
"""


def test_where_ended_children_are_not_kept_settings_are_composed_here(tmp_path: Path) -> None:
    """As below a supervisor that ignores SIGCHLD, which its children inherit."""
    command = [sys.executable, "-c", IGNORING, "seed=x"]

    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert done.stderr.startswith("gen-dataset: seed=x")


def test_what_was_to_be_done_meanwhile_is_left_undone_once_settings_are_refused(children: ForkedChildren) -> None:
    done = []

    with pytest.raises(ConfigError):
        compose_beside(["seed=x"], [lambda: os.waitid(os.P_PID, children[0], os.WEXITED | os.WNOWAIT), done.append])

    assert done == []
    assert all_gone(children)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ImportError])
def test_a_child_ends_with_what_ends_us_meanwhile(stop: type[BaseException], children: ForkedChildren) -> None:
    def meanwhile() -> NoReturn:
        raise stop

    with pytest.raises(stop):
        compose_beside([], [meanwhile])

    assert all_gone(children)


def test_a_bug_is_told_here_where_a_child_met_it(children: ForkedChildren, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(config: Config) -> NoReturn:
        raise RuntimeError("a bug")

    monkeypatch.setattr(settings_room, "validate_config", broken)

    assert compose_beside([], [lambda: None]) is None
    with pytest.raises(RuntimeError, match="a bug"):
        compose([], lambda config: (0, None), meanwhile=[lambda: None])
    assert all_gone(children)


@pytest.mark.parametrize("answer", [b"", b"\x80\x04\x95"], ids=["nothing", "half an answer"])
def test_where_a_child_dies_settings_are_composed_here(
    answer: bytes, children: ForkedChildren, monkeypatch: pytest.MonkeyPatch
) -> None:
    def dies(overrides: list[str], stream: object) -> NoReturn:
        os.write(stream.fileno(), answer)  # type: ignore[attr-defined]
        os._exit(1)

    monkeypatch.setattr(room, "_tell_settings", dies)
    seeds: list[int] = []

    code = compose(["seed=7"], lambda config: (seeds.append(config.seed) or 5, None), meanwhile=[lambda: None])  # type: ignore[func-returns-value]

    assert (code, seeds) == (5, [7])
    assert all_gone(children)


KEEPING = """
import resource, sys
import numpy as np
from unprocess_gen.pipeline.worker import keep_memory
if sys.argv[1] == "keep":
    keep_memory()
faults = [resource.getrusage(resource.RUSAGE_SELF).ru_minflt]
for _ in range(9):
    array = np.ones(40_000_000, dtype=np.uint8)
    del array
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[1])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have their own way")
def test_memory_of_one_image_is_that_of_the_next() -> None:
    def faults(how: str) -> int:
        command = [sys.executable, "-c", KEEPING, how]
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    assert faults("keep") < 40 <= faults("give back") / 4
