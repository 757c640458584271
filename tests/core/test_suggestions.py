"""Suggestions for misspelt words."""

from __future__ import annotations

import pytest

from unprocess_gen.core.suggestions import suggest

VERBS = ("plan", "verify", "replay", "report", "preview")


@pytest.mark.parametrize(
    ("word", "closest"),
    [("verfy", "verify"), ("plann", "plan"), ("Verify", "verify"), ("repaly", "replay"), ("xyzzy", None), ("", None)],
)
def test_closest_word_is_suggested(word: str, closest: str | None) -> None:
    assert suggest(word, VERBS) == closest


def test_flag_keeps_its_hyphens() -> None:
    assert suggest("--kyes", ("--keys", "--to")) == suggest("-keys", ("--keys", "--to")) == "--keys"
