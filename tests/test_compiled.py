"""Kept machine code is loaded without what only a compiler needs, and by Numba's own way where that fails."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
from numba import version_info

from unprocess_gen import compiled, selftest

LOADED = """
import sys
from unprocess_gen import selftest
assert not selftest.failures(sys.argv[1])
kernels = [one for one in selftest.OUTER[sys.argv[1]] if one.overloads]
assert kernels and not any(one.stats.cache_misses for one in kernels), "a kernel was compiled"
print(*sys.modules)
"""


@pytest.mark.skipif(version_info.short > compiled.LOADED_ALONE, reason="an untried Numba keeps its own way")
@pytest.mark.parametrize("kernels", ["one_normal", "float32", "counts", "normalised", "normalised_counts"])
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

    compiled._load_alone(asked)

    assert asked._cache.load_overload("signature", None) == ("its own way", "signature", None)


def test_a_dispatcher_that_keeps_nothing_stays_as_it_is() -> None:
    bare = SimpleNamespace()

    compiled._load_alone(bare)

    assert not vars(bare)
