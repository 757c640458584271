"""Declare the numbers of physical noise profiles.

A number is declared once, at its field of `plan.Physics`. Keys of the settings with their checks, manifest columns and
reference pages follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

PLAIN, DN, RATE, SHAPE, SITES = "plain", "dn", "rate", "shape", "sites"
"""How a field follows from its key: unchanged, converted to DN of the sensor, times exposure and warmth, as a shape of
Tukey's lambda, and as DN of the four sites of the 2x2 tile."""

LARGEST = 1.7976931348623157e308


@dataclass(frozen=True)
class Number:
    """A number of a profile: its key, its field of `plan.Physics`, and its columns of the manifest.

    Attributes
    ----------
    meaning : str
        One phrase for users.
    unit : str
        Unit of the field. ``"DN"`` means DN of the profile for the key, and DN of the sensor for the field.
    low, high : float
        Allowed values of the key.
    kind : str
        `PLAIN`, `DN`, `RATE`, `SHAPE` or `SITES`.
    key : str
        Key of the profile; empty if it has the name of the field.
    key_meaning, key_unit : str
        Meaning and unit of the key, if they differ from the field's.
    key_default : Any
        Value of a key that a profile does not name; None if the number is not known then.
    optional : str
        What null means if the effect is simulated without the number; empty if it needs the number.
    required : bool
        Whether null is refused.
    by_iso : bool
        Whether the key belongs to the branches of a profile, and its value may depend on ISO (`config.forms`).
    words : tuple of str
        Words that the key allows instead of numbers.
    count : int
        Numbers in the value; a list if more than 1.
    counter : int
        Counter of the draw in the stream ``scatter``; -1 without a draw. Datasets depend on it.
    columns : mapping of str to str
        Name and meaning of each column; empty for one column with the name and meaning of the field.
    lowest, highest : float
        Values that rows allow.
    """

    meaning: str
    unit: str = ""
    low: float = 0.0
    high: float = math.inf
    kind: str = PLAIN
    key: str = ""
    key_meaning: str = ""
    key_unit: str = ""
    key_default: Any = None
    optional: str = ""
    required: bool = False
    by_iso: bool = False
    words: tuple[str, ...] = ()
    count: int = 1
    counter: int = -1
    columns: Mapping[str, str] = field(default_factory=dict)
    lowest: float = 0.0
    highest: float = LARGEST

    @property
    def may_be_unknown(self) -> bool:
        """True if null means that the number is not known, or not needed."""
        return self.key_default is None and not self.required

    @property
    def in_branch(self) -> bool:
        """True for a key of the branches, false for a key of the profile."""
        return self.by_iso or bool(self.words)


def number_in_dn(meaning: str, **details: Any) -> Number:
    """Number that is converted to DN of the sensor."""
    return Number(meaning, unit="DN", kind=DN, **details)


def rate(meaning: str, **details: Any) -> Number:
    """Number of electrons: a current times the exposure."""
    return Number(
        meaning, unit="electrons", kind=RATE, key_unit="electrons per second", high=1e6, highest=1e9, **details
    )
