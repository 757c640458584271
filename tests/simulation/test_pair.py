"""Kernels compute the DN of the reference, and a pair is a pure function of pixels and plan."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from helpers.promise_report import Figure
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.kernels.clean import FLOAT32_CHANGED_SHARE, FLOAT32_CLEAN_DN, is_steep
from unprocess_gen.simulation.kernels.normal import COARSE_ERROR
from unprocess_gen.simulation.pair import FRAMES_PER_PASS, make_pair, make_pairs, reference_pair
from unprocess_gen.simulation.plan import FAST, Plan
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.self_test import GOLDEN_PHYSICS
from unprocess_gen.sources import synthetic

SENSORS = {8: (0, 255), 10: (64, 1023), 12: (240, 4095), 14: (1024, 16383), 16: (4096, 65535)}
HIGHLIGHTS = ("per_channel", "gray_mean", "none")
INVERSE_GAINS = (0.5, 0.8, 1.0 - 2**-53, 1.0, 1.1, 2.05)


@pytest.fixture(scope="module")
def plan(plan: Plan) -> Plan:
    return plan.replace(red_gain=2.1, blue_gain=1.7, inverse_rgb_gain=0.8)


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """Return a crop of odd size with clipped highlights, deep shadows and saturated colours."""
    return np.ascontiguousarray(synthetic.picture("highlights-0")[150:361, 300:597])


STEPS = [pytest.param(9, id="every 9th row"), pytest.param(1, id="every row", marks=pytest.mark.slow)]


def every_row(scene: np.ndarray, step: int) -> np.ndarray:
    """Return the rows of the scene whose number is a multiple of ``step``."""
    return np.ascontiguousarray(scene[::step])


@pytest.fixture(scope="module")
def full(scene: np.ndarray, plan: Plan) -> Pair:
    """Return the pair of the complete scene."""
    return make_pair(scene, plan)


def with_sensor(plan: Plan, bits: int) -> Plan:
    black, white = SENSORS[bits]
    return plan.replace(bits=bits, black_level_dn=black, white_level_dn=white)


def assert_same(srgb: np.ndarray, plan: Plan) -> None:
    fast, reference = make_pair(srgb, plan), reference_pair(srgb, plan)
    np.testing.assert_array_equal(fast.clean, reference.clean, err_msg=str(plan))
    np.testing.assert_array_equal(fast.noisy, reference.noisy, err_msg=str(plan))
    assert fast.counts == reference.counts, plan


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize(("tone", "gamma"), [("smoothstep", 2.2), ("none", 2.2), ("none", "srgb"), ("none", 1.0)])
def test_kernels_equal_the_reference_for_every_camera_and_curve(
    scene: np.ndarray, plan: Plan, tone: str, gamma: float | str, step: int, figure: Figure
) -> None:
    rows = every_row(scene, step)
    for camera in colour.CAMERAS.values():
        assert_same(rows, plan.replace(rgb2cam=colour.rgb2cam(camera), tone=tone, gamma=gamma))
    figure("kernels", f"{len(colour.CAMERAS)} cameras: 0 of {rows[..., 0].size} sites differ from the reference")


def test_kernels_equal_the_reference_on_16_bit_sources(plan: Plan, figure: Figure) -> None:
    codes = np.random.Generator(np.random.Philox(key=1)).integers(0, 65536, (67, 93, 3)).astype(np.uint16)

    for bits in SENSORS:
        assert_same(codes, with_sensor(plan, bits))
    figure("kernels", f"{len(SENSORS)} sensors: 0 of {codes[..., 0].size} sites differ on 16-bit codes")


@pytest.mark.parametrize("well_dn", [0.25, 50.8])
def test_sites_that_round_to_the_full_well_are_saturated(plan: Plan, well_dn: float) -> None:
    codes = np.tile(np.arange(0, 40000, 2, np.uint16)[:, None, None], (1, 8, 3))
    physics = GOLDEN_PHYSICS.replace(full_well_e=well_dn / GOLDEN_PHYSICS.dn_per_e)
    assert_same(codes, plan.replace(physics=physics, effects=("shot", "full_well"), saturated_as="white"))


def test_single_pixels_equal_those_of_the_frame(plan: Plan, scene: np.ndarray, full: Pair) -> None:
    for y, x in [(0, 0), (0, 15), (0, 16), (7, 63), (8, 64), (210, 296)]:
        pixel = make_pair(scene[y : y + 1, x : x + 1], plan, origin=(y, x))
        assert pixel.clean[0, 0] == full.clean[y, x]
        assert pixel.noisy[0, 0] == full.noisy[y, x]


# Several noise levels of one clean frame ------------------------------------------------------------------------------

NOISES = ((0.5, 2.0), (8.0034, -122.69544), (0.0, 0.0), (80.0, 2e4), (3.0, 0.0), (9.0, 0.25), (2.0, 64.0))
assert len(NOISES) > FRAMES_PER_PASS


def levels_of(plan: Plan, **of_every_one: object) -> list[Plan]:
    plans = [plan.replace(level=n, draw=n % 2, a_dn=a, b_dn2=b) for n, (a, b) in enumerate(NOISES)]
    return [one.replace(**of_every_one) for one in plans]


@pytest.mark.parametrize(
    "options",
    [
        {"accuracy": FAST},
        {"accuracy": FAST, "highlight": "gray_mean", "saturated_as": "white"},
        {"noise_law": "poisson", "b_dn2": 3.0, "accuracy": FAST},
        {"physics": GOLDEN_PHYSICS, "effects": EFFECTS},
        {"physics": GOLDEN_PHYSICS.replace(fixed_pattern_in_clean=True), "effects": EFFECTS},
    ],
    ids=",".join,
)
def test_levels_of_one_clean_frame_equal_separate_pairs(
    scene: np.ndarray, plan: Plan, options: dict[str, object]
) -> None:
    """Plans with other tiers and effects than the random plans of `test_random_plans`."""
    assert_equal_separate_pairs(scene, levels_of(plan, **options))


def assert_equal_separate_pairs(srgb: np.ndarray, plans: list[Plan]) -> None:
    pairs = list(make_pairs(srgb, plans, origin=(3, 130)))
    assert len(pairs) == len(plans) > FRAMES_PER_PASS
    for one, pair in zip(plans, pairs, strict=True):
        alone = make_pair(srgb, one, origin=(3, 130))
        np.testing.assert_array_equal(pair.clean, alone.clean)
        np.testing.assert_array_equal(pair.noisy, alone.noisy)
        assert pair.counts == alone.counts


def test_the_clean_frame_of_several_levels_is_one_array(scene: np.ndarray, plan: Plan) -> None:
    first, *others = make_pairs(scene, levels_of(plan))

    assert all(other.clean is first.clean for other in others)


def test_one_plan_gives_one_pair_and_no_plan_none(scene: np.ndarray, plan: Plan) -> None:
    (pair,) = make_pairs(scene, [plan])

    np.testing.assert_array_equal(pair.noisy, make_pair(scene, plan).noisy)
    assert list(make_pairs(scene, [])) == []


@pytest.mark.parametrize(
    "other",
    [
        {"inverse_rgb_gain": 0.7},
        {"exposure_ratio": 2.0},
        {"stream_key": 1},
        {"pattern": "BGGR"},
        {"white_level_dn": 4000},
        {"physics": GOLDEN_PHYSICS.replace(full_well_e=1.0), "effects": EFFECTS},
        {"physics": GOLDEN_PHYSICS.replace(fixed_pattern_in_clean=True), "effects": EFFECTS},
    ],
    ids=lambda other: next(iter(other)),
)
def test_plans_of_different_clean_frames_are_refused(scene: np.ndarray, plan: Plan, other: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="clean frames of the plans differ"):
        make_pairs(scene, [plan, plan.replace(**other)])


# The form in float32 --------------------------------------------------------------------------------------------------


def in_float32(srgb: np.ndarray, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Pair:
    return make_pair(srgb, plan.replace(accuracy=FAST), origin)


def assert_within(differing: int, worst: int, sites: int) -> None:
    """Error bounds as documented in `kernels.clean`."""

    assert worst <= FLOAT32_CLEAN_DN
    assert differing <= FLOAT32_CHANGED_SHARE * sites


@pytest.mark.slow
@pytest.mark.parametrize("camera", colour.CAMERAS)
def test_float32_is_within_its_error_on_all_colours(plan: Plan, camera: str, figure: Figure) -> None:
    """Each colour is tested on each of the four CFA sites."""
    made = with_sensor(plan, 14).replace(rgb2cam=colour.rgb2cam(colour.CAMERAS[camera]))
    green, blue = np.mgrid[:256, :256]
    differing, worst = 0, 0
    for red in range(256):
        codes = np.stack([np.full_like(green, red), green, blue], axis=-1).astype(np.uint8)
        codes = codes.repeat(2, axis=0).repeat(2, axis=1)
        apart = np.abs(in_float32(codes, made).clean.astype(int) - make_pair(codes, made).clean)
        differing, worst = differing + int((apart > 0).sum()), max(worst, int(apart.max()))
    assert_within(differing, worst, 4 * 2**24)
    figure("tiers", f"fast, {camera}: {differing} of {4 * 2**24} clean values differ, by at most {worst} DN")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"saturated_as": "white"},
        {"highlight": "gray_mean", "sensor_clip": "black"},
        {"exposure_ratio": 3.0},
        {"a_dn": 8.0034, "b_dn2": -122.69544},
        {"a_dn": 0.0, "b_dn2": 0.0},
        {"pattern": "GBRG"},
    ],
    ids=lambda options: ",".join(options) or "as it is",
)
@pytest.mark.parametrize("bits", SENSORS)
def test_float32_noisy_frames_and_counts_are_near_the_reference(
    scene: np.ndarray, plan: Plan, options: dict[str, object], bits: int
) -> None:
    made = with_sensor(plan, bits).replace(**options)

    single, exact = in_float32(scene, made, (3, 130)), make_pair(scene, made, (3, 130))

    apart = np.abs(single.noisy.astype(int) - exact.noisy)
    variance_dn2 = np.maximum(made.noise.a_dn * (exact.clean - float(made.sensor.black_level_dn)) + made.noise.b_dn2, 0)
    moved_dn = COARSE_ERROR * np.sqrt(variance_dn2) + (0.01 if bits == 16 else 0.002)
    assert apart.max() <= 1
    assert (apart > 0).mean() <= moved_dn.mean()  # what moves a value by so much moves it over an edge so often
    for one, other in zip(msgspec.structs.astuple(single.counts), msgspec.structs.astuple(exact.counts), strict=True):
        assert abs((one or 0) - (other or 0)) <= 0.002 * apart.size


@settings(max_examples=60)
@given(
    threshold=st.floats(0, 0.99),
    entries=st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    gains=st.tuples(st.floats(0.3, 5), st.floats(0.3, 5), st.floats(0.2, 2)),
    highlight=st.sampled_from(HIGHLIGHTS),
    bits=st.sampled_from([14, 16]),
)
def test_float32_is_within_its_error_wherever_it_is_chosen(
    plan: Plan,
    threshold: float,
    entries: list[float],
    gains: tuple[float, float, float],
    highlight: str,
    bits: int,
) -> None:
    rows = [(*pair, 1 - sum(pair)) for pair in zip(entries[::2], entries[1::2], strict=True)]
    made = with_sensor(plan, bits).replace(
        **dict(zip(("red_gain", "blue_gain", "inverse_rgb_gain"), gains, strict=True)),
        rgb2cam=tuple(itertools.chain(*rows)),
        highlight=highlight,
        highlight_threshold=threshold,
    )
    assume(not is_steep(made))
    codes = np.random.Generator(np.random.Philox(key=5)).integers(0, 256, (128, 256, 3)).astype(np.uint8)

    with np.errstate(under="ignore"):
        apart = np.abs(in_float32(codes, made).clean.astype(int) - make_pair(codes, made).clean)

    assert apart.max() <= FLOAT32_CLEAN_DN
    if bits == 14 and min(map(abs, made.camera.rgb2cam)) > 0.02:  # else a site has few values
        assert (apart > 0).mean() <= 1e-3


# Limits ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("highlight", ["per_channel", "gray_mean"])
def test_white_is_white_and_black_is_black(plan: Plan, highlight: str) -> None:
    ends = np.array([[[255] * 3, [0] * 3], [[0] * 3, [255] * 3]], dtype=np.uint8)
    matrices = [*map(colour.rgb2cam, colour.CAMERAS.values()), colour.IDENTITY]
    for matrix, bits, inverse in itertools.product(matrices, SENSORS, (1e-300, 0.3, *INVERSE_GAINS)):
        made = with_sensor(plan, bits).replace(rgb2cam=matrix, highlight=highlight, inverse_rgb_gain=inverse)

        pair = make_pair(ends, made)

        black, white = SENSORS[bits]
        np.testing.assert_array_equal(pair.clean, [[white, black], [black, white]], err_msg=str(made))
        assert pair.counts.saturated == 2, made
        assert pair.counts.clean_clipped_low == 0, made


def test_the_input_is_not_modified(plan: Plan, scene: np.ndarray) -> None:
    before = scene.copy()

    make_pair(scene, plan)

    np.testing.assert_array_equal(scene, before)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((4, 4, 3)),
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3), np.int16),
    ],
)
@pytest.mark.parametrize("form", [make_pair, reference_pair])
def test_other_arrays_are_refused(plan: Plan, form: object, wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"expected uint8 or uint16 \[H, W, 3\]"):
        form(wrong, plan)  # type: ignore[operator]


@pytest.mark.parametrize(("black", "white", "rounded"), [(240, 4095, 2168), (241, 4092, 2166)])
@pytest.mark.parametrize("make", [make_pair, reference_pair])
def test_halves_are_rounded_to_the_even_dn(plan: Plan, make: object, black: int, white: int, rounded: int) -> None:
    """White at half the light: 240 + 3855 / 2 = 2167.5 and 241 + 3851 / 2 = 2166.5."""
    half = plan.replace(red_gain=1.0, blue_gain=1.0, inverse_rgb_gain=0.5, highlight="none", a_dn=0.0, b_dn2=0.0)
    white_patch = np.full((4, 6, 3), 255, dtype=np.uint8)

    pair = make(white_patch, half.replace(black_level_dn=black, white_level_dn=white))  # type: ignore[operator]

    assert set(pair.clean.ravel()) == set(pair.noisy.ravel()) == {rounded}
