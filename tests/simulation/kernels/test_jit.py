"""Kernels and their cache on disk: machine code is used for exactly the sources it was compiled from."""

from __future__ import annotations

import inspect
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numba
import pytest

from unprocess_gen.simulation.kernels import jit
from unprocess_gen.simulation.kernels.jit import KERNEL_PACKAGES, by_class, inner, kernel

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "unprocess_gen"


LIBRARY = """
from unprocess_gen.simulation.kernels.jit import inner

@inner
def half(x):
    return x / 2
"""
CALLER = """
from unprocess_gen.simulation.kernels.jit import kernel
from unprocess_gen.simulation.library import half

@kernel
def quarter(x):
    return half(half(x))
"""
CALL = """
import sys
from pathlib import Path
from unprocess_gen.simulation.kernels.jit import kernel_cache_folder
from unprocess_gen.simulation.caller import quarter
note = (kernel_cache_folder() or Path("missing")) / "quarter.run"
print(note.exists(), quarter(8.0), len(quarter.stats.cache_hits))
if note.parent.exists():
    note.touch()
"""


class Copy:
    """A package with the real `core` and two small kernels, one of which calls the other across files."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.package = folder / "unprocess_gen"

    def write(self, name: str, text: str) -> None:
        (self.package / name).parent.mkdir(parents=True, exist_ok=True)
        (self.package / name).write_text(text)

    def call(self, **env: str) -> str:
        """Call the outer kernel in a new process; return whether it ran before, its result, and its cache hits."""
        return subprocess.run(
            [sys.executable, "-c", CALL],
            cwd=self.folder,
            env={"PYTHONPATH": str(self.folder), "HOME": str(self.folder / "home"), **env},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Copy:
    """Return a package whose kernels were compiled by another process."""
    made = Copy(tmp_path_factory.mktemp("compiled"))
    shutil.copytree(PACKAGE / "core", made.package / "core", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__.py", "simulation/__init__.py", "simulation/kernels/__init__.py"):
        made.write(name, "")
    made.write("simulation/kernels/jit.py", (PACKAGE / "simulation/kernels/jit.py").read_text())
    made.write("simulation/library.py", LIBRARY)
    made.write("simulation/caller.py", CALLER)
    made.write("cli/main.py", "x = 1")
    assert made.call() == "False 2.0 0"
    return made


@pytest.fixture
def copy(compiled: Copy, tmp_path: Path) -> Iterator[Copy]:
    """Return the package, and restore its files and machine code after the test.

    Numba stores machine code by the path of a kernel's file, so a copy at another path would load none.
    """
    shutil.copytree(compiled.package, tmp_path / "intact")
    yield compiled
    shutil.rmtree(compiled.package)
    shutil.copytree(tmp_path / "intact", compiled.package)


def test_another_process_loads_the_machine_code(compiled: Copy) -> None:
    assert compiled.call() == "True 2.0 1"


def test_editing_a_called_kernel_recompiles_its_callers(copy: Copy) -> None:
    """Machine code of the earlier sources is removed."""
    copy.write("simulation/library.py", LIBRARY.replace("/ 2", "/ 4"))

    assert copy.call() == "False 0.5 0"
    assert copy.call() == "True 0.5 1"
    assert len(list((copy.package / "__pycache__").glob(f"{jit.PREFIX}*"))) == 1


def test_changing_any_kernel_package_changes_the_folder(copy: Copy) -> None:
    folders = [jit.source_digest(copy.package)]
    for name in ("core/random_streams.py", "simulation/kernels/jit.py", "simulation/new.py"):
        path = copy.package / name
        copy.write(name, (path.read_text() if path.exists() else "") + "\n# changed\n")
        folders.append(jit.source_digest(copy.package))

    assert len(set(folders)) == 4
    assert copy.call() == "False 2.0 0"


def test_a_read_only_package_caches_below_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "__file__", str(tmp_path / "package" / "simulation" / "kernels" / "jit.py"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    for name in KERNEL_PACKAGES:
        (tmp_path / "package" / name).mkdir(parents=True)
        (tmp_path / "package" / name / "__init__.py").touch()
    (tmp_path / "package" / "__pycache__").touch()  # a file, so that no folder can be made there

    folder = cast(Any, kernel_cache_folder()).parent

    assert folder == tmp_path / "home" / "unprocess_gen"


def test_no_place_for_a_cache_compiles_without_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    assert kernel_cache_folder() is None

    monkeypatch.setattr(jit, "kernel_cache_folder", lambda: None)
    double = kernel(_double)

    assert double(2.0) == 4.0 and cast(Any, double).stats.cache_path is None


@pytest.mark.parametrize("part", ["nbi", "nbc"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 0.99], ids="{:.0%}".format)
def test_damaged_machine_code_is_compiled_again(
    part: str, kept: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(jit, "kernel_cache_folder", lambda: tmp_path)
    assert kernel(_double)(2.0) == 4.0
    (file,) = tmp_path.rglob(f"*.{part}")
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content))])

    again, third = kernel(_double), kernel(_double)

    assert again(2.0) == 4.0
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "compiling it again" in caplog.text
    assert third(2.0) == 4.0 and cast(Any, third).stats.cache_hits
    assert len(caplog.records) == 1


def test_machine_code_that_cannot_be_kept_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A disk that is full: the index would be a file where a folder is."""
    monkeypatch.setattr(jit, "kernel_cache_folder", lambda: tmp_path)
    double = kernel(_double)
    shutil.rmtree(tmp_path)
    tmp_path.touch()
    assert double(2.0) == 4.0 and double(2) == 4
    assert caplog.text.count("cannot be written") == 1


def test_a_numba_that_ignores_the_folder_gets_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user's setting is restored."""

    def njit(cache: bool = False, **options: object) -> Callable[..., Any]:
        path = "/elsewhere" if cache else None
        return lambda function: SimpleNamespace(stats=SimpleNamespace(cache_path=path))

    monkeypatch.setattr(numba, "njit", njit)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "/of/the/user")

    assert cast(Any, kernel(_double)).stats.cache_path is None
    assert numba.config.CACHE_DIR == "/of/the/user"


def kernel_cache_folder() -> Path | None:
    """Return what `jit.kernel_cache_folder` returns in a new process."""
    return cast(Any, jit.kernel_cache_folder).__wrapped__()


def _double(x: float) -> float:
    return x * 2


def test_kernels_of_other_packages_call_no_unhashed_files() -> None:
    import unprocess_gen.reports.tier_costs  # noqa: F401

    hashed = tuple(str(PACKAGE / name) + os.sep for name in KERNEL_PACKAGES)
    kernels = {
        value.py_func
        for name, module in list(sys.modules.items())
        if name.startswith("unprocess_gen.")
        for value in vars(module).values()
        if hasattr(value, "py_func")
    }
    assert len(kernels) > 60
    for function in kernels:
        for name in function.__code__.co_names:
            for called in callees(function.__globals__.get(name)):
                file = called.__code__.co_filename
                assert file == function.__code__.co_filename or file.startswith(hashed), (function, called)


def callees(value: Any) -> list[Any]:
    """Return the functions that a compiled call of ``value`` may execute."""
    if getattr(value, "__qualname__", "") == "by_class.<locals>.call":
        implementations = inspect.getclosurevars(value).nonlocals["implementations"].values()
        return [getattr(function, "py_func", function) for function in implementations]
    return [value.py_func] if hasattr(value, "py_func") else []


# Kernels chosen by class ----------------------------------------------------------------------------------------------


class Metres(NamedTuple):
    value: float


class Miles(NamedTuple):
    value: float


class Feet(NamedTuple):
    value: float
    metres_per_foot: float


def _of_metres(length: Metres, factor: float) -> float:
    return length.value * factor


def _of_feet(length: Feet, factor: float) -> float:
    return length.value * length.metres_per_foot * factor


scaled = by_class({Metres: inner(_of_metres), Feet: inner(_of_feet)})
in_python = by_class({Metres: _of_metres, Feet: _of_feet})


@kernel
def _scaled(length: Any, factor: float) -> float:
    return scaled(length, factor)


@pytest.mark.parametrize(("length", "expected"), [(Metres(3.0), 6.0), (Feet(4.0, 0.25), 2.0)])
def test_class_of_first_argument_chooses_the_kernel(length: Any, expected: float) -> None:
    """Metres have no ``metres_per_foot``, so code that contained both kernels could not be compiled."""
    assert _scaled(length, 2.0) == in_python(length, 2.0) == expected


@pytest.mark.parametrize("call", [in_python, _scaled])
def test_a_class_without_a_kernel_is_refused(call: Callable[[Any, float], float]) -> None:
    with pytest.raises(TypeError, match="Miles: no kernel takes it"):
        call(Miles(1.0), 2.0)
