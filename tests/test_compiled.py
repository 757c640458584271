"""Inner kernels are made machine code where they are called; kept code is loaded without what only a compiler needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numba import version_info

from unprocess_gen.core import jit as compiled
from unprocess_gen.core import shortcuts
from unprocess_gen.core.jit import inner, is_kept, kernel
from unprocess_gen.simulation import self_test as selftest

SQUARES = """
@inner
def square(x):
    return x * x

@kernel
def squares(x, out):
    for n in range(out.shape[0]):
        out[n] = square(x[n])
"""


def test_a_kernel_that_only_kernels_call_is_made_machine_code_in_them_alone() -> None:
    made: dict[str, Any] = {"inner": inner, "kernel": kernel}
    exec(SQUARES, made)  # of no file, so that nothing is kept: Numba shows the code of what it compiles alone
    x, out = np.arange(9.0), np.empty(9)
    made["squares"](x, out)

    defined = ["".join(made[name].inspect_llvm().values()).count("\ndefine") for name in ("square", "squares")]
    assert (out == x * x).all()
    assert made["square"].signatures
    assert defined[0] == 0 < defined[1]


ROOM = """
from unprocess_gen.core.jit import inner, kernel

@inner
def half(x):
    return x / 2

@inner
def quarter(x):
    return half(half(x))

@kernel
def first(x):
    return quarter(x) + 1

@kernel
def second(x):
    return quarter(x) + 2

@kernel
def third(x):
    return half(x)
"""


def test_what_a_process_compiled_another_takes_into_other_kernels(tmp_path: Path) -> None:
    (tmp_path / "room.py").write_text(ROOM)
    told = "print({call}, *(len(one.stats.cache_hits) for one in (room.half, room.quarter, room.{kernel})))"

    def process(kernel: str) -> str:
        code = "import room; " + told.format(call=f"room.{kernel}(8.0)", kernel=kernel)
        path = f"{tmp_path}:{Path(__file__).parents[1]}"
        command = [sys.executable, "-c", code]
        return subprocess.run(
            command,
            env={"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()

    assert process("first") == "3.0 0 0 0"
    assert process("second") == "4.0 0 1 0"
    assert process("third") == "4.0 1 0 0"
    assert process("first") == "3.0 0 0 1"


NEIGHBOUR = """
import sys
from unprocess_gen.core import jit as compiled
compiled._sources = lambda: sys.argv[1]
import room
print(room.first(8.0), len(room.first.stats.cache_hits))
"""


@pytest.mark.skipif(version_info.short > compiled.TRIED, reason="an untried Numba keeps its own way")
def test_what_was_kept_of_other_sources_is_not_taken(tmp_path: Path) -> None:
    (tmp_path / "room.py").write_text(ROOM)

    def process(sources: str) -> str:
        path = f"{tmp_path}:{Path(__file__).parents[1]}"
        env = {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path)}
        command = [sys.executable, "-c", NEIGHBOUR, sources]
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout.strip()

    assert [process(sources) for sources in ("these", "these", "others", "others")] == [
        "3.0 0",
        "3.0 1",
        "3.0 0",
        "3.0 1",
    ]


def test_another_file_of_the_package_is_another_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(compiled, "__file__", str(tmp_path / "compiled.py"))
    sources = cast(Any, compiled._sources).__wrapped__
    (tmp_path / "one.py").write_text("x = 1")
    before = sources()

    assert sources() == before
    (tmp_path / "one.py").write_text("x = 10")
    assert sources() != before


def test_a_kernel_that_this_process_has_compiled_is_at_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cast(Any, _never)._cache._cache_file, "_load_index", dict)  # as if none were kept
    assert not is_kept(_never)
    _never(np.zeros(1))
    assert is_kept(_never)


@kernel
def _never(x: np.ndarray) -> None:
    x[0] = 1.0


LOADED = """
import sys
from unprocess_gen.simulation import self_test as selftest
assert not selftest.failures(sys.argv[1])
kernels = [one for one in selftest.OUTER[sys.argv[1]] if one.overloads]
assert kernels and not any(one.stats.cache_misses for one in kernels), "a kernel was compiled"
print(*sys.modules)
"""


@pytest.mark.skipif(version_info.short > compiled.TRIED, reason="an untried Numba keeps its own way")
@pytest.mark.parametrize("kernels", ["one_normal", "float32", "plain", "physical", "normalised", "normalised_counts"])
def test_kept_kernels_are_loaded_and_right_without_numbas_registries(kernels: str) -> None:
    assert not selftest.failures(kernels)  # compiles what is not kept

    done = subprocess.run([sys.executable, "-c", LOADED, kernels], capture_output=True, text=True, check=True)

    assert not {"numba.np.linalg", "numba.np.arraymath", "scipy.linalg"} & set(done.stdout.split())


def dispatcher(alone: Any) -> Any:
    """What Numba's dispatcher has inside: a cache that loads by its own way, or ``alone``."""
    cache = SimpleNamespace(load_overload=lambda signature, target: ("its own way", signature, target))
    if alone is not None:
        cache._load_overload = alone
    return SimpleNamespace(_cache=cache)


def refuse(signature: Any, target: Any) -> Any:
    raise ValueError("cannot be read")


@pytest.mark.parametrize("alone", [None, refuse, lambda signature, target: None], ids=["gone", "raises", "not kept"])
def test_where_a_kernel_cannot_be_loaded_alone_numba_has_its_own_way(alone: Any) -> None:
    asked = dispatcher(alone)

    shortcuts.load_alone(asked)

    assert asked._cache.load_overload("signature", None) == ("its own way", "signature", None)


def test_a_dispatcher_that_keeps_nothing_stays_as_it_is() -> None:
    bare = SimpleNamespace()

    shortcuts.load_alone(bare)

    assert not vars(bare)
