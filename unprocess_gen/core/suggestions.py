"""Suggest the closest known word for a misspelt one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

CUTOFF = 0.6
"""Smallest similarity of a suggestion (`difflib.SequenceMatcher.ratio`, 0 to 1): one or two slips in a short word."""


def suggest(word: str, options: Iterable[str]) -> str | None:
    """Return the option that is most similar to ``word``.

    Upper and lower case, and leading hyphens, count as equal.

    Parameters
    ----------
    word : str
        What was typed.
    options : iterable of str
        What would have been accepted.

    Returns
    -------
    str or None
        One of ``options`` as it is spelt there; None if no option is similar enough (`CUTOFF`).
    """
    by_letters = {option.lstrip("-").casefold(): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-").casefold(), by_letters, n=1, cutoff=CUTOFF)
    return by_letters[close[0]] if close else None


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """Return the question to append to an error message about ``word``.

    Parameters
    ----------
    word : str
        What was typed.
    options : iterable of str
        What would have been accepted.

    Returns
    -------
    str
        ``"; did you mean OPTION?"``, or an empty string if no option is similar enough.
    """
    option = suggest(word, options)
    return f"; did you mean {option}?" if option else ""
