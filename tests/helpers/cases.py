"""Cases of parametrised tests: a few quick ones, the others slow."""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import Any

import pytest


def slow_except(quick: Container[Any], cases: Iterable[Any]) -> list[Any]:
    """Return all cases for `parametrize`; those that are not in ``quick`` are marked slow.

    A tuple is a case of a test with several arguments.
    """
    return [
        case if case in quick else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]
