"""The built-in scenes: the same bytes everywhere, each a picture that exercises what a sensor can do."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from unprocess_gen.sources.scenes.synthetic import FRAMES_PER_CLIP, PAN, SCENES, clip_listing, listing, scene

SLOW = pytest.mark.slow
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


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    """Return every scene by name; tests leave them as they are."""
    return {name: scene(name) for name in SCENES}


def sha256(picture: np.ndarray) -> str:
    return hashlib.sha256(picture.tobytes()).hexdigest()[:16]


def test_scenes_are_the_golden_ones(pictures: dict[str, np.ndarray]) -> None:
    assert {name: sha256(picture) for name, picture in pictures.items()} == GOLDEN
    assert len(set(GOLDEN.values())) == len(SCENES)


@pytest.mark.parametrize("name", ["colour_chart-1", "gradients-1", *(pytest.param(one, marks=SLOW) for one in SCENES)])
def test_changing_a_picture_leaves_the_next_one_as_it_is(name: str) -> None:
    scene(name)[:] = 0
    assert sha256(scene(name)) == GOLDEN[name]


@pytest.mark.parametrize("kind", ["night_lamps", "highlights"])
def test_some_scenes_contain_black_and_blown_white(kind: str, pictures: dict[str, np.ndarray]) -> None:
    picture = pictures[f"{kind}-0"]
    assert (picture.min(axis=2) == 255).any()
    assert (picture.max(axis=2) < 30).any()


def test_frames_of_a_clip_are_windows_that_move_over_the_scene() -> None:
    first, third = scene("gradients-1/0000"), scene("gradients-1/0002")
    assert np.array_equal(first[2 * PAN[0] :, 2 * PAN[1] :], third[: -2 * PAN[0], : -2 * PAN[1]])
    last = scene(f"gradients-1/{FRAMES_PER_CLIP - 1:04}")
    assert np.array_equal(last, scene("gradients-1")[-last.shape[0] :, -last.shape[1] :])
    assert clip_listing(FRAMES_PER_CLIP + 1)[-2:] == ("dead_leaves-0/0007", "colour_chart-0/0000")
    for name in ("gradients-1/0008", "gradients-1/1", "gradients-1/"):
        with pytest.raises(ValueError, match="expected 0000 to 0007"):
            scene(name)


def test_a_shorter_listing_begins_a_longer_one() -> None:
    assert listing(None) == SCENES
    for count in (0, 1, 7, 10, 23):
        assert len(listing(count)) == count
        assert listing(40)[:count] == listing(count)
    assert len(set(listing(40))) == 40


@pytest.mark.parametrize("name", ["", "dead_leaves", "dead_leaves-", "dead_leaves--1", "leaves-0", "gradients-1x"])
def test_a_name_that_is_no_scene_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        scene(name)


@pytest.mark.slow
def test_scenes_do_not_depend_on_the_vector_units() -> None:
    code = (
        "import hashlib, sys; from unprocess_gen.sources.scenes.synthetic import SCENES, scene;"
        "print(*[hashlib.sha256(scene(name).tobytes()).hexdigest()[:16] for name in SCENES])"
    )
    features = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX2 AVX512F FMA3"
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": features}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == list(GOLDEN.values())
