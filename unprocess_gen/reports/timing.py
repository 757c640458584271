"""Measure times in turns, so that other programs disturb everything that is compared alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

_Key = TypeVar("_Key", bound=Hashable)
_Time = TypeVar("_Time")


def thread_ns(call: Callable[[], object], pixels: int) -> float:
    """Processor time of a call in this thread, ns per pixel, more than 0."""
    started = time.thread_time_ns()
    call()
    return max(time.thread_time_ns() - started, 1) / pixels


def measure_in_turns(measurements: Mapping[_Key, Callable[[int], _Time]], rounds: int) -> dict[_Key, list[_Time]]:
    """Run every measurement once in each round, which it is given, in reversed order in every second one."""
    results: dict[_Key, list[_Time]] = {key: [] for key in measurements}
    for number in range(rounds):
        for key in list(measurements)[:: -1 if number % 2 else 1]:
            results[key].append(measurements[key](number))
    return results
