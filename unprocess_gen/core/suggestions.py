"""Suggest the closest known word for a misspelt one."""

from __future__ import annotations

from collections.abc import Iterable

CUTOFF = 0.6
"""Smallest similarity of a suggestion (`difflib.SequenceMatcher.ratio`, 0 to 1): one or two slips in a short word."""


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """Question to append to an error message about ``word``: ``; did you mean OPTION?``, or an empty string.

    The option is the most similar one, case and leading hyphens aside.
    """
    import difflib  # --help needs no suggestions

    by_letters = {option.lstrip("-").casefold(): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-").casefold(), by_letters, n=1, cutoff=CUTOFF)
    return f"; did you mean {by_letters[close[0]]}?" if close else ""
