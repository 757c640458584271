"""Kernels equal the reference on random plans: every field of `Plan` and `Physics`, up to the limits of the config.

Plans are drawn as records, so that they combine effects, levels and layouts that no config of another test combines.
A failure lists numbers of cases; ``case(kind, number)`` returns the same case on every machine.
"""

from __future__ import annotations

import functools
import itertools
import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import msgspec
import numpy as np
import pytest
from helpers.flats import IDENTITY, SILENT
from helpers.promise_report import Figure

from unprocess_gen.core.arrays import FLOAT32, MOSAIC, PACKED, UINT16, Srgb
from unprocess_gen.core.random_streams import STREAMS, words
from unprocess_gen.simulation.effects import EFFECTS as ALL_EFFECTS
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.effects import REPLACED
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.pair import make_pair, make_pairs, reference_pair
from unprocess_gen.simulation.plan import DarkFramePlan, Physics, Plan
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.cfa import PATTERNS, unpack
from unprocess_gen.simulation.self_test import GOLDEN_PLAN
from unprocess_gen.sources import synthetic

SPECIAL = ("lens_shading", "gain_by_colour", "column_temporal", "dsnu")
"""Effects whose numbers few profiles have."""

T = TypeVar("T")

KINDS = ("gaussian", "poisson", "shot and read", "physical", "averaged")
"""Noise of a case: two numbers as one normal or as counts, a physical profile without and with all effects, and fixed
patterns in the clean frame."""

WITH_SPECIAL_EFFECTS = ("special effects", "special effects averaged")
"""Kinds with those effects too."""

WITH_DARK_FRAMES = "dark frames"
"""Kind of a physical profile whose read-out noise is sampled from dark frames."""

SENSORS = (
    *((8, 0, 255), (10, 64, 1023), (12, 240, 4095), (12, 0, 4095), (14, 513, 15520), (14, 1024, 16383)),
    *((16, 0, 65535), (16, 4096, 65535), (10, 1022, 1023)),
)
"""Bits, black level and white level of sensors."""

TWO = ("heteroscedastic", "quantise")
"""Effects of noise with two numbers."""

HEIGHTS = (1, 2, 3, 5, 8, 17, 33)
WIDTHS = (1, 2, 15, 16, 17, 33, 63, 64, 65, 127, 129, 255, 257, 511, 512, 513, 577, 1023, 1025, 2049)
"""Sides at and next to the sizes of vectors, blocks of random words and segments."""

FLOAT_CLEAN = "clean float32"
"""Select a clean frame of float32 and a noisy frame of uint16, in place of a dtype."""

MAX_SITES = 9000
READ_SHAPES = (0.0, -0.1, 0.1571, -0.45, 5.0)
"""Shapes of Tukey's distribution; few, because each table takes 0.2 s."""

QUICK, SLOW = 8, 500
"""Cases of each kind and dtype."""


class DarkPixelsInMemory:
    """Hold the pixels of dark frames by name, as `simulation.facts.DarkPixels`."""

    def __init__(self, frames: dict[str, np.ndarray]) -> None:
        self.frames = frames

    def frame(self, sha256: str) -> np.ndarray:
        """Return the frame with this name."""
        return self.frames[sha256]


class Dice(random.Random):
    """Draw parameters by operations that round alike on every machine."""

    def pick(self, options: Sequence[T]) -> T:
        return options[int(self.random() * len(options))]

    def chance(self, share: float) -> bool:
        return self.random() < share

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * self.random()

    def power(self, low: int, high: int) -> float:
        """Return a number from 2**low to 2**high, about uniform in its logarithm."""
        return math.ldexp(1 + self.random(), int(self.between(low, high)))

    def at_most(self, high: int) -> float:
        """Return 0, a number from 2**-10 to 2**high, or rarely a tiny number."""
        return self.pick((0.0, *(self.power(-10, high) for _ in range(4)), self.power(-30, -10)))


@dataclass(frozen=True)
class Case:
    """Arguments of `make_pair`."""

    srgb: Srgb
    plan: Plan
    origin: tuple[int, int]
    dark_pixels: DarkPixels | None = None


def case(kind: str, number: int, dtype: str = UINT16) -> Case:
    """Draw a case of one of `KINDS`."""
    dice = Dice(f"{kind} {dtype} {number}")
    bits, black, white = dice.pick(SENSORS)
    layout = PACKED if dice.chance(0.2) else MOSAIC
    plan = GOLDEN_PLAN.replace(
        **drawn_curve(dice),
        **drawn_colour(dice),
        stream_key=dice.pick((0, 2**64 - 1, *(int(dice.random() * 2**53) << 11 for _ in range(6)))),
        dequantize="dither" if dice.chance(0.1) else "off",
        exposure_ratio=dice.pick((1.0, 1.0, dice.power(-6, 10))),
        pattern=dice.pick(PATTERNS),
        bits=bits,
        black_level_dn=black,
        white_level_dn=white,
        sensor_clip=dice.pick(("sensor", "sensor", "black", "none" if dtype == FLOAT32 else "sensor")),
        saturated_as=dice.pick(("noisy", "noisy", "white")),
        level=dice.pick((0, 0, 1, 99, 4095)),
        draw=dice.pick((0, 0, 1, 99, 4095)),
        frame=dice.pick((0, 0, 1, 12345, 2**31)),
        dtype=UINT16 if dtype == FLOAT_CLEAN else dtype,
        clean_dtype=FLOAT32 if dtype == FLOAT_CLEAN else "",
        layout=layout,
    )
    plan = with_noise(plan, kind, dice)
    origin = dice.pick(((0, 0), *((int(dice.power(0, 13)), int(dice.power(0, 13))) for _ in range(3)), (2**20 + 1, 63)))
    srgb = drawn_image(dice, even=layout == PACKED)
    if kind in WITH_SPECIAL_EFFECTS:
        plan = with_special_effects(
            plan, origin, (srgb.shape[0], srgb.shape[1]), Dice(f"special {kind} {dtype} {number}")
        )
    if kind == WITH_DARK_FRAMES:
        return with_dark_frame(Case(srgb, plan, origin), Dice(f"dark {dtype} {number}"))
    return Case(srgb, plan, origin)


def with_dark_frame(one: Case, dice: Dice) -> Case:
    """Replace the noise of the read-out with a dark frame that is smaller or larger than the image."""
    shape = 2 * int(dice.power(0, 5)), 2 * int(dice.power(0, 7))
    drawn = words(int(dice.random() * 2**53), 0, shape) >> np.uint32(dice.pick((16, 20, 24, 28)))
    plan = one.plan.replace(
        effects=tuple("dark_frame" if on == "read" else on for on in one.plan.noise.effects if on not in REPLACED),
        dark=DarkFramePlan(
            "d" * 64,
            (2 * int(dice.random() * shape[0] / 2), 2 * int(dice.random() * shape[1] / 2)),
            dice.pick((0.0, 7.0, 512.0, 100.5)),
            dice.pick((1.0, 1.0, 0.25, 3855 / 15871, 4.0)),
        ),
    )
    plan = plan if "dark_frame" in plan.noise.effects else plan.replace(effects=("dark_frame", *plan.noise.effects))
    return replace(one, plan=plan, dark_pixels=DarkPixelsInMemory({"d" * 64: drawn.astype(np.uint16)}))


def with_special_effects(plan: Plan, origin: tuple[int, int], shape: tuple[int, int], dice: Dice) -> Plan:
    """Add the numbers that few profiles have, and their effects, to a plan of a physical profile."""
    assert plan.physics is not None
    few_rows = origin[0] < 2**14  # correlated offsets are computed from row 0
    physics = plan.physics.replace(
        row_correlation=dice.pick((0.0, 0.7, -0.4, 0.999)) if few_rows else 0.0,
        column_temporal_std_dn=dice.at_most(9),
        gain_by_colour=dice.pick(((1.0, 1.0, 1.0), (0.97, 1.0, 1.04), (0.1, 3.0, 10.0))),
        lens_shading=dice.pick(((-0.3, 0.05, -0.1), (-0.9, 0.0, 0.0), (-0.001, -0.002, 0.0))),
        dsnu_std_e=dice.at_most(40),
        dead_pixel_level=dice.pick((0.0, 0.3, 1.0)),
        frame_size=tuple(start + side + int(dice.power(0, 8)) for start, side in zip(origin, shape, strict=True)),
    )
    on = {*plan.noise.effects, *(one for one in SPECIAL if not dice.chance(0.3))}
    return plan.replace(physics=physics, effects=tuple(one for one in EFFECTS if one in on))


def drawn_curve(dice: Dice) -> dict[str, object]:
    tone, gamma = dice.pick((("smoothstep", 2.2), ("smoothstep", 2.2), ("none", 2.2), ("none", "srgb"), ("none", 1.0)))
    return {"tone": tone, "gamma": gamma}


def drawn_colour(dice: Dice) -> dict[str, object]:
    """Draw matrix, gains and highlights: of cameras, or any matrix whose rows sum to 1."""
    rows = [(a, b, 1 - (a + b)) for a, b in ((dice.between(-2, 2), dice.between(-2, 2)) for _ in range(3))]
    matrices = [IDENTITY, tuple(itertools.chain(*rows)), *map(colour.rgb2cam, colour.CAMERAS.values())]
    return {
        "rgb2cam": dice.pick(matrices),
        "red_gain": dice.between(0.5, 3),
        "blue_gain": dice.between(0.5, 3),
        "inverse_rgb_gain": dice.pick((0.5, 1.0 - 2**-53, 1.0, dice.between(0.4, 2.1), dice.between(0.4, 2.1))),
        "highlight": dice.pick(("per_channel", "per_channel", "gray_mean", "none")),
        "highlight_threshold": dice.pick((0.9, 0.9, 0.0, dice.between(0, 0.99))),
    }


def with_noise(plan: Plan, kind: str, dice: Dice) -> Plan:
    """Draw the noise of a plan; its other fields stay as they are."""
    span_dn = plan.sensor.white_level_dn - plan.sensor.black_level_dn
    if kind == "gaussian":
        a_dn = dice.at_most(10)
        b_dn2 = dice.pick((dice.at_most(20), dice.power(-6, 12), -a_dn * span_dn * dice.random(), 1e15))
        return plan.replace(a_dn=a_dn, b_dn2=b_dn2, effects=dice.pick(((), *[TWO] * 9)))
    light = ((-7, 3), (2, 7), (6, 14), (6, 14), (13, 26))
    brightest_e = dice.power(*dice.pick(light))
    dn_per_e = span_dn * min(1.0, plan.scene.exposure) / brightest_e
    if kind == "poisson":
        a_dn, b_dn2 = dice.pick((dn_per_e, dn_per_e, dn_per_e, 0.0)), dice.at_most(12)
        return plan.replace(noise_law="poisson", a_dn=a_dn, b_dn2=b_dn2, effects=TWO)
    physics = drawn_physics(dice, dn_per_e, brightest_e)
    on = ("shot", "read", "row", "black_error", "quantise")
    if kind == "shot and read":
        physics, omitted = physics.replace(read_std_dn=physics.read_std_dn + 2**-10), dice.pick((*on[2:], "none"))
        on = tuple(one for one in on if one != omitted)
    else:
        share = dice.pick((0.0, 0.2, 0.5))
        on = tuple(one for one in EFFECTS if one not in SPECIAL and not dice.chance(share))
    physics = physics.replace(fixed_pattern_in_clean=kind.endswith("averaged"))
    return plan.replace(a_dn=dn_per_e, b_dn2=physics.read_std_dn * physics.read_std_dn, effects=on, physics=physics)


def drawn_physics(dice: Dice, dn_per_e: float, brightest_e: float) -> Physics:
    """Draw the numbers of a physical profile with ``brightest_e`` electrons at white."""
    errors = [dice.pick((0.0, dice.between(-4, 4), dice.between(-600, 600))) for _ in range(4)]
    return SILENT.replace(
        dn_per_e=dn_per_e,
        prnu_std=dice.pick((0.0, 0.005, 0.05, 0.5)),
        dark_e=dice.pick((dice.at_most(3), dice.at_most(10), dice.power(20, 26))),
        dark_offset=dice.pick(("removed", "kept")),
        hot_pixel_share=dice.pick((0.0, 2**-9, 0.02, 0.5, 1.0)),
        hot_pixel_e=dice.pick((dice.at_most(3), dice.at_most(10), dice.power(20, 26))),
        full_well_e=max(1.0, brightest_e * dice.pick((0.01, 0.4, 0.9, 1.0, 3.0))),
        read_law=dice.pick(("gaussian", "tukey_lambda")),
        read_shape=dice.pick(READ_SHAPES),
        read_std_dn=dice.at_most(13),
        row_std_dn=dice.at_most(9),
        column_std_dn=dice.at_most(9),
        black_error_dn=(errors[0], errors[1], errors[2], errors[3]),
        dead_pixel_share=dice.pick((0.0, 2**-9, 0.02, 0.5, 1.0)),
        body_key=dice.pick((0, 2**64 - 1, int(dice.random() * 2**53) << 11)),
    )


def drawn_image(dice: Dice, even: bool) -> Srgb:
    """Draw an image of 8 or 16 bits: random codes, shadows, highlights, one code, a ramp, or part of a scene."""
    height = dice.pick(HEIGHTS)
    width = dice.pick([width for width in WIDTHS if width * height <= MAX_SITES])
    if even:
        height, width = height + height % 2, width + width % 2
    dtype = np.dtype(dice.pick((np.uint8, np.uint8, np.uint16)))
    most, kind = np.iinfo(dtype).max, dice.pick(("codes", "dark", "bright", "flat", "ramp", "scene"))
    drawn = words(int(dice.random() * 2**53), 0, (height, 3 * width)).reshape(height, width, 3)
    codes = (drawn >> np.uint32(32 - 8 * dtype.itemsize)).astype(dtype)
    if kind == "dark":
        codes >>= 4
    elif kind == "bright":
        codes = most - (codes >> 4)
    elif kind == "flat":
        codes[:] = dice.pick((0, most, int(dice.random() * most)))
    elif kind == "ramp":
        codes[:] = (np.arange(width) * most // max(width - 1, 1)).astype(dtype)[:, None]
    elif kind == "scene":
        picture = scene()
        y, x = (int(dice.random() * max(1, side - 50)) for side in picture.shape[:2])
        codes = np.tile(picture[y : y + 40, x : x + 200], (1, 12, 1))[:height, :width].astype(dtype) * (most // 255)
    return codes[..., ::-1] if dice.chance(0.2) else codes


@functools.lru_cache(maxsize=1)
def scene() -> Srgb:
    return synthetic.picture("highlights-0")


def simulate(one: Case) -> Pair:
    return make_pair(one.srgb, one.plan, one.origin, one.dark_pixels)


def differences(found: Pair, expected: Pair) -> str:
    """Return in what two pairs differ, as text; "" if all bytes and counts are equal."""
    texts = []
    for name in ("clean", "noisy"):
        ours, theirs = getattr(found, name), getattr(expected, name)
        if (ours.dtype, ours.shape) != (theirs.dtype, theirs.shape):
            texts.append(f"{name}: {ours.dtype} {ours.shape} instead of {theirs.dtype} {theirs.shape}")
        elif ours.tobytes() != theirs.tobytes():
            at = np.argwhere(ours != theirs)
            first = tuple(at[0]) if len(at) else "only signs of 0"
            texts.append(f"{name}: {len(at)} of {ours.size} sites, first {first}")
    if found.counts != expected.counts:
        texts.append(f"{found.counts} instead of {expected.counts}")
    return "; ".join(texts)


@pytest.fixture(autouse=True)
def _underflow() -> Iterator[None]:
    """Allow underflow: numbers far below the tolerance of any effect are drawn too."""
    with np.errstate(under="ignore"):
        yield


COUNTS = [QUICK, pytest.param(SLOW, marks=pytest.mark.slow)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("dtype", [UINT16, FLOAT32, FLOAT_CLEAN])
@pytest.mark.parametrize("kind", (*KINDS, *WITH_SPECIAL_EFFECTS, WITH_DARK_FRAMES))
def test_pairs_of_random_plans_equal_the_reference(kind: str, dtype: str, count: int, figure: Figure) -> None:
    failed = {}
    for number in range(count):
        one = case(kind, number, dtype)
        if text := differences(simulate(one), reference_pair(one.srgb, one.plan, one.origin, one.dark_pixels)):
            failed[f"case({kind!r}, {number}, {dtype!r})"] = text
    assert failed == {}
    figure("kernels", f"{count} random plans, {kind}, {dtype}: 0 pairs differ from the reference")


def test_random_plans_have_every_number_of_an_effect() -> None:
    """A number that is never drawn would be compared with the reference at its default only."""
    plans = [case(kind, number).plan for kind in WITH_SPECIAL_EFFECTS for number in range(QUICK)]
    defaults = {field.name: field.default for field in msgspec.structs.fields(Physics)}
    for effect, name in ((one, name) for one in ALL_EFFECTS for name in one.numbers):
        drawn = [getattr(plan.numbers, name) for plan in plans if effect.name in plan.noise.effects]
        assert any(value != defaults[name] for value in drawn), name


@pytest.mark.parametrize("kind", KINDS)
def test_float_clean_frames_change_no_noisy_frame(kind: str) -> None:
    for number in range(QUICK // 5):
        one = case(kind, number, FLOAT_CLEAN)
        pair = simulate(one)
        rounded = simulate(replace(one, plan=one.plan.replace(clean_dtype="")))
        floats = simulate(replace(one, plan=one.plan.replace(clean_dtype="", dtype=FLOAT32)))
        assert pair.noisy.tobytes() == rounded.noisy.tobytes(), number
        assert one.plan.averaged or pair.clean.tobytes() == floats.clean.tobytes(), number


# Crops and levels -----------------------------------------------------------------------------------------------------


def mosaics(pair: Pair, one: Case) -> tuple[np.ndarray, np.ndarray]:
    if one.plan.output.layout == PACKED:
        clean, noisy = (unpack(frame, one.plan.sensor.pattern, one.origin) for frame in (pair.clean, pair.noisy))
        return clean, noisy
    return pair.clean, pair.noisy


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("dtype", [UINT16, FLOAT32, FLOAT_CLEAN])
@pytest.mark.parametrize("kind", (*KINDS, *WITH_SPECIAL_EFFECTS, WITH_DARK_FRAMES))
def test_crops_of_random_plans_are_crops_of_the_frame(kind: str, dtype: str, count: int) -> None:
    failed = []
    for number in range(count):
        one, dice = case(kind, number, dtype), Dice(number)
        height, width = one.srgb.shape[:2]
        top, left = int(dice.random() * height), int(dice.random() * width)
        bottom, right = (at + 1 + int(dice.random() * (side - at)) for at, side in ((top, height), (left, width)))
        rows, columns = slice(top, bottom), slice(left, right)
        origin = one.origin[0] + top, one.origin[1] + left
        crop = make_pair(one.srgb[rows, columns], one.plan.replace(layout=MOSAIC), origin, one.dark_pixels)
        for found, expected in zip((crop.clean, crop.noisy), mosaics(simulate(one), one), strict=True):
            if found.tobytes() != expected[rows, columns].tobytes():
                failed.append(f"case({kind!r}, {number}, {dtype!r}): rows {top} to {bottom}, columns {left} to {right}")
    assert failed == []


def with_other_noise(plan: Plan, kinds: Sequence[str], dice: Dice) -> Plan:
    """Draw another noise, level, draw and clipping; the parameters of the clean frame stay as they are."""
    plan = plan.replace(noise_law="gaussian", physics=None)
    plan = with_noise(plan, dice.pick(kinds), dice)
    return plan.replace(
        effects=tuple(one for one in plan.noise.effects if one != "full_well"),
        level=int(dice.random() * 100),
        draw=int(dice.random() * 100),
        sensor_clip=dice.pick(("sensor", "black")),
        saturated_as=dice.pick(("noisy", "noisy", "white")),
    )


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("dtype", [UINT16, FLOAT32, FLOAT_CLEAN])
@pytest.mark.parametrize("kinds", [KINDS[:1], KINDS[1:4], KINDS[:4]], ids=["one normal", "counts", "mixed"])
def test_levels_of_random_plans_equal_separate_pairs(kinds: Sequence[str], dtype: str, count: int) -> None:
    failed = {}
    for number in range(count // 5):
        one, dice = case(kinds[0], number, dtype), Dice(number)
        plans = [with_other_noise(one.plan, kinds, dice) for _ in range(2 + int(6 * dice.random()))]
        for level, pair in enumerate(make_pairs(one.srgb, plans, one.origin)):
            if text := differences(pair, simulate(replace(one, plan=plans[level]))):
                failed[f"{kinds}, case {number}, level {level} of {len(plans)}"] = text
    assert failed == {}


# Limits of shares -----------------------------------------------------------------------------------------------------

KEY = 0x0123456789ABCDEF


@pytest.mark.parametrize("effect", ["hot_pixels", "dead_pixels"])
def test_pixels_at_the_limit_of_a_share_equal_the_reference(effect: str) -> None:
    """A share of w / 2**32 excludes the pixel with word w, a share of (w + 1) / 2**32 includes it."""
    one = case("physical", 0)
    plan = one.plan.replace(effects=EFFECTS, layout=MOSAIC, bits=16, black_level_dn=4096, white_level_dn=65535)
    srgb, numbers = np.full((3, 70, 3), 128, dtype=np.uint8), {"dark_e": 0.0, "dn_per_e": 8.0, "read_std_dn": 0.5}
    found = []
    for word in words(KEY, STREAMS[effect], (3, 70))[:, ::23].ravel().tolist():
        for share in (word / 2**32, (word + 1) / 2**32):
            shares = {"hot_pixel_share": 0.0, "dead_pixel_share": 0.0, "dead_pixel_level": 0.3} | {
                f"{effect.removesuffix('s')}_share": share
            }
            physics = plan.physics.replace(**numbers, **shares, hot_pixel_e=2e4, full_well_e=1e6, body_key=KEY)
            one = Case(srgb, plan.replace(physics=physics), (0, 0))
            found.append(simulate(one).noisy)
            assert differences(simulate(one), reference_pair(one.srgb, one.plan, one.origin, one.dark_pixels)) == ""
    assert all((without != with_one).sum() == 1 for without, with_one in zip(found[::2], found[1::2], strict=True))
