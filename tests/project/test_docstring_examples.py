"""The examples in the docstrings of the Python API give the results that they show."""

from __future__ import annotations

import doctest
import inspect
from operator import attrgetter
from pathlib import Path

import pytest

import unprocess_gen as ug
import unprocess_gen.testing

FIRST = ("generate", "verify", "replay")
"""Functions whose examples write or read the dataset ``ds``, in the order of its use."""

NAMES = [*FIRST, *(name for name in ug.__all__ if inspect.isfunction(getattr(ug, name)) and name not in FIRST)]
NAMES += ["RawPairs", "CameraNoise", "CameraNoise.fit", "testing.EffectTests", "testing.BodyTests"]


def test_examples_of_the_api_give_their_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    runner, parser = doctest.DocTestRunner(verbose=False), doctest.DocTestParser()
    for name in NAMES:
        examples = parser.get_doctest(inspect.getdoc(attrgetter(name)(ug)) or "", {}, name, None, None)
        assert examples.examples, f"{name} has no example"
        runner.run(examples, out=report.append)
    assert report == []
