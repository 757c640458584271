"""Random streams: Philox's known answers, the layout, and the independence of streams."""

from __future__ import annotations

import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.core import random_streams as streams
from unprocess_gen.core.random_streams import (
    body_key,
    philox4x32,
    purpose,
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


@given(
    keys, places, places, st.tuples(st.integers(0, 5), st.integers(1, 200)),
    st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_words_of_a_tile_depend_on_position_and_purpose(
    key: int, y: int, x: int, shape: tuple[int, int], level: int, draw: int, frame: int
) -> None:
    tile = words(key, 1, shape, origin=(y, x), frame=frame, level=level, draw=draw)
    assert (tile.shape, tile.dtype) == (shape, np.uint32)
    for row, column in itertools.product(range(shape[0]), {0, shape[1] // 3, shape[1] // 2, shape[1] - 1}):
        assert tile[row, column] == word_by_hand(key, y + row, x + column, 1 << 24 | level << 12 | draw, frame)


def test_stream_numbers_never_change() -> None:
    assert streams.STREAMS == {
        "parameters": 0, "heteroscedastic": 1, "prnu": 2, "shot": 3, "dark_current": 4, "hot_pixels": 5, "read": 6,
        "row": 7, "column": 8, "dead_pixels": 9, "dequantize": 10, "patch": 11, "scatter": 12,
        "column_temporal": 13, "dark_frame": 14, "dark_dither": 15, "dsnu": 16, "motion": 17,
    }  # fmt: skip
    with pytest.raises(ValueError, match="stream new, number 2: one of them is taken"):
        streams.declare_stream("new", 2)
    with pytest.raises(ValueError, match="stream prnu, number 99: one of them is taken"):
        streams.declare_stream("prnu", 99)


# Independence ---------------------------------------------------------------------------------------------------------


def test_streams_levels_and_draws_have_distinct_purposes() -> None:
    corners = (0, 1, 255, 256, 4094, 4095)
    found = [purpose(*which) for which in itertools.product(streams.STREAMS.values(), corners, corners)]
    assert len(set(found)) == len(found)
    assert max(found) < 2**32


@pytest.mark.parametrize(("level", "draw"), [(-1, 0), (4096, 0), (0, -1), (0, 4096)])
def test_a_level_or_draw_out_of_range_is_refused(level: int, draw: int) -> None:
    with pytest.raises(ValueError, match="expected 0 to 4095"):
        purpose(1, level, draw)


# Keys -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "name"),
    [
        (stream_key(7, SHA, 2), f"unprocess_gen stream 1\0{7}\0{SHA}\0{2}"),
        (stream_key(3, SHA), f"unprocess_gen stream 1\0{3}\0{SHA}\0{0}"),
        (body_key(7, "sony_a7s2", "2"), f"unprocess_gen body 1\0{7}\0sony_a7s2\0{2}"),
    ],
)
def test_keys_never_change(key: int, name: str) -> None:
    assert key == int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
