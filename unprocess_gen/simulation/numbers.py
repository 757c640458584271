"""Declare the numbers of physical noise profiles.

A number is declared once, at its field of `plan.Physics`. Keys of the settings with their checks, manifest columns and
reference pages follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from unprocess_gen.core.fields import Choice, Field, Numbers

PLAIN, DN, RATE, SHAPE, SITES = "plain", "dn", "rate", "shape", "sites"
"""How a field follows from its key: unchanged, converted to DN of the sensor, times exposure and warmth, as a shape of
Tukey's lambda, and as DN of the four sites of the 2x2 tile."""


@dataclass(frozen=True, eq=False)
class Number(Field):
    """A number of a profile: its key in the settings, and its field of `plan.Physics`.

    The unit ``"DN"`` is DN of the profile for the key, and DN of the sensor for the field.

    Attributes
    ----------
    kind : str
        `PLAIN`, `DN`, `RATE`, `SHAPE` or `SITES`.
    count : int
        Numbers in the value; a list if more than 1.
    by_iso : bool
        Whether the key belongs to the branches of a profile, and its value may depend on ISO (`config.iso_forms`).
    key : str
        Key of the profile; empty if it has the name of the field.
    key_meaning, key_unit, key_limit : str, str, Numbers or None
        Meaning, unit and allowed values of the key, if they differ from the field's.
    key_default : Any
        Value of a key that a profile does not name; None if the number is not known then.
    required : bool
        Whether null is refused.
    optional : str
        What null means if the effect is simulated without the number; empty if it needs the number.
    counter : int
        Counter of the draw in the stream ``scatter``; -1 without a draw. Datasets depend on it.
    """

    kind: str = PLAIN
    count: int = 1
    by_iso: bool = False
    key: str = ""
    key_meaning: str = ""
    key_unit: str = ""
    key_limit: Numbers | None = None
    key_default: Any = None
    required: bool = False
    optional: str = ""
    counter: int = -1

    @property
    def may_be_unknown(self) -> bool:
        """True if null means that the number is not known, or not needed."""
        return self.key_default is None and not self.required

    @property
    def in_branch(self) -> bool:
        """True for a key of the branches, false for a key of the profile."""
        return self.by_iso or isinstance(self.limit, Choice)


def number_in_dn(meaning: str, **details: Any) -> Number:
    """Number that is converted to DN of the sensor."""
    return Number(meaning, Numbers(0), "DN", kind=DN, by_iso=True, **details)


def rate(meaning: str, **details: Any) -> Number:
    """Number of electrons: a current times the exposure."""
    unit, limit = "electrons per second", Numbers(0, 1e6)
    return Number(meaning, Numbers(0, 1e9), "electrons", kind=RATE, key_unit=unit, key_limit=limit, **details)
