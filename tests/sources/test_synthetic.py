"""The synthetic pictures: the same bytes everywhere, and content that exercises what a sensor can do."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from unprocess_gen.sources.synthetic import FRAMES_PER_CLIP, NAMES, PAN, list_names, picture

GOLDEN = {
    "dead_leaves-0": "2a68355dd8cef935",
    "colour_chart-0": "0715a6ed78c83dd7",
    "highlights-0": "7172e64512db7c03",
    "dead_leaves-1": "c83b297bbfc75027",
}


def digest(pixels: np.ndarray) -> str:
    return hashlib.sha256(pixels.tobytes()).hexdigest()[:16]


def test_pictures_are_the_golden_ones() -> None:
    assert {name: digest(picture(name)) for name in GOLDEN} == GOLDEN
    assert NAMES[:4] == tuple(GOLDEN)
    assert picture("dead_leaves-1").shape == (481, 641, 3)


def test_changing_a_picture_leaves_the_next_one_as_it_is() -> None:
    picture("colour_chart-0")[:] = 0
    assert digest(picture("colour_chart-0")) == GOLDEN["colour_chart-0"]


def test_pictures_contain_shadows_saturated_colours_and_blown_white() -> None:
    chart, highlights = picture("colour_chart-0"), picture("highlights-0")
    assert (highlights.min(axis=2) == 255).mean() > 0.01
    assert (highlights.max(axis=2) < 30).mean() > 0.01
    assert all(((chart[..., channel] > 150) & (chart.min(axis=2) < 40)).any() for channel in range(3))


def test_frames_of_a_clip_are_windows_that_move_over_the_picture() -> None:
    first, third = picture("dead_leaves-1/0000"), picture("dead_leaves-1/0002")
    assert np.array_equal(first[2 * PAN[0] :, 2 * PAN[1] :], third[: -2 * PAN[0], : -2 * PAN[1]])
    last = picture(f"dead_leaves-1/{FRAMES_PER_CLIP - 1:04}")
    assert np.array_equal(last, picture("dead_leaves-1")[-last.shape[0] :, -last.shape[1] :])
    assert list_names(FRAMES_PER_CLIP + 1, clips=True)[-2:] == ("dead_leaves-0/0007", "colour_chart-0/0000")
    for name in ("dead_leaves-1/0008", "dead_leaves-1/1", "dead_leaves-1/"):
        with pytest.raises(ValueError, match="expected 0000 to 0007"):
            picture(name)


def test_a_shorter_listing_begins_a_longer_one() -> None:
    for count in (0, 1, 7, 10, 23):
        assert len(list_names(count)) == count
        assert list_names(40)[:count] == list_names(count)
    assert len(set(list_names(40))) == 40


@pytest.mark.parametrize("name", ["", "dead_leaves", "dead_leaves-", "dead_leaves-01", "leaves-0", "highlights-1x"])
def test_a_name_of_no_picture_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        picture(name)


@pytest.mark.slow
def test_pictures_do_not_depend_on_the_vector_units() -> None:
    code = (
        "import hashlib; from unprocess_gen.sources.synthetic import NAMES, picture;"
        "print(*[hashlib.sha256(picture(name).tobytes()).hexdigest()[:16] for name in NAMES[:4]])"
    )
    features = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX2 AVX512F FMA3"
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": features}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == list(GOLDEN.values())
