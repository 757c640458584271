"""Suggest the closest known word for a misspelt one."""

from __future__ import annotations

from collections.abc import Iterable

CUTOFF = 0.6
"""Smallest similarity of a suggestion (`difflib.SequenceMatcher.ratio`, 0 to 1): one or two slips in a short word."""


def suggest(word: str, options: Iterable[str]) -> str | None:
    """Option most similar to ``word``, case and leading hyphens aside; None if none is similar enough (`CUTOFF`)."""
    import difflib  # --help needs no suggestions

    by_letters = {option.lstrip("-").casefold(): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-").casefold(), by_letters, n=1, cutoff=CUTOFF)
    return by_letters[close[0]] if close else None


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """Question to append to an error message about ``word``: ``; did you mean OPTION?``, or an empty string."""
    option = suggest(word, options)
    return f"; did you mean {option}?" if option else ""
