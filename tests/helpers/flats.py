"""Plans and flat fields for tests of the physical effects.

Flats are simulated on a sensor with an integer DN per electron, so that counts are not rounded. Bounds follow from the
sample size (`moments.bernstein`), with one false alarm in 10¹² comparisons.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np

from helpers.datasets import Settings
from helpers.moments import bernstein
from helpers.records import PLAN
from unprocess_gen.config.schema import replaced
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.planning.effect_selection import facts_of
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.effects.hot_pixels import HotPixels
from unprocess_gen.simulation.effects.prnu import Prnu
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.plan import CameraPlan, IspPlan, Physics, Plan, SensorPlan
from unprocess_gen.simulation.reference.colour import IDENTITY
from unprocess_gen.simulation.reference.electrons import bright_means_e, normal_pattern
from unprocess_gen.sources import synthetic

SHA256 = "7" * 64

ISOS = {
    "imx385": 3200, "sony_a7s2": 800, "nikon_d850": 1600, "canon_5d4": 400, "canon_70d": 3200, "canon_700d": 6400,
    "oppo_reno10x": 1600,
}  # fmt: skip
"""Physical profiles, each with an ISO at which it was calibrated."""

FORCED = (
    "noise.prnu_std=0.05", "noise.dark_e_per_s=40", "noise.hot_pixel_share=0.02", "noise.hot_pixel_e_per_s=3000",
    "noise.dead_pixel_share=0.01", "noise.full_well_e=900", "effects.all=on",
)  # fmt: skip
"""Parameters with which every effect is visible in a small picture."""


@functools.lru_cache(maxsize=1)
def picture() -> Srgb:
    """Return a crop of odd size with clipped highlights, deep shadows and saturated colours."""
    return np.ascontiguousarray(synthetic.picture("highlights-0")[150:183, 300:361])


def planned(settings: Settings, srgb: Srgb, *overrides: str, forced: bool = False) -> Plan:
    """Plan a picture; ``forced`` simulates all effects, with numbers for those that a profile does not give."""
    config = settings(*overrides, *(FORCED if forced else ()))
    if forced:
        noise: dict[str, object] = {"noise.gain_by_colour": [0.98, 1.0, 1.03], "noise.lens_shading": [-0.2, 0.0, -0.1]}
        noise |= {"noise.dsnu_std_e": 0.4}
        branches = [
            replace(
                branch,
                row_std_dn=branch.row_std_dn or 1.5,
                column_std_dn=branch.column_std_dn or 1.25,
                column_temporal_std_dn=0.75,
                black_error_dn=branch.black_error_dn or [0.5, -1.5, 2.5, -3.75],
            )
            for branch in config.noise.branches
        ]
        config = replaced(config, {**noise, "noise.row_correlation": 0.3, "noise.branches": branches})
    validate_config(config)
    return plan_image(config, SHA256, facts=facts_of(srgb))


def assert_same(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> None:
    fast, reference = make_pair(srgb, plan, origin), reference_pair(srgb, plan, origin)
    np.testing.assert_array_equal(fast.clean, reference.clean)
    np.testing.assert_array_equal(fast.noisy, reference.noisy)
    assert fast.counts == reference.counts


def with_physics(plan: Plan, **changes: Any) -> Plan:
    assert plan.physics is not None
    return plan.replace(**changes)


BLACK, WHITE = 4096, 65535
SPAN = WHITE - BLACK

SILENT = Physics(
    iso=100.0, exposure_s=1.0, temperature_c=25.0, dn_per_e=8.0, prnu_std=0.0, dark_e=0.0, dark_offset="removed",
    hot_pixel_share=0.0, hot_pixel_e=0.0, full_well_e=1e6, read_law="gaussian", read_shape=0.0, read_std_dn=0.0,
    row_std_dn=0.0, column_std_dn=0.0, black_error_dn=(0.0, 0.0, 0.0, 0.0), dead_pixel_share=0.0, sensor_unit="0",
    body_key=0xB0D1, fixed_pattern_in_clean=False, frame_size=(2**24, 2**24),
)  # fmt: skip


def plan_with(*on: str, frame: int = 0xF4A3E, **changes: Any) -> Plan:
    """Return a plan with only these effects, a 16-bit sensor, and light equal to the code divided by 65535."""
    physics = SILENT.replace(**changes)
    return PLAN.replace(
        stream_key=frame,
        camera=CameraPlan(
            camera="identity", weights=(0.0,) * 4, rgb2cam=IDENTITY, red_gain=1.0, blue_gain=1.0, inverse_rgb_gain=1.0
        ),
        isp=IspPlan("none", gamma=1.0, highlight="none"),
        sensor=SensorPlan("RGGB", bits=16, black_level_dn=BLACK, white_level_dn=WHITE),
        a_dn=physics.dn_per_e, b_dn2=physics.read_std_dn**2, effects=(*on, "quantise"), physics=physics,
        accuracy="exact",
    )  # fmt: skip


def flat(code: int, height: int = 1024, width: int = 1024) -> Srgb:
    return np.full((height, width, 3), code, dtype=np.uint16)


def noisy_dn(plan: Plan, code: int = 0, height: int = 1024, width: int = 1024) -> np.ndarray:
    """Return the noisy frame of a flat, DN above black."""
    return make_pair(flat(code, height, width), plan).noisy.astype(np.float64) - BLACK


def signal_dn(code: int) -> float:
    return code / 65535 * SPAN


COUNT = 1024 * 1024


def bounds_off(values: np.ndarray, mean: float, variance: float, reach: float) -> float:
    """Return the error of the mean in units of its Bernstein bound."""
    return abs(float(values.mean()) - mean) / bernstein(variance, reach, values.size)


def poisson_reach(rate: float) -> float:
    """Return the largest distance of a count from its mean: Bernstein's tail at 2**-33, the least tail probability."""
    log = 33 * math.log(2)
    return log / 3 + math.sqrt(log**2 / 9 + 2 * log * rate) + 1


def hot_pixel_means(physics: Physics, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    plan = plan_with("hot_pixels").replace(physics=physics)
    return bright_means_e(HotPixels().slots(plan)["bright"], shape, origin)


def response(physics: Physics, shape: tuple[int, int], origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    return normal_pattern(Prnu().slots(plan_with("prnu").replace(physics=physics))["electrons"], shape, origin)
