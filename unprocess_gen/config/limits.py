"""Define which values a setting allows. Checks, messages and documentation use the same objects.

Each limit names the allowed values in words: ``str(limit)`` follows "expected" in messages and fills the column
"allowed" of ``docs/reference/settings.md``. Importing this module imports nothing slow, because ``--help`` needs it.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from unprocess_gen.config.values import in_range, is_integer, is_number, value_text
from unprocess_gen.core.object_store import is_url


class Limit(ABC):
    """Allowed values of one setting."""

    @abstractmethod
    def __str__(self) -> str:
        """Return the allowed values in words."""

    def allows(self, value: Any) -> bool:
        """Return whether the value is allowed; True if that depends on other settings."""
        return True

    def shown(self, value: Any) -> str:
        """Return the value as messages show it."""
        return value_text(value)


@dataclass(frozen=True)
class Described(Limit):
    """Values that are checked together with other settings, or by the function that parses them."""

    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Boolean(Limit):
    """True or false; OmegaConf converts and checks it."""

    def __str__(self) -> str:
        return "true or false"


@dataclass(frozen=True)
class Choice(Limit):
    """One of a few words."""

    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"one of {', '.join(self.words)}"

    def word(self, value: Any) -> Any:
        """Return the value as one of the words is spelled."""
        return value

    def allows(self, value: Any) -> bool:
        """Return whether the value is one of the words."""
        return self.word(value) in self.words

    def shown(self, value: Any) -> str:
        """Return the word that the user wrote."""
        return value_text(self.word(value))


YAML_SWITCHES = {"True": "on", "False": "off"}
"""Text of the booleans that YAML reads from on and off without quotes."""


@dataclass(frozen=True)
class Switch(Choice):
    """One of a few words, of which YAML may have read on or off as a boolean."""

    def word(self, value: Any) -> Any:
        """Return the word that the user wrote."""
        return YAML_SWITCHES.get(value, value)


@dataclass(frozen=True)
class Integers(Limit):
    """An integer from ``low`` to ``high``, or the one in ``other``, whose meaning is ``remark``."""

    low: int
    high: int
    other: int | None = None
    remark: str = ""

    def __str__(self) -> str:
        return f"{self.low} to {self.high}{self.remark}"

    def allows(self, value: Any) -> bool:
        """Return whether the value is an integer in the range."""
        return is_integer(value) and (self.low <= value <= self.high or value == self.other)


@dataclass(frozen=True)
class Numbers(Limit):
    """A finite number from ``low`` to ``high``; ``open_low`` and ``open_high`` exclude the ends."""

    low: float
    high: float = math.inf
    open_low: bool = False
    open_high: bool = False

    def __str__(self) -> str:
        if self.open_high:
            return f"{self.low:g} up to, but not including, {self.high:g}"
        if self.open_low:
            return f"more than {self.low:g}, up to {self.high:g}"
        if self.high == math.inf:
            return f"a number of {self.low:g} or more"
        return f"{self.low:g} to {self.high:g}"

    def allows(self, value: Any) -> bool:
        """Return whether the value is a finite number in the range."""
        return is_number(value) and (
            (self.low < value if self.open_low else self.low <= value)
            and (value < self.high if self.open_high else value <= self.high)
        )


@dataclass(frozen=True)
class NumberList(Limit):
    """A list of ``count`` numbers, each within ``numbers``."""

    count: int
    numbers: Numbers

    def __str__(self) -> str:
        return f"a list of {self.count} numbers, each {self.numbers}"

    def allows(self, value: Any) -> bool:
        """Return whether the value is a list of so many allowed numbers."""
        return len(value) == self.count and all(map(self.numbers.allows, value))


@dataclass(frozen=True)
class NumberOrWord(Limit):
    """A number, or one word; ``text`` contains ``{word}`` and ``{numbers}``."""

    word: str
    numbers: Numbers | Integers
    text: str

    def __str__(self) -> str:
        return self.text.format(word=self.word, numbers=self.numbers)

    def allows(self, value: Any) -> bool:
        """Return whether the value is the word or in the range."""
        return bool(value == self.word) or self.numbers.allows(value)


@dataclass(frozen=True)
class Name(Limit):
    """A name that rows of a manifest contain."""

    def __str__(self) -> str:
        return "up to 100 letters, digits, and . _ + -"

    def allows(self, value: Any) -> bool:
        """Return whether the value has 1 to 100 allowed characters."""
        return re.fullmatch(r"[\w.+-]{1,100}", value, re.ASCII) is not None

    def shown(self, value: Any) -> str:
        """Return the beginning of the text in quotes."""
        return repr(value[:40])


@dataclass(frozen=True)
class Text(Limit):
    """Text that is not empty; ``what`` names it."""

    what: str

    def __str__(self) -> str:
        return self.what

    def allows(self, value: Any) -> bool:
        """Return whether the text is not empty."""
        return bool(value)

    def shown(self, value: Any) -> str:
        """Return the text in quotes."""
        return repr(value)


@dataclass(frozen=True)
class OutputPlace(Text):
    """A local path, or the URL of an object store; another URL would become a folder named after its scheme."""

    def allows(self, value: Any) -> bool:
        """Return whether the text is not empty, and no URL of another kind."""
        return bool(value) and ("://" not in value or is_url(value))

    def shown(self, value: Any) -> str:
        """Return the text, in quotes if it is empty."""
        return value or repr(value)


@dataclass(frozen=True)
class LevelRange(Limit):
    """An integer whose range follows from other keys of its group; ``ends`` computes it."""

    text: str
    ends: Callable[[Any], tuple[int, int]]
    remark: str = ""

    def __str__(self) -> str:
        return f"{self.text}{self.remark}"

    def check_in(self, key: str, value: int, group: Any) -> None:
        """Raise ConfigError unless the value is in the range that the group's other keys give.

        Parameters
        ----------
        key : str
            Full name of the setting.
        value : int
            Its value.
        group : SensorConfig or NoiseConfig
            The group, with valid ``bits``.
        """
        in_range(key, value, *self.ends(group), self.remark)


@dataclass(frozen=True)
class Drawn(Limit):
    """A number, or a distribution of one of ``kinds``, all of whose draws are from ``low`` to ``high``.

    ``range_text`` replaces the range in words. `distributions.parse_drawn` checks values.
    """

    kinds: tuple[str, ...]
    low: float = -math.inf
    high: float = math.inf
    range_text: str = ""

    @property
    def range(self) -> str:
        """Return the allowed draws in words."""
        if self.range_text or self.low == -math.inf:
            return self.range_text or "a finite number"
        return f"{self.low:g} to {self.high:g}"

    def __str__(self) -> str:
        return f"{self.range}; constant, or drawn: {', '.join(self.kinds)}"


# ------------------------------------------------------------------------------------- limits that several modules use

MIN_GAIN, MAX_GAIN = 1e-3, 1e3
"""Range of all gains. Chosen: far beyond cameras, and no product or quotient of gains overflows."""

MAX_VARIANCE = 1e15
"""Largest a and b of a profile. Chosen: far beyond sensors, and the conversion to DN does not overflow."""

MAX_LEVELS = 100
"""Most noise levels, and most draws at each level: keys have two digits for them."""

MIN_PATCH, MAX_PATCH = 2, 2**15
"""Range of the sides and strides of patches, pixels."""

MAX_RANDOM_PATCHES = 10**4
"""Most patches at random places of one image: keys have four digits for them."""

MAX_BRANCH_NUMBER = 1e9
"""Largest number in a branch of a physical profile, and largest standard deviation in DN that a line gives."""

MAX_ISO = 1e7

SWITCH = Switch(("auto", "on", "off"))
"""Values of each effect."""

SCATTER = Switch(("off", "body", "image"))

DEQUANTIZE = Switch(("off", "dither", "dither_all"))

CAMERA_LAWS = Choice(("fixed", "convex", "choice", "identity", "custom"))

GAIN_TEXT = f"a gain above 0, from {MIN_GAIN:g} to {MAX_GAIN:g}"
GAIN = Drawn(("uniform", "truncated_normal"), MIN_GAIN, MAX_GAIN, GAIN_TEXT)
INVERSE_GAIN = Drawn((*GAIN.kinds, "inverse_truncated_normal"), MIN_GAIN, MAX_GAIN, GAIN_TEXT)

VARIANCE_SLOPE = Drawn(
    ("uniform", "log_uniform"), 0, MAX_VARIANCE, f"a slope of the variance of 0 or more, up to {MAX_VARIANCE:g}"
)
VARIANCE_OFFSET = Drawn((*VARIANCE_SLOPE.kinds, "log_linear_in_a"), -MAX_VARIANCE, MAX_VARIANCE)

SCENE_KINDS = ("uniform", "log_uniform", "choice")
ISO = Drawn(SCENE_KINDS, math.nextafter(0, 1), MAX_ISO, f"an ISO above 0, up to {MAX_ISO:g}")
EXPOSURE_S = Drawn(SCENE_KINDS, 1e-7, 1e5)
TEMPERATURE_C = Drawn(SCENE_KINDS, -100.0, 150.0)
EXPOSURE_RATIO = Drawn(SCENE_KINDS, 1e-3, 1e6)
"""Ranges of the values of a scene. Chosen: far beyond cameras."""


@dataclass(frozen=True)
class DrawnOrByIso(Drawn):
    """A number, a distribution, or a table by ISO: one of ``forms``, which `noise_validation` checks."""

    forms: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{super().__str__()}; or by ISO: {', '.join(self.forms)}"


READ_SHAPE = DrawnOrByIso(
    ("choice",),
    math.nextafter(-0.5, 0),
    math.nextafter(10.0, 0),
    "more than -0.5, where the Tukey-lambda distribution has a variance, and less than 10",
    ("by_stop", "by_iso"),
)

PATCH = Described(
    "null, a side, [grid, side], [grid, side, stride] or [random, side, count]; side and stride are even, "
    f"{MIN_PATCH} to {MAX_PATCH} pixels, count is 1 to {MAX_RANDOM_PATCHES}"
)
LEVELS = Described(f"how many, 1 to {MAX_LEVELS}, or a list of ISOs or {{a, b}}")
ISO_RANGE = Described("the lowest and the highest ISO, [100, 6400]")
GAIN_BY_COLOUR = NumberList(3, Numbers(0.1, 10))
LENS_SHADING = NumberList(3, Numbers(-10, 10))
BLACK_ERROR = Described(
    "a number, four (the 2x2 sites), [by_colour, R, G1, B, G2], or a table, [by_stop, [four], …] or [by_log_iso, "
    "[four], …], whose fours are in the order R, G1, B, G2 if by_colour precedes it"
)

BLACK_LEVEL = LevelRange("0 to 2^bits - 2", lambda group: (0, 2**group.bits - 2))
WHITE_LEVEL = LevelRange(
    "black_level_dn + 1 to 2^bits - 1",
    lambda group: (group.black_level_dn + 1, 2**group.bits - 1),
    " (above the black level, within the bits)",
)


@dataclass(frozen=True)
class IsoForm(Limit):
    """A number, or one of some forms of `forms.ISO_FORMS`; `noise_validation` checks it."""

    forms: tuple[str, ...]

    def __str__(self) -> str:
        return f"a number of 0 or more, up to {MAX_BRANCH_NUMBER:g}, or a form: {', '.join(self.forms)}"
