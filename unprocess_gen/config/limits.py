"""Limits of settings that several modules use, and limits of values that no field of a plan has (`core.fields`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from unprocess_gen.config.distributions import Drawn
from unprocess_gen.config.values import GroupLimit, one_of, refusal
from unprocess_gen.core.fields import Choice, Integers, Limit, Numbers, is_number, value_text
from unprocess_gen.core.object_store import is_url
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.simulation.plan import FIELDS, numbers_of
from unprocess_gen.simulation.reference.light import LIGHTS


def text(what: str) -> Limit:
    """Limit of a text that is not empty; ``what`` names it."""
    return Limit(what, bool, repr)


def are_texts(values: Any) -> bool:
    """True if all items of a list are non-empty texts; OmegaConf also accepts lists and mappings as items."""
    return all(isinstance(value, str) and value for value in values)


class LevelRange(GroupLimit):
    """An integer whose range follows from other keys of its group; ``ends`` computes it."""

    def __init__(self, text: str, ends: Callable[[Any], tuple[int, int]], remark: str = "") -> None:
        super().__init__(f"{text}{remark}")
        self._ends, self._remark = ends, remark

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError unless the value is in the range that the group gives; it may lack ``bits`` or a level."""
        if None in (group.bits, group.black_level_dn):
            return
        low, high = self._ends(group)
        if not low <= value <= high:
            raise refusal(key, value, f"expected {low} to {high}{self._remark}")


class Names(GroupLimit):
    """A list of some of ``names``, at least of ``least``."""

    def __init__(self, text: str, names: Sequence[str], least: int = 0) -> None:
        super().__init__(text)
        self._names, self._least = names, least

    def check(self, key: str, value: Any, group: Any) -> None:
        """Raise ConfigError, which lists the names, for others and for too few."""
        if len(value) < self._least:
            raise refusal(key, [], f"expected at least one of {', '.join(self._names)}")
        for name in value:
            one_of(key, name, self._names)


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

MAX_SPLITS = 16
"""Most splits. Chosen: more than any benchmark has."""

BOOLEAN = Limit("true or false")
"""OmegaConf converts and checks it."""

NAME = Limit(
    "up to 100 letters, digits, and . _ + -",
    lambda value: re.fullmatch(r"[\w.+-]{1,100}", value, re.ASCII) is not None,
    lambda value: repr(value[:40]),
)
"""Names that rows of a manifest contain."""

OVERRIDDEN = "*"
"""Last character of the name of a noise profile with an overridden number."""

PROFILE_NAME = Limit(
    f"{NAME}, and {OVERRIDDEN} at the end if a number of the profile is overridden",
    lambda value: NAME.allows(value.removesuffix(OVERRIDDEN)),
    NAME.shown,
)

BODY_GROUPS = Limit("a list of camera, sensor, noise", lambda value: set(value) <= {"camera", "sensor", "noise"})

OUTPUT_PLACE = Limit(
    "the name of a folder or a URL s3://, gs:// or az://",
    lambda value: bool(value) and ("://" not in value or is_url(value)),
    lambda value: value or repr(value),
)
"""A local path, or the URL of an object store; another URL would become a folder named after its scheme."""

SWITCH = Choice("auto", "on", "off")
"""Values of each effect."""

CAMERA_LAWS = Choice("fixed", "convex", "choice", "identity", "custom")

LIGHT = Choice(*LIGHTS, "scene")


def _is_light(value: Any) -> bool:
    """Check a light, or lights and their shares in turn."""
    if not isinstance(value, list | tuple):
        return value in LIGHTS
    names, shares = value[::2], value[1::2]
    known = len(names) == len(shares) > 0 and all(name in LIGHTS for name in names)
    return known and all(is_number(share) and share > 0 for share in shares) and abs(sum(shares) - 1) <= 1e-9


SCENE_LIGHT = Limit(
    f"one of {', '.join(LIGHTS)}, or several with shares that sum to 1, such as [tungsten, 0.7, daylight, 0.3]",
    _is_light,
)

GAIN_TEXT = f"a gain above 0, from {MIN_GAIN:g} to {MAX_GAIN:g}"
GAIN = Drawn(("uniform", "truncated_normal"), Numbers(MIN_GAIN, MAX_GAIN), GAIN_TEXT)
INVERSE_GAIN = Drawn((*GAIN.kinds, "inverse_truncated_normal"), GAIN.numbers, GAIN_TEXT)

VARIANCE_SLOPE = Drawn(
    ("uniform", "log_uniform"),
    Numbers(0, MAX_VARIANCE),
    f"a slope of the variance of 0 or more, up to {MAX_VARIANCE:g}",
)
VARIANCE_OFFSET = Drawn((*VARIANCE_SLOPE.kinds, "log_linear_in_a"), Numbers(-MAX_VARIANCE, MAX_VARIANCE))

ISO, EXPOSURE_S, TEMPERATURE_C, EXPOSURE_RATIO = (
    Drawn(("uniform", "log_uniform", "choice"), numbers_of(name))
    for name in ("iso", "exposure_s", "temperature_c", "exposure_ratio")
)

EV = Drawn(("uniform", "truncated_normal", "choice"), numbers_of("ev"))

PATCH = Limit(
    "null, a side, [grid, side], [grid, side, stride] or [random, side, count]; side and stride are even, "
    f"{MIN_PATCH} to {MAX_PATCH} pixels, count is 1 to {MAX_RANDOM_PATCHES}"
)
MAX_BURST_FRAMES = 100
"""Largest number of frames of a burst: keys have two digits for it."""

BURST_KEYS: dict[str, Limit] = {
    "frames": Integers(1, MAX_BURST_FRAMES),
    "shift": Numbers(0, 4096),
    "rotation_deg": Numbers(0, 45),
    "downscale": FIELDS["burst_downscale"].limit,
    "ev": Limit(
        f"a list of 1 to {MAX_BURST_FRAMES} numbers of stops from -16 to 16",
        lambda value: (
            isinstance(value, list | tuple)
            and 1 <= len(value) <= MAX_BURST_FRAMES
            and all(is_number(stops) and -16 <= stops <= 16 for stops in value)
        ),
    ),
    "phase": FIELDS["burst_phase"].limit,
}
"""Keys of ``source.burst`` with their allowed values."""
BURST = Limit("null, or a mapping of " + "; ".join(f"{name}: {limit}" for name, limit in BURST_KEYS.items()))
LEVELS = Limit(f"how many, 1 to {MAX_LEVELS}, or a list of ISOs or {{a, b}}")
DIGEST = Limit(
    "64 hexadecimal digits",
    lambda value: re.fullmatch("[0-9a-f]{64}", value) is not None,
    lambda value: value_text(value)[:80],
)
ISO_RANGE = Limit(
    "the lowest and the highest ISO, [100, 6400]",
    lambda value: len(value) == 2 and 0 < value[0] <= value[1] <= ISO.numbers.high,
)
ISO_RANGE_OR_ALL = Limit(f"{ISO_RANGE}, or [] for all ISOs", lambda value: not value or ISO_RANGE.allows(value))


def _are_shares(value: Any) -> bool:
    """Check names and shares of splits."""
    if not isinstance(value, dict) or not 1 <= len(value) <= MAX_SPLITS:
        return False
    has_names = all(isinstance(name, str) and re.fullmatch(r"[\w-]{1,32}", name, re.ASCII) for name in value)
    has_shares = all(is_number(share) and share > 0 for share in value.values())
    return has_names and has_shares and abs(sum(value.values()) - 1) <= 1e-9


def _shares_text(value: Any) -> str:
    """Write shares with their sum."""
    text, shares = value_text(value)[:80], value.values() if isinstance(value, dict) else ()
    return f"{text} (sum {sum(shares):.6g})" if shares and all(map(is_number, shares)) else text


SPLIT = Limit(
    "null, or shares above 0 that sum to 1 by name, such as {train: 0.8, val: 0.2}; "
    f"up to {MAX_SPLITS} names of up to 32 letters, digits, _ and -",
    _are_shares,
    _shares_text,
)

TARGET_NAMES = Limit(f"[] or [{LINEAR_RGB}]", lambda value: tuple(value) in ((), (LINEAR_RGB,)))

BLACK_LEVEL = LevelRange("0 to 2^bits - 2", lambda group: (0, 2**group.bits - 2))
WHITE_LEVEL = LevelRange(
    "black_level_dn + 1 to 2^bits - 1",
    lambda group: (group.black_level_dn + 1, 2**group.bits - 1),
    " (above the black level, within the bits)",
)
