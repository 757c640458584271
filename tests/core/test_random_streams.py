"""Random streams: Philox's known answers, the layout, and the independence of streams."""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
from typing import Any

import numpy as np
import pytest
from helpers.moments import FALSE_ALARM, bernstein
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core import random_streams as streams
from unprocess_gen.core.random_streams import (
    STREAMS,
    body_key,
    parameter_uniforms,
    patch_words,
    philox4x32,
    purpose,
    scatter_uniforms,
    stream_key,
    words,
)

KEY = 0x0123456789ABCDEF
SHA = hashlib.sha256(b"a photograph").hexdigest()
keys = st.integers(0, 2**64 - 1)
places = st.integers(0, 2**20)


# Philox ---------------------------------------------------------------------------------------------------------------


def philox_by_hand(counter: tuple[int, int, int, int], key: int) -> list[int]:
    """Compute Philox with Python integers (Salmon et al. 2011, section 3.3)."""
    c, k = list(counter), [key % 2**32, key >> 32]
    for _ in range(10):
        high0, low0 = divmod(0xD2511F53 * c[0], 2**32)
        high1, low1 = divmod(0xCD9E8D57 * c[2], 2**32)
        c = [high1 ^ c[1] ^ k[0], low1, high0 ^ c[3] ^ k[1], low0]
        k = [(k[0] + 0x9E3779B9) % 2**32, (k[1] + 0xBB67AE85) % 2**32]
    return c


def philox(counter: tuple[int, ...], key: int) -> list[int]:
    return [int(word[0]) for word in philox4x32(tuple(np.array([word], dtype=np.uint64) for word in counter), key)]


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_philox_gives_the_answers_published_with_random123(counter: str, key: str, answer: str) -> None:
    k0, k1 = (int(word, 16) for word in key.split())
    found = philox(tuple(int(word, 16) for word in counter.split()), k1 << 32 | k0)
    assert " ".join(f"{word:08x}" for word in found) == answer


@given(st.tuples(*[st.integers(0, 2**32 - 1)] * 4), keys)
def test_philox_equals_the_published_algorithm_for_any_counter_and_key(
    counter: tuple[int, int, int, int], key: int
) -> None:
    assert philox(counter, key) == philox_by_hand(counter, key)


# Layout ---------------------------------------------------------------------------------------------------------------


def word_by_hand(key: int, y: int, x: int, purpose_word: int, frame: int) -> int:
    return philox_by_hand((x // 64 * 16 + x % 16, y, purpose_word, frame), key)[x % 64 // 16]


@given(keys, places, places, st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 2**32 - 1))
def test_a_pixels_word_depends_on_position_and_purpose(
    key: int, y: int, x: int, level: int, draw: int, frame: int
) -> None:
    found = words(key, "heteroscedastic", (1, 1), origin=(y, x), frame=frame, level=level, draw=draw)
    assert found.dtype == np.uint32
    assert found.tolist() == [[word_by_hand(key, y, x, 1 << 24 | level << 12 | draw, frame)]]


@given(keys, places, places, st.integers(1, 5), st.integers(1, 200))
def test_a_tile_contains_the_words_of_its_pixels(key: int, y: int, x: int, height: int, width: int) -> None:
    tile = words(key, "heteroscedastic", (height, width), origin=(y, x))
    for row, column in itertools.product(range(height), {0, width // 3, width // 2, width - 1}):
        assert tile[row, column] == word_by_hand(key, y + row, x + column, 1 << 24, 0)


@pytest.fixture(scope="module")
def full() -> np.ndarray:
    """Return the words of a complete frame."""
    return words(KEY, "heteroscedastic", (48, 400))


@given(st.data())
def test_any_tile_is_a_crop_of_the_full_frame(full: np.ndarray, data: st.DataObject) -> None:
    top, left = data.draw(st.integers(0, 47)), data.draw(st.integers(0, 399))
    height, width = data.draw(st.integers(1, 48 - top)), data.draw(st.integers(1, 400 - left))
    tile = words(KEY, "heteroscedastic", (height, width), origin=(top, left))
    assert (tile == full[top : top + height, left : left + width]).all()


def test_the_layout_does_not_depend_on_the_width(full: np.ndarray) -> None:
    for width in (1, 15, 16, 63, 64, 65, 129):
        assert (words(KEY, "heteroscedastic", (3, width)) == full[:3, :width]).all()


def test_an_empty_tile_has_no_words() -> None:
    assert words(KEY, "heteroscedastic", (0, 5)).shape == (0, 5)


def test_stream_numbers_never_change() -> None:
    assert streams.STREAMS == {
        "parameters": 0, "heteroscedastic": 1, "prnu": 2, "shot": 3, "dark_current": 4, "hot_pixels": 5, "read": 6,
        "row": 7, "column": 8, "dead_pixels": 9, "dequantize": 10, "patch": 11, "scatter": 12,
        "column_temporal": 13, "dark_frame": 14, "dark_dither": 15, "dsnu": 16,
    }  # fmt: skip
    assert len(set(streams.STREAMS.values())) == len(streams.STREAMS)


# Independence ---------------------------------------------------------------------------------------------------------

OTHERS: dict[str, tuple[int, str, dict[str, Any]]] = {
    "stream": (KEY, "parameters", {}),
    "level": (KEY, "heteroscedastic", {"level": 1}),
    "draw": (KEY, "heteroscedastic", {"draw": 1}),
    "frame": (KEY, "heteroscedastic", {"frame": 1}),
    "y": (KEY, "heteroscedastic", {"origin": (64, 0)}),
    "x": (KEY, "heteroscedastic", {"origin": (0, 64)}),
    "low key bit": (KEY ^ 1, "heteroscedastic", {}),
    "high key bit": (KEY ^ 1 << 63, "heteroscedastic", {}),
    "key halves swapped": (KEY >> 32 | (KEY & 0xFFFFFFFF) << 32, "heteroscedastic", {}),
}


@pytest.mark.parametrize("other", OTHERS)
def test_another_purpose_or_key_gives_other_words(other: str) -> None:
    """Of 4096 independent pairs, two or more are equal with a probability of 5e-13."""
    key, stream, options = OTHERS[other]
    equal = np.equal(words(KEY, "heteroscedastic", (64, 64)), words(key, stream, (64, 64), **options))
    assert int(equal.sum()) <= 1


def test_streams_levels_and_draws_have_distinct_purposes() -> None:
    corners = (0, 1, 255, 256, 4094, 4095)
    found = [purpose(*which) for which in itertools.product(streams.STREAMS, corners, corners)]
    assert len(set(found)) == len(found)
    assert max(found) < 2**32


@pytest.mark.parametrize(("level", "draw"), [(-1, 0), (4096, 0), (0, -1), (0, 4096)])
def test_a_level_or_draw_out_of_range_is_refused(level: int, draw: int) -> None:
    with pytest.raises(ValueError, match="expected 0 to 4095"):
        purpose("heteroscedastic", level, draw)


def test_an_unknown_stream_is_refused() -> None:
    with pytest.raises(KeyError):
        purpose("thunder")


# Keys -----------------------------------------------------------------------------------------------------------------


def test_image_keys_never_change() -> None:
    name = f"unprocess_gen stream 1\0{7}\0{SHA}\0{2}".encode()
    assert stream_key(7, SHA, 2) == int.from_bytes(hashlib.blake2b(name, digest_size=8).digest(), "big")


def test_body_keys_never_change() -> None:
    name = f"unprocess_gen body 1\0{7}\0sony_a7s2\0{2}".encode()
    assert body_key(7, "sony_a7s2", "2") == int.from_bytes(hashlib.blake2b(name, digest_size=8).digest(), "big")


def test_a_bodys_key_depends_on_seed_profile_and_unit() -> None:
    keys = {body_key(*one) for one in ((7, "a", "2"), (8, "a", "2"), (7, "b", "2"), (7, "a", "3"))}
    assert len(keys) == 4


@given(st.integers(0, 2**63 - 1), st.integers(0, 1000))
def test_a_key_depends_on_seed_photograph_and_occurrence(seed: int, occurrence: int) -> None:
    other_sha = hashlib.sha256(b"another").hexdigest()
    found = {
        stream_key(seed, SHA, occurrence),
        stream_key(seed + 1, SHA, occurrence),
        stream_key(seed, other_sha, occurrence),
        stream_key(seed, SHA, occurrence + 1),
    }
    assert len(found) == 4
    assert all(0 <= key < 2**64 for key in found)


def test_distinct_seeds_and_occurrences_have_distinct_keys() -> None:
    found = {stream_key(seed, SHA, occurrence) for seed in range(64) for occurrence in range(64)}
    assert len(found) == 64 * 64


def test_the_first_of_identical_files_is_number_0() -> None:
    assert stream_key(3, SHA) == stream_key(3, SHA, 0)


# Parameters -----------------------------------------------------------------------------------------------------------


@given(keys)
def test_parameters_are_odd_multiples_of_2_to_minus_53(key: int) -> None:
    for uniform in parameter_uniforms(key, 10):
        assert 0 < uniform < 1
        assert uniform * 2**53 % 2 == 1


@given(keys, st.integers(0, 20))
def test_appending_parameters_changes_none(key: int, count: int) -> None:
    assert parameter_uniforms(key, count) == parameter_uniforms(key, 21)[:count]


@given(keys, st.integers(0, 50))
def test_parameter_n_is_the_first_52_bits_of_counter_n(key: int, number: int) -> None:
    high, low, _, _ = philox_by_hand((0, number, 0, 0), key)
    assert parameter_uniforms(key, number + 1)[number] == ((high << 20 | low >> 12) + 0.5) / 2**52


@given(keys, st.floats(min_value=1e-3, max_value=1e7), st.integers(0, 20))
def test_scatter_n_has_the_iso_in_two_words_of_its_counter(key: int, iso: float, number: int) -> None:
    bits = int(np.float64(iso).view(np.uint64))
    counter = (bits & 0xFFFFFFFF, number, STREAMS["scatter"] << 24, bits >> 32)
    high, low, _, _ = philox_by_hand(counter, key)
    assert scatter_uniforms(key, iso, number + 1)[number] == ((high << 20 | low >> 12) + 0.5) / 2**52


@given(keys, st.integers(0, 50))
def test_patch_n_uses_the_first_two_words_of_its_counter(key: int, number: int) -> None:
    first, second, _, _ = philox_by_hand((0, number, STREAMS["patch"] << 24, 0), key)
    assert patch_words(key, number + 1)[number] == (first, second)


# Statistics -----------------------------------------------------------------------------------------------------------

SIDE = 1024
STREAMS_OF = {
    "here": (KEY, {}),
    "next frame": (KEY, {"frame": 1}),
    "next level": (KEY, {"level": 1}),
    "next draw": (KEY, {"draw": 1}),
    "next key": (KEY + 1, {}),
    "next seed": (stream_key(1, SHA), {}),
    "seed": (stream_key(0, SHA), {}),
}


@functools.cache
def centred(name: str) -> np.ndarray:
    """Return the uniforms of a stream minus a half."""
    key, options = STREAMS_OF[name]
    return words(key, "heteroscedastic", (SIDE, SIDE), **options) / 2**32 - 0.5


def chi_square_bounds(freedom: int) -> tuple[float, float]:
    """Return bounds that a chi-square exceeds with probability `FALSE_ALARM` per side (Laurent and Massart 2000)."""
    x = math.log(1 / FALSE_ALARM)
    return freedom - 2 * math.sqrt(freedom * x), freedom + 2 * math.sqrt(freedom * x) + 2 * x


@pytest.mark.parametrize("position", [0, 8, 16, 24])
def test_byte_values_are_equally_frequent(position: int) -> None:
    """Pearson's statistic, 4096 expected in each of 256 cells."""
    byte = (words(KEY, "heteroscedastic", (SIDE, SIDE)) >> np.uint32(position)) & np.uint32(255)
    expected = SIDE * SIDE / 256
    statistic = float(((np.bincount(byte.ravel(), minlength=256) - expected) ** 2 / expected).sum())
    low, high = chi_square_bounds(255)
    assert low < statistic < high


def hold_uncorrelated(a: np.ndarray, b: np.ndarray) -> None:
    """Hold the mean product of disjoint pairs to 0: it is at most ¼, with variance (1/12)²."""
    assert abs(float((a * b).mean())) <= bernstein(1 / 144, 1 / 4, a.size)


@pytest.mark.parametrize("axis", [0, 1], ids=["y", "x"])
@pytest.mark.parametrize("lag", [1, 2, 16, 32, 64, 512])
def test_lagged_random_words_are_uncorrelated(axis: int, lag: int) -> None:
    u = np.moveaxis(centred("here"), axis, 0)
    for start in (0, lag):  # runs of `lag` rows, alternately first and second of a pair
        blocks = u[start : SIDE - (SIDE - start) % (2 * lag)].reshape(-1, 2, lag, SIDE)
        if len(blocks):
            hold_uncorrelated(blocks[:, 0], blocks[:, 1])


@pytest.mark.parametrize(
    ("one", "other"),
    [("here", other) for other in ("next frame", "next level", "next draw", "next key")] + [("seed", "next seed")],
)
def test_streams_are_uncorrelated(one: str, other: str) -> None:
    hold_uncorrelated(centred(one), centred(other))


def test_a_correlation_of_a_hundredth_is_detected() -> None:
    """The bound detects (u + 0.01 v)·v, whose mean product is 0.01 / 12."""
    leaning = centred("here") + 0.01 * centred("next key")
    assert abs(float((leaning * centred("next key")).mean())) > bernstein(1 / 144, 1 / 4, SIDE * SIDE)


def test_parameters_of_many_images_are_uniform() -> None:
    """Each of the ten parameters over 2000 images, 16 cells."""
    uniforms = np.array([parameter_uniforms(stream_key(0, f"{image:064x}"), 10) for image in range(2000)])
    low, high = chi_square_bounds(15)
    for parameter in uniforms.T:
        counts = np.bincount((parameter * 16).astype(int), minlength=16)
        assert low < float(((counts - 125) ** 2 / 125).sum()) < high
