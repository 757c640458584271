"""The built-in scenes: the same bytes everywhere, each a picture that exercises what a sensor can do."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from unprocess_gen.sources.scenes.synthetic import KINDS, NAMES, listing, scene

GOLDEN = {
    "dead_leaves-0": "99cf3d0cb2632018",
    "colour_chart-0": "b02d5f5a82a89494",
    "gradients-0": "fd7648a11044a478",
    "night_lamps-0": "fcfc1fcb6d97c626",
    "highlights-0": "c081c5871e7613bd",
    "dead_leaves-1": "d2405b080a1d4c8f",
    "colour_chart-1": "d3c8063331aaed4c",
    "gradients-1": "09fd861b6a9eec09",
    "night_lamps-1": "b34ae70a7499239f",
    "highlights-1": "21b20ebae2ee554f",
}
"""A golden table: what the scenes were when they were first pinned."""


def sha256(name: str) -> str:
    return hashlib.sha256(scene(name).tobytes()).hexdigest()[:16]


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_the_golden_one(name: str) -> None:
    assert sha256(name) == GOLDEN[name]


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_is_a_contiguous_srgb_picture_of_its_own(name: str) -> None:
    pixels = scene(name)
    assert (pixels.dtype, pixels.ndim, pixels.shape[2]) == (np.uint8, 3, 3)
    assert pixels.flags.c_contiguous
    pixels[:] = 0
    assert scene(name).any()


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_of_a_kind_differ_by_number(kind: str) -> None:
    assert len({sha256(f"{kind}-{number}") for number in range(4)}) == 4


@pytest.mark.parametrize("kind", ["night_lamps", "highlights"])
def test_some_scenes_hold_black_and_blown_white(kind: str) -> None:
    pixels = scene(f"{kind}-0")
    assert (pixels.min(axis=2) == 255).any()
    assert (pixels.max(axis=2) < 30).any()


def test_some_sizes_are_odd() -> None:
    assert any(side % 2 for name in NAMES for side in scene(name).shape[:2])


def test_a_shorter_listing_begins_a_longer_one() -> None:
    assert listing(None) == NAMES
    for count in (0, 1, 7, 10, 23):
        assert len(listing(count)) == count
        assert listing(40)[:count] == listing(count)
    assert len(set(listing(40))) == 40


def test_kinds_take_turns() -> None:
    assert [name.split("-")[0] for name in NAMES] == [*KINDS, *KINDS]


@pytest.mark.parametrize("name", ["", "dead_leaves", "dead_leaves-", "dead_leaves--1", "leaves-0", "gradients-1x"])
def test_a_name_that_is_no_scene_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        scene(name)


def test_scenes_do_not_depend_on_the_vector_units() -> None:
    code = (
        "import hashlib, sys; from unprocess_gen.sources.scenes.synthetic import NAMES, scene;"
        "print(*[hashlib.sha256(scene(name).tobytes()).hexdigest()[:16] for name in NAMES])"
    )
    features = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX2 AVX512F FMA3"
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": features}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == list(GOLDEN.values())
