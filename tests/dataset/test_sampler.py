"""`EpochSampler` orders the items of epochs, for several processes and after an interruption."""

from __future__ import annotations

import itertools

import pytest

from unprocess_gen import EpochSampler
from unprocess_gen.core.errors import ConfigError


def test_every_epoch_is_another_permutation() -> None:
    sampler = EpochSampler(100, seed=3)
    epochs = [list(sampler) for _ in range(3)]
    for epoch, items in enumerate(epochs):
        assert {number for number, _ in items} == {epoch}
        assert sorted(number for _, number in items) == list(range(100))
    assert len({tuple(number for _, number in items) for items in epochs}) == 3
    assert [number for _, number in epochs[0]] != [number for _, number in EpochSampler(100, seed=4)]


def test_the_order_is_the_same_in_every_version() -> None:
    assert [number for _, number in EpochSampler(8)] == [5, 0, 2, 1, 4, 7, 6, 3]


@pytest.mark.parametrize(("length", "world"), [(12, 3), (10, 4), (2, 5)])
def test_ranks_share_an_epoch_in_equal_parts(length: int, world: int) -> None:
    parts = [list(EpochSampler(length, rank=rank, world=world)) for rank in range(world)]
    assert {len(part) for part in parts} == {-(-length // world)}
    assert {number for part in parts for _, number in part} == set(range(length))
    assert length % world or len(set(itertools.chain(*parts))) == length


@pytest.mark.parametrize("position", [0, 1, 9, 10])
def test_a_training_resumes_at_any_place(position: int) -> None:
    complete, interrupted, resumed = (EpochSampler(20, seed=1, rank=1, world=2) for _ in range(3))
    expected = list(complete) + list(complete)
    done = list(itertools.islice(interrupted, position))
    resumed.state = interrupted.state
    assert interrupted.state == (0, position)
    rest = list(resumed)
    rest += list(resumed)
    assert done + rest == expected[: len(done + rest)]
    assert len(done + rest) == 20


def test_set_epoch_begins_an_epoch() -> None:
    sampler = EpochSampler(5, shuffle=False)
    sampler.set_epoch(7)
    assert list(sampler) == [(7, number) for number in range(5)]


@pytest.mark.parametrize("arguments", [{"length": 0}, {"length": 5, "rank": 2, "world": 2}])
def test_bad_arguments_are_refused(arguments: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="out of range; expected"):
        EpochSampler(**arguments)
