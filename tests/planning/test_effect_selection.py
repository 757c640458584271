"""Selection of effects: omitted effects stay within the tolerance of the masking noise, in every statistic."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain, messages
from helpers.configs import with_branch
from helpers.datasets import Settings
from helpers.flats import response
from helpers.photographs import fill
from hypothesis import given
from hypothesis import strategies as st

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Float, Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.planning.effect_selection import (
    MIN_OUTLIERS,
    EffectRules,
    Prediction,
    Selection,
    facts_of,
    omit_weakest,
    weakest_first,
)
from unprocess_gen.planning.frame_model import FrameModel, SignalRange, signal_range
from unprocess_gen.planning.plan import Planner, plan_image, plan_levels
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.plan import CameraPlan, IspPlan, Physics, Place, Plan
from unprocess_gen.simulation.reference import electrons
from unprocess_gen.simulation.reference.colour import IDENTITY
from unprocess_gen.simulation.reference.poisson import poisson
from unprocess_gen.simulation.reference.sensor import to_dn
from unprocess_gen.simulation.reference.unprocess import camera_light, unprocess
from unprocess_gen.simulation.tone_curves import linear_table
from unprocess_gen.sources import synthetic

SCENES = ("daylight", "indoor", "low_light", "night", "video_night", "long_exposure")


def unrounded(srgb: Srgb, plan: Plan) -> tuple[Float, Float]:
    """Return the clean and the noisy frame in DN, before rounding."""
    light = unprocess(srgb, plan) * plan.scene.exposure
    factor = electrons.light_factor(plan, light.shape)
    light = light if factor is None else light * factor
    clean_dn = to_dn(light, plan.sensor.black_level_dn, plan.sensor.white_level_dn, plan.brightest)
    return clean_dn, electrons.noisy(clean_dn, plan)


def omission(srgb: Srgb, everything: Plan, auto: Plan, frames: int = 1) -> dict[str, Float]:
    """Return the squared omission of ``auto`` divided by the masking variance, for each statistic.

    One value per pixel, row, column and colour plane of the mean over the ``frames`` of a still clip. The masking
    variance is that of ``auto`` at the local signal.
    """
    clean_dn = unrounded(srgb, auto)[0]
    clips = ([unrounded(srgb, plan.replace(frame=n))[1] for n in range(frames)] for plan in (everything, auto))
    with_all, with_some = (np.mean(clip, axis=0) for clip in clips)
    omitted = with_all - with_some
    variance = electrons.noise_variance(clean_dn, auto) + 1 / 12
    if auto.physics is not None and "dark_current" in auto.noise.effects:
        variance = variance + auto.physics.dn_per_e**2 * auto.physics.dark_e
    variance = variance / frames
    height, width = omitted.shape
    planes = [(omitted[y::2, x::2], variance[y::2, x::2]) for y in range(min(height, 2)) for x in range(min(width, 2))]
    return {
        "pixel": (omitted**2 / variance).ravel(),
        "row mean": omitted.mean(1) ** 2 / (variance.mean(1) / width),
        "column mean": omitted.mean(0) ** 2 / (variance.mean(0) / height),
        "plane mean": np.array([part.mean() ** 2 / (noise.mean() / part.size) for part, noise in planes]),
    }


RARE = {
    "lens_shading": "lens_shading", "gain_by_colour": "gain_by_colour", "column_temporal": "column_temporal_std_dn",
    "dsnu": "dsnu_std_e",
}  # fmt: skip
"""Effects whose numbers few profiles have, and the key of each."""

PROFILES = ("imx385", "sony_a7s2", "nikon_d850", "canon_5d4", "canon_70d", "canon_700d", "oppo_reno10x")
TOLERANCE = 0.1


def limit(tolerance: float, count: int) -> float:
    """Return an upper limit of the RMS of ``count`` normals of standard deviation ``tolerance``; exceeded once in 5e8.

    Laurent and Massart's inequality (Annals of Statistics 2000, lemma 1).
    """
    t = 20.0
    return tolerance * math.sqrt(1 + 2 * math.sqrt(t / count) + 2 * t / count)


def independent(statistic: str, count: int, srgb: Srgb) -> int:
    """Return how many of ``count`` values of a statistic are independent: all pixels of a row can be correlated.

    Row offsets correlate the means of all columns, or of two planes; column offsets those of all rows.
    """
    per_frame = {"pixel": min(srgb.shape[:2]), "row mean": 1, "column mean": 1, "plane mean": 1}[statistic]
    sites = {"pixel": srgb.shape[0] * srgb.shape[1], "row mean": srgb.shape[0], "column mean": srgb.shape[1]}
    return per_frame * count // sites.get(statistic, min(4, srgb.shape[0] * srgb.shape[1]))


@functools.cache
def cut(name: str, height: int, width: int) -> Srgb:
    return np.ascontiguousarray(synthetic.picture(name)[100 : 100 + height, 200 : 200 + width])


def flat(*colour: int, height: int = 40, width: int = 56) -> Srgb:
    return np.broadcast_to(np.array(colour, dtype=np.uint8), (height, width, 3)).copy()


@pytest.fixture(scope="module")
def pictures() -> dict[str, Srgb]:
    """Return crops of scenes, gray flats, and flats of colours with a dark channel."""
    cuts = {name: cut(name, 40, 56) for name in ("highlights-0", "colour_chart-0", "dead_leaves-0")}
    grays = {f"gray {code}": flat(code, code, code, height=30, width=40) for code in (0, 255)}
    return cuts | grays | {"cyan": flat(0, 200, 200, height=31, width=41)}


def configured(settings: Settings, *overrides: str) -> Config:
    """Return a config; if the profile lacks the ISO of the scene, at an ISO that it has."""
    config = settings(*overrides)
    for iso in (None, 1600, 3200):
        config = replaced(config, {"noise.iso": config.noise.iso if iso is None else iso})
        try:
            validate_config(config)
            return config
        except ConfigError:
            continue
    raise AssertionError(overrides)


def switched(config: Config, switch: str, srgb: Srgb, number: int) -> Plan:
    config = replaced(config, {"effects.all": switch})
    return plan_image(config, f"{number:064x}", 0, facts_of(srgb))


def hold(config: Config, pictures: dict[str, Srgb], free: tuple[str, ...] = EFFECTS) -> int:
    """Assert that the noise masks the ``free`` effects that ``auto`` omits; return how many statistics have some."""
    held = 0
    for name, srgb in pictures.items():
        everything, auto = (switched(config, switch, srgb, 0) for switch in ("on", "auto"))
        kept = {*free, *auto.noise.effects}
        everything = everything.replace(effects=tuple(one for one in everything.noise.effects if one in kept))
        if everything.noise.effects == auto.noise.effects:
            continue
        for statistic, squares in omission(srgb, everything, auto).items():
            rms = float(np.sqrt(squares.mean()))
            most = limit(config.effects.tolerance, independent(statistic, squares.size, srgb))
            assert rms <= most, f"{name}, {statistic}: {rms} of the noise, at most {most}"
            held += 1
    return held


# Omitted effects are masked -------------------------------------------------------------------------------------------


QUICK = {(noise, list(SCENES)[number % len(SCENES)]) for number, noise in enumerate(PROFILES)}
"""Each profile with one scene; all combinations are slow."""


@pytest.mark.parametrize(("noise", "scene"), slow_except(QUICK, itertools.product(PROFILES, SCENES)))
def test_omitted_effects_are_masked_by_the_noise(
    settings: Settings, pictures: dict[str, Srgb], noise: str, scene: str
) -> None:
    """No number is marked as assumed, and a full well cuts bright signals."""
    config = configured(settings, f"noise={noise}", f"scene={scene}", "noise.assumed=[]", "noise.full_well_e=20000")
    some = {name: pictures[name] for name in ("colour_chart-0", "dead_leaves-0", "gray 255", "cyan")}
    assert hold(config, some) > 0


def sensor(rng: np.random.Generator, physics: Physics) -> Physics:
    """Return a sensor whose effects are within a few powers of ten of the tolerance."""

    def around(middle: float, decades: float = 1.5) -> float:
        return float(middle * 10 ** rng.uniform(-decades, decades))

    gain, read = around(0.3), around(2.0)
    return physics.replace(
        dn_per_e=gain,
        prnu_std=min(around(0.01), 0.3),
        dark_e=around(0.05),
        dark_offset=str(rng.choice(["kept", "removed"])),
        hot_pixel_share=min(around(0.003), 0.5),
        hot_pixel_e=around(0.3),
        full_well_e=around(3000.0),
        read_std_dn=read,
        read_law="gaussian",
        row_std_dn=around(0.03 * read),
        column_std_dn=around(0.03 * read),
        black_error_dn=tuple(float(one) for one in rng.normal(0, around(0.01 * read), 4)),
        dead_pixel_share=around(1e-5),
    )


@pytest.mark.parametrize(
    ("frames", "sensors"),
    [(1, 20), pytest.param(1, 40, marks=pytest.mark.slow), pytest.param(12, 16, marks=pytest.mark.slow)],
)
def test_omitted_effects_are_masked_for_any_sensor(
    settings: Settings, pictures: dict[str, Srgb], frames: int, sensors: int
) -> None:
    """For single frames, and for the mean over the frames of a clip."""
    config = configured(settings, "noise=nikon_d850", "scene=night", "noise.assumed=[]", "noise.full_well_e=1000")
    rng = np.random.default_rng(5)
    left_out: set[str] = set()
    names = list(pictures)
    for number in range(sensors):
        srgb = pictures[names[number % len(names)]]
        plan = switched(config, "on", srgb, number).replace(exposure_ratio=float(10 ** rng.uniform(-0.5, 2.5)))
        assert plan.physics is not None
        plan = of_sensor(plan, sensor(rng, plan.physics))
        effects = decided(config, plan, srgb, frames)
        left_out |= set(EFFECTS) - set(effects)
        found: dict[str, list[np.ndarray]] = {}
        for body in range(4 if frames == 1 else 2):
            everything = plan.replace(stream_key=body, body_key=body + 1000)
            auto = everything.replace(effects=effects)
            if "dead_pixels" not in effects:  # counted instead
                everything = everything.replace(effects=tuple(one for one in EFFECTS if one != "dead_pixels"))
            for statistic, squares in omission(srgb, everything, auto, frames).items():
                found.setdefault(statistic, []).append(squares)
        for statistic, parts in found.items():
            values = np.concatenate(parts)
            most = limit(TOLERANCE, independent(statistic, values.size, srgb))
            assert math.sqrt(values.mean()) <= most, (number, statistic, effects)
    assert left_out == set(EFFECTS) - {"quantise"}


def of_sensor(plan: Plan, physics: Physics) -> Plan:
    """Return the plan with the numbers of another sensor and every effect."""
    b_dn2 = physics.read_std_dn * physics.read_std_dn
    return plan.replace(physics=physics, a_dn=physics.dn_per_e, b_dn2=b_dn2, effects=EFFECTS)


def decided(config: Config, plan: Plan, srgb: Srgb, frames: int = 1) -> tuple[str, ...]:
    """Return the effects that ``auto`` simulates with the numbers of a plan."""
    assert plan.physics is not None
    facts, span_dn = facts_of(srgb, frames), float(plan.sensor.span_dn)
    light = signal_range(facts, plan.isp, plan.camera, plan.scene.exposure, span_dn)
    return chosen(automatic(config), plan.physics, facts, light)


def automatic(config: Config, tolerance: float = TOLERANCE) -> Config:
    """Return the config with every effect on ``auto`` and a number for each."""
    effects = replace(config.effects, all="auto", tolerance=tolerance)
    branches = [
        replace(branch, column_std_dn=0.1, row_std_dn=0.1, black_error_dn=0.1) for branch in config.noise.branches
    ]
    noise = replace(config.noise, assumed=[], full_well_e=1000.0, branches=branches)
    return replace(config, effects=effects, noise=noise)


def all_predictions(config: Config, physics: Physics, facts: Facts, light: SignalRange) -> tuple[Prediction, ...]:
    """Return the predictions for a body whose only frame is that of the facts."""
    rules = EffectRules(config)
    frame = rules.frame(physics, facts, light)
    on = omit_weakest(rules.tolerance, frame, rules.on, [*rules.patterns, *rules.temporal])
    return Selection(rules, frame, on).predictions()


@pytest.mark.parametrize("profile", ["sony_a7s2", "canon_70d"])
@pytest.mark.parametrize("scene", ["daylight", "night"])
def test_redrawn_plans_are_those_of_a_new_planner(settings: Settings, profile: str, scene: str) -> None:
    """A planner keeps what plans of a sensor share, and predicts effects in bright light only if they may be next."""
    config = settings(f"noise={profile}", f"scene={scene}", "effects.all=auto", "effects.tolerance=0.3")
    kept = Planner(config)
    for epoch in range(6):
        facts = Facts(256, 128 + epoch // 3, 256, epoch % 2, 250)
        (own,), (shared,) = (
            planner.plans(planner.images(0, 5, "", facts, None, epoch), Place()) for planner in (Planner(config), kept)
        )
        assert shared[0] == own[0]
        selection = own[1]
        assert selection is not None
        frame, on = selection.frame, selection.rules.on

        def strength(effect: str, frame: FrameModel = frame, on: frozenset[str] = on) -> tuple[bool, float, str]:
            ratios = [frame.ratio((effect,), level_dn, on - {effect}) for level_dn in frame.levels(on - {effect})]
            return frame.outliers(effect, on) >= MIN_OUTLIERS, max(ratios), effect

        assert list(weakest_first(frame, on, EFFECTS)) == sorted(EFFECTS, key=strength)


def predicted(effect: str, *arguments: Any) -> Prediction:
    """Return the prediction of one effect, from the arguments of `all_predictions`."""
    return next(one for one in all_predictions(*arguments) if one.effect == effect)


def chosen(config: Config, physics: Physics, facts: Facts, light: SignalRange) -> tuple[str, ...]:
    return tuple(one.effect for one in all_predictions(config, physics, facts, light) if one.simulated)


def test_only_rounding_masks_fixed_patterns_of_clean_frames(settings: Settings, pictures: dict[str, Srgb]) -> None:
    """The mean of many frames has no other noise."""
    overrides = ("scene=night", "noise=nikon_d850", "noise.assumed=[]", "clean.includes_fixed_pattern=true")
    fixed = ("prnu", "black_error")
    left_out = 0
    for share in (1e-8, 1e-7, 1e-6, 1e-4):
        config = configured(settings, *overrides, f"noise.prnu_std={share}")
        branches = [replace(branch, black_error_dn=[10 * share] * 4) for branch in config.noise.branches]
        config = replaced(config, {"noise.branches": branches})
        for srgb in pictures.values():
            auto = switched(config, "auto", srgb, 1)
            physics = auto.physics
            assert physics is not None
            light = unprocess(srgb, auto) * auto.scene.exposure
            levels = (auto.sensor.black_level_dn, auto.sensor.white_level_dn)
            part = np.zeros(light.shape)
            if "prnu" not in auto.noise.effects:
                patterned = light * response(physics, light.shape)
                part += to_dn(patterned, *levels) - to_dn(light, *levels)
            if "black_error" not in auto.noise.effects:
                part += electrons.by_site(physics.black_error_dn, (light.shape[0], light.shape[1]), (0, 0))
            left_out += len(set(fixed) - set(auto.noise.effects))
            for statistic, count in ((part, 1), (part.mean(1), part.shape[1]), (part.mean(0), part.shape[0])):
                rms = math.sqrt(float((statistic**2).mean()) * count * 12)
                assert rms <= limit(TOLERANCE, statistic.size)
    assert left_out > 0


# A body and a scene ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("noise", PROFILES)
def test_a_body_has_its_patterns_in_all_images_or_in_none(
    settings: Settings, pictures: dict[str, Srgb], noise: str, scene: str
) -> None:
    """The pattern of ``sony_a7s2`` was in 17 of 37 images of ``video_night`` when every image decided."""
    config = configured(settings, f"noise={noise}", f"scene={scene}", "sensor.units=1")
    sizes = [srgb[: 2 * side, :side] for side in (8, 32) for srgb in pictures.values()]
    plans = [switched(config, "auto", srgb, number) for number, srgb in enumerate([*pictures.values(), *sizes])]
    assert len({tuple(name for name in plan.noise.effects if BY_NAME[name].is_fixed) for plan in plans}) == 1


@pytest.mark.parametrize(
    ("overrides", "simulated"),
    [((), False), (("effects.dead_pixels=on",), True), (("effects.all=on",), True), (("noise.unsourced=[]",), True)],
)
def test_a_number_without_any_source_is_used_only_where_switched_on(
    settings: Settings, overrides: tuple[str, ...], simulated: bool
) -> None:
    config = settings("noise=sony_a7s2", "scene=daylight", *overrides)
    plan = plan_image(config, "0" * 64, 0, facts_of(flat(128, 128, 128)))
    assert ("dead_pixels" in plan.noise.effects) == simulated


@pytest.mark.parametrize(("electrons", "simulated"), [(60_000, False), (16_000, False), (15_000, True), (5_000, True)])
def test_a_full_well_is_simulated_only_below_the_end_of_the_converter(
    settings: Settings, electrons: float, simulated: bool
) -> None:
    """12 bits above black 256 end at 3839 DN; a gain of ¼ DN per electron reaches them with 15,356 electrons."""
    config = configured(
        settings, "noise=nikon_d850", "scene=daylight", "sensor=generic_12bit", f"noise.full_well_e={electrons}"
    )
    plan = switched(config, "auto", flat(255, 255, 255), 0)
    physics = plan.physics.replace(dn_per_e=0.25, read_std_dn=1.0)
    light = SignalRange(0.0, float(plan.sensor.span_dn))
    assert ("full_well" in chosen(config, physics, facts_of(flat(255, 255, 255)), light)) == simulated


# One effect -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def base(settings: Settings) -> tuple[Config, Physics]:
    """Return a config with every effect on ``auto``, and a sensor on which only shot and read noise are simulated."""
    config = configured(settings, "noise=nikon_d850", "scene=daylight", "noise.assumed=[]", "noise.full_well_e=1000")
    plan = switched(config, "on", flat(9, 9, 9), 0)
    assert plan.physics is not None
    physics = plan.physics.replace(
        dn_per_e=1.0,
        prnu_std=1e-5,
        dark_e=1e-4,
        hot_pixel_share=1e-6,
        hot_pixel_e=1e-3,
        full_well_e=1e6,
        read_std_dn=3.0,
        row_std_dn=1e-4,
        column_std_dn=1e-4,
        black_error_dn=(1e-4, 1e-4, 1e-4, 1e-4),
        dead_pixel_share=1e-9,
    )
    return automatic(config), physics


FACTS = Facts(768, 512, 256, 10, 255)
LIGHT = SignalRange(10.0, 3000.0)


@pytest.mark.parametrize(
    ("effect", "numbers"),
    [
        ("prnu", {"prnu_std": 0.2}),
        ("dark_current", {"dark_e": 1e4}),
        ("hot_pixels", {"hot_pixel_share": 0.01, "hot_pixel_e": 30.0}),
        ("full_well", {"full_well_e": 2000.0}),
        ("full_well", {"full_well_e": 3010.0}),
        ("row", {"row_std_dn": 5e-3 * 50}),
        ("column", {"column_std_dn": 5e-3 * 50}),
        ("black_error", {"black_error_dn": (0.0, 0.0, -50.0, 0.0)}),
        ("dead_pixels", {"dead_pixel_share": 1e-3}),
    ],
)
def test_only_the_strong_effect_is_simulated(
    base: tuple[Config, Physics], effect: str, numbers: dict[str, float]
) -> None:
    """Strong dark current can mask even read noise."""
    config, physics = base
    on = set(chosen(config, physics.replace(**numbers), FACTS, LIGHT))
    assert effect in on
    assert on - {"read"} == {"shot", "quantise", effect}


@pytest.mark.parametrize(
    ("effect", "numbers"),
    [
        ("prnu", {"prnu_std": 1e-4}),
        ("hot_pixels", {"hot_pixel_share": 1e-5, "hot_pixel_e": 0.3}),
        ("column", {"column_std_dn": 1e-3}),
        ("black_error", {"black_error_dn": (0.0, 0.0, 1e-3, 0.0)}),
    ],
)
def test_pattern_masked_in_one_frame_is_simulated_for_a_clip(
    base: tuple[Config, Physics], effect: str, numbers: dict[str, float]
) -> None:
    config, physics = base
    physics = physics.replace(**numbers)
    assert effect not in chosen(config, physics, FACTS, LIGHT)
    found = predicted(effect, config, physics, replace(FACTS, frames=100_000), LIGHT)
    assert found.simulated
    assert found.statistic.startswith("clip's")


def test_temporal_noise_is_no_stronger_in_a_clip(base: tuple[Config, Physics]) -> None:
    config, physics = base
    physics = physics.replace(row_std_dn=0.01, dark_e=0.01)
    for one, many in zip(
        all_predictions(config, physics, FACTS, LIGHT),
        all_predictions(config, physics, replace(FACTS, frames=100), LIGHT),
        strict=True,
    ):
        if one.effect in ("shot", "dark_current", "read", "row"):
            assert (many.statistic, many.ratio) == (one.statistic, pytest.approx(one.ratio))


def expected_hot(physics: Physics, facts: Facts, dark_dn: float) -> float:
    """Return the share of hot pixels above one standard deviation: their counts are geometrically distributed."""
    variance_dn2 = 1 / 12 + physics.read_std_dn**2 + physics.dn_per_e * dark_dn
    least = math.floor(math.sqrt(variance_dn2) / physics.dn_per_e) + 1
    ratio = physics.hot_pixel_e / (1 + physics.hot_pixel_e)
    return facts.width * facts.height * physics.hot_pixel_share * math.exp(least * math.log(ratio))


@given(share=st.floats(-9, -4), electrons=st.floats(-2, 3), side=st.integers(10, 4000), dark=st.floats(0, 100))
def test_hot_pixels_are_simulated_from_a_tenth_of_an_outlier(
    base: tuple[Config, Physics], share: float, electrons: float, side: int, dark: float
) -> None:
    config, physics = base
    physics = physics.replace(hot_pixel_share=10**share, hot_pixel_e=10**electrons)
    facts = replace(FACTS, width=side, height=side)
    expected = expected_hot(physics, facts, dark)
    hot = predicted("hot_pixels", config, physics, facts, SignalRange(dark, 3000.0))
    assert hot.simulated == (expected >= 0.1)
    assert math.isclose(hot.outliers, expected, rel_tol=0.01)  # what else is left out hid a little of it


def test_dead_pixels_that_read_black_are_invisible_in_black_images_only(base: tuple[Config, Physics]) -> None:
    config, physics = base
    physics = physics.replace(dead_pixel_share=1e-4, dead_pixel_level=1.0)
    assert "dead_pixels" not in chosen(config, physics, FACTS, SignalRange(0.0, 0.0))
    assert "dead_pixels" in chosen(config, physics, FACTS, LIGHT)


@given(rate=st.floats(0, 1e6))
def test_no_poisson_count_exceeds_the_limit_used_for_full_wells(rate: float) -> None:
    """For the largest random word."""
    most = poisson(np.array([0, 2**31], dtype=np.uint32), np.full(2, rate)).max()
    assert most <= (rate + 7 * math.sqrt(rate) + 12 if rate else 0)


def test_omitted_offsets_add_linearly(base: tuple[Config, Physics]) -> None:
    """0.07 and 0.07 of the noise would stay within the tolerance in quadrature."""
    config, physics = base
    plane_dn = math.sqrt((9 + 10 + 1 / 12) / (384 * 256))
    one = {"black_error_dn": (0.07 * plane_dn,) * 4}
    other = {"dark_offset": "kept", "dark_e": 0.07 * plane_dn}
    assert "black_error" not in chosen(config, physics.replace(**one), FACTS, LIGHT)
    assert "dark_current" not in chosen(config, physics.replace(**other), FACTS, LIGHT)
    both = chosen(config, physics.replace(**one, **other), FACTS, LIGHT)
    assert len({"black_error", "dark_current"} & set(both)) == 1


# Facts and signal range -----------------------------------------------------------------------------------------------


def test_facts_are_the_extremes_of_all_codes() -> None:
    srgb = np.array([[[9, 7, 3], [250, 8, 8]], [[5, 5, 5], [6, 6, 6]]], dtype=np.uint8)
    assert facts_of(srgb) == Facts(2, 2, 256, 3, 250)


@pytest.mark.parametrize("highlight", ["per_channel", "gray_mean", "none"])
@pytest.mark.parametrize("camera", ["nexus_6p", "sony_a7r", "convex"])
def test_all_sites_are_within_the_signal_range(settings: Settings, highlight: str, camera: str) -> None:
    """For light up to white; highlights above it are clipped."""
    config = configured(settings, "noise=sony_a7s2", "scene=night", f"camera={camera}", f"gains.highlight={highlight}")
    for number, (low, high) in enumerate([(0, 255), (40, 255), (40, 200), (3, 60)]):
        srgb = np.random.default_rng(number).integers(low, high + 1, (40, 40, 3)).astype(np.uint8)
        srgb[0, 0], srgb[0, 1] = (high, high, low), (high, low, high)
        plan = switched(config, "auto", srgb, number)
        light = signal_range(facts_of(srgb), plan.isp, plan.camera, plan.scene.exposure, 1.0)
        found = np.clip(camera_light(srgb, plan), 0, 1) * plan.scene.exposure
        assert light.dark_dn <= found.min() * (1 + 1e-12)
        assert found.max() <= light.bright_dn * (1 + 1e-12)


def test_signal_range_of_gray_by_hand() -> None:
    curve = linear_table("none", 1, 256)
    camera = CameraPlan(
        camera="identity", weights=(0.0,) * 4, rgb2cam=IDENTITY, red_gain=4.0, blue_gain=8.0, inverse_rgb_gain=2.0
    )
    light = signal_range(Facts(4, 4, 256, 51, 102), IspPlan("none", 1), camera, 0.5, 1000.0)
    assert light == SignalRange(curve[51] * 0.25 * 0.5 * 1000, curve[102] * 2.0 * 0.5 * 1000)


def test_equal_images_of_8_and_16_bits_have_equal_effects(settings: Settings, pictures: dict[str, Srgb]) -> None:
    config = configured(settings, "noise=nikon_d850", "scene=indoor", "noise.assumed=[]", "noise.full_well_e=20000")
    for srgb in pictures.values():
        deep = srgb.astype(np.uint16) * np.uint16(257)
        narrow, wide = (switched(config, "auto", one, 0) for one in (srgb, deep))
        assert (narrow.noise.effects, narrow.noise.skipped) == (wide.noise.effects, wide.noise.skipped)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (3, 3), (1, 500)])
@pytest.mark.parametrize("code", [0, 255])
def test_smallest_images_have_a_plan(settings: Settings, shape: tuple[int, int], code: int) -> None:
    config = configured(settings, "noise=canon_70d", "scene=night", "noise.assumed=[]", "noise.full_well_e=3000")
    srgb = np.full((*shape, 3), code, dtype=np.uint8)
    ((_, selection),) = plan_levels(config, "0" * 64, 0, facts_of(srgb))
    assert selection is not None
    predictions = selection.predictions()
    assert [one.effect for one in predictions] == list(EFFECTS)
    assert all(math.isfinite(one.predicted_dn) and one.ratio >= 0 for one in predictions)


# The tolerance --------------------------------------------------------------------------------------------------------

numbers = st.floats(-4, 3).map(lambda power: 10.0**power)
sensors = st.fixed_dictionaries(
    dict.fromkeys(("dn_per_e", "read_std_dn", "row_std_dn", "column_std_dn", "dark_e", "hot_pixel_e"), numbers)
    | dict.fromkeys(("hot_pixel_share", "dead_pixel_share"), st.floats(0, 0.1))
    | {
        "prnu_std": st.floats(0, 0.5),
        "full_well_e": st.floats(1, 1e5),
        "black_error_dn": st.tuples(*[st.floats(-2, 2)] * 4),
    }
)
tolerances = st.floats(-6, 1).map(lambda power: 10.0**power)


@given(sensor=sensors, dark=st.floats(0, 100), more=st.floats(0, 3000), one=tolerances, other=tolerances)
def test_larger_tolerance_never_simulates_more(
    base: tuple[Config, Physics], sensor: dict[str, float], dark: float, more: float, one: float, other: float
) -> None:
    config, physics = base
    physics, light = physics.replace(**sensor), SignalRange(dark, dark + more)
    narrow, wide = (chosen(automatic(config, tolerance), physics, FACTS, light) for tolerance in sorted((one, other)))
    assert set(wide) <= set(narrow)


@given(sensor=sensors, dark=st.floats(0, 100), more=st.floats(1, 3000))
def test_tiny_tolerance_simulates_every_contribution(
    base: tuple[Config, Physics], sensor: dict[str, float], dark: float, more: float
) -> None:
    config, physics = base
    physics = physics.replace(**sensor)
    for one in all_predictions(automatic(config, 1e-12), physics, FACTS, SignalRange(dark, dark + more)):
        assert one.simulated == (one.predicted_dn > 1e-9 * one.masking_dn) or 1e-15 < one.ratio < 1e-9


@given(sensor=sensors, dark=st.floats(0, 100), more=st.floats(0, 3000), tolerance=tolerances)
def test_effect_above_tolerance_alone_is_simulated_and_reasons_fit_a_row(
    base: tuple[Config, Physics], sensor: dict[str, float], dark: float, more: float, tolerance: float
) -> None:
    config, physics = base
    physics = physics.replace(**sensor)
    for one in all_predictions(automatic(config, tolerance), physics, FACTS, SignalRange(dark, dark + more)):
        assert one.simulated or (one.ratio <= tolerance * (1 + 1e-9) and one.outliers < 0.1)
        assert not {";", "\n"} & set(one.reason)
        assert one.forced or (" DN in the " in one.reason and f"tolerance {tolerance:g}" in one.reason)


# Decisions of the config ----------------------------------------------------------------------------------------------


def predictions_of(settings: Settings, *overrides: str) -> dict[str, Prediction]:
    config = configured(settings, "noise=sony_a7s2", "scene=indoor", *overrides)
    ((_, selection),) = plan_levels(config, "0" * 64, 0, facts_of(cut("highlights-0", 40, 56)))
    assert selection is not None
    return {one.effect: one for one in selection.predictions()}


@pytest.mark.parametrize("switch", ["auto", "on", "off"])
@pytest.mark.parametrize("effect", ["read", "prnu", "dark_current"])
def test_switch_of_an_effect_takes_precedence_over_all(settings: Settings, effect: str, switch: str) -> None:
    named = predictions_of(settings, f"effects.all={switch}", f"effects.{effect}=on")[effect]
    assert (named.simulated, named.reason) == (True, "switched on")
    named = predictions_of(settings, f"effects.all={switch}", f"effects.{effect}=off")[effect]
    assert (named.simulated, named.reason) == (False, "switched off")


def test_all_off_keeps_rounding_and_what_is_switched_by_name(settings: Settings) -> None:
    predictions = predictions_of(settings, "effects.all=off")
    assert [name for name, one in predictions.items() if one.simulated] == ["quantise"]
    assert {one.reason for name, one in predictions.items() if name != "quantise"} == {"switched off"}
    assert predictions_of(settings, "effects.all=off", "effects.shot=auto")["shot"].simulated
    assert predictions_of(settings, "effects.all=on", "effects.prnu=auto", "effects.tolerance=1e-3")["prnu"].simulated
    assert not predictions_of(settings, "effects.all=on", "effects.prnu=auto", "effects.tolerance=9")["prnu"].simulated


def planned(settings: Settings, scene: str, *overrides: str) -> Plan:
    config = configured(settings, "noise=nikon_d850", "sensor=generic_14bit", f"scene={scene}", *overrides)
    return plan_image(config, "0" * 64, 0, facts_of(cut("highlights-0", 256, 384)))


def test_assumed_numbers_are_used_where_the_scene_calls_for_them(settings: Settings) -> None:
    """Heat is left out of an exposure of a millisecond, and PRNU where little light falls on the sensor."""
    daylight, night, long = (planned(settings, scene) for scene in ("daylight", "night", "long_exposure"))
    assert {"prnu"} == {"prnu", "dark_current", "hot_pixels"} & set(daylight.noise.effects)
    assert "prnu" not in night.noise.effects
    assert {"prnu", "dark_current", "hot_pixels"} <= set(long.noise.effects)
    assert "prnu_std" in daylight.noise.assumed
    assert {"dark_e_per_s", "hot_pixel_share"}.isdisjoint(daylight.noise.assumed)
    assert {"prnu_std", "dark_e_per_s", "hot_pixel_share"} <= set(long.noise.assumed)


def test_all_on_simulates_known_numbers_and_lists_missing_ones(settings: Settings) -> None:
    predictions = predictions_of(settings, "effects.all=on", "noise=oppo_reno10x", "noise.full_well_e=null")
    lacking = {name: one.reason for name, one in predictions.items() if not one.simulated}
    assert lacking == {
        **{name: f"noise=oppo_reno10x gives no {key}" for name, key in RARE.items()},
        "full_well": "noise=oppo_reno10x gives no full_well_e",
        "row": "noise=oppo_reno10x gives no row_std_dn",
        "black_error": "noise=oppo_reno10x gives no black_error_dn",
    }


@pytest.mark.parametrize("effect", ["full_well", "column", "black_error"])
def test_effect_without_a_number_cannot_be_switched_on(settings: Settings, effect: str) -> None:
    config = settings("noise=oppo_reno10x", "scene=indoor", f"effects.{effect}=on", "noise.full_well_e=null")
    config = with_branch(config, column_std_dn=None)
    with pytest.raises(ConfigError, match=rf"effects.{effect}=on: noise=oppo_reno10x gives no {effect}_"):
        validate_config(config)


# Predictions against measurements -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effect", "numbers", "slack"),
    [
        ("prnu", {"prnu_std": 0.01}, 1.2),  # an upper limit for counts of equal uniforms
        ("shot", {}, 1.0),
        ("dark_current", {"dark_e": 4.0}, 1.0),
        ("hot_pixels", {"hot_pixel_share": 0.05, "hot_pixel_e": 0.2}, 1.0),
        ("read", {}, 1.0),
        ("row", {"row_std_dn": 0.5}, 1.0),
        ("column", {"column_std_dn": 0.5}, 1.0),
        ("dsnu", {"dsnu_std_e": 0.4}, 1.0),
        ("black_error", {"black_error_dn": (0.3, 0.3, 0.3, 0.3)}, 1.0),
    ],
)
def test_predictions_match_measurements(
    base: tuple[Config, Physics], effect: str, numbers: dict[str, float], slack: float
) -> None:
    """On a gray frame, in the statistic where the effect is strongest, within 5 standard errors of a mean square."""
    config, physics = base
    physics = physics.replace(**numbers)
    srgb = flat(120, 120, 120, height=64, width=96)
    config = replace(config, camera=replace(config.camera, law="identity", name="identity"))
    config = replace(config, gains=replace(config.gains, red=1.0, blue=1.0, inverse_rgb=1.0))
    plan = of_sensor(switched(config, "auto", srgb, 0), physics)
    rest = plan.replace(effects=tuple(one for one in EFFECTS if one != effect))
    facts, span_dn = facts_of(srgb), float(plan.sensor.span_dn)
    light = signal_range(facts, plan.isp, plan.camera, plan.scene.exposure, span_dn)
    everything = replace(config, effects=replace(config.effects, all="on"))
    found = predicted(effect, everything, physics, facts, light)
    bodies = [{"stream_key": n, "physics": physics.replace(body_key=n + 1000)} for n in range(12)]
    squares = np.concatenate(
        [omission(srgb, plan.replace(**body), rest.replace(**body))[found.statistic] for body in bodies]
    )
    measured = math.sqrt(float(squares.mean()))
    error = 0.0 if squares.std() == 0 else 5 * float(squares.std()) / math.sqrt(squares.size) / (2 * measured)
    assert found.ratio / slack - error - 1e-9 <= measured <= found.ratio + error + 1e-9


def test_masking_noise_is_the_noise_of_the_plan(base: tuple[Config, Physics]) -> None:
    """The predicted variance of a dark pixel is that of the effects that stay on."""
    config, physics = base
    plan = switched(config, "auto", flat(0, 0, 0), 0).replace(physics=physics, a_dn=1.0, b_dn2=9.0)
    column = predicted("column", config, physics, FACTS, SignalRange(0.0, 3000.0))
    variance = float(electrons.noise_variance(np.full((1, 1), float(plan.sensor.black_level_dn)), plan)[0, 0]) + 1 / 12
    assert math.isclose(column.masking_dn, math.sqrt(variance / FACTS.height), rel_tol=1e-12)


# The table ------------------------------------------------------------------------------------------------------------


def test_plan_prints_a_table_of_all_effects(run_main: RunMain, tmp_path: Path) -> None:
    fill(tmp_path / "photos", 3)
    done = run_main(
        "plan",
        "source.root=photos",
        "noise=nikon_d850",
        "scene=video_night",
        "noise.assumed=[prnu_std]",
    )
    assert (done.code, messages(done.err)) == (0, [])
    lines = done.out.splitlines()
    assert max(map(len, lines)) <= 160
    words = {line.split()[0]: line for line in lines if line.split()}
    assert words["scene"].startswith("scene     video_night: ISO 6400, 0.04 s, 35 °C, light divided by ")
    assert " to " in words["scene"]
    assert (
        "nikon_d850: in DN of black 400, white 16150; on this sensor (black 240, white 4095) times 0.244762" in done.out
    )
    assert "system gain 6.501 DN per electron, read noise " in done.out
    for effect in EFFECTS:
        assert " of 3 " in words[effect]
    assert "3 of 3" in words["shot"]
    assert "outliers" in words["hot_pixels"]
