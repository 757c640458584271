"""Suggestions for misspelt words."""

from __future__ import annotations

import pytest

from unprocess_gen.core.suggestions import did_you_mean

OPTIONS = ("plan", "verify", "replay", "report", "preview", "--keys", "--to")
CLOSEST = {
    "verfy": "verify",
    "plann": "plan",
    "Verify": "verify",
    "repaly": "replay",
    "--kyes": "--keys",
    "-keys": "--keys",
    "xyzzy": None,
    "": None,
}


@pytest.mark.parametrize("word", CLOSEST)
def test_closest_word_is_suggested_as_it_is_spelt(word: str) -> None:
    assert did_you_mean(word, OPTIONS) == (f"; did you mean {CLOSEST[word]}?" if CLOSEST[word] else "")
