"""A plan and its parts, with a value in every field."""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.source import Source
from unprocess_gen.simulation.frames import Counts, Pair, Patch
from unprocess_gen.simulation.plan import (
    CameraPlan,
    IspPlan,
    NoisePlan,
    Physics,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)

SHA256 = "ab" * 32


SOURCE = Source(3, "a, b.png", "a, b.png", 1234)


PAIR = Pair(np.zeros((2, 3), np.uint16), np.zeros((2, 3), np.uint16), Counts(1, 2, 3, 4, 5, 6))


PLAN = Plan(
    seed=0,
    stream_key=0x1F,
    source=SourcePlan(downscale=1, dequantize="off"),
    scene=ScenePlan("daylight", exposure_ratio=1.0),
    camera=CameraPlan(
        camera="convex", weights=(0.1, 0.2, 0.3, 0.4), rgb2cam=(0.6, 0.3, 0.1) * 3, red_gain=2.0, blue_gain=1.7,
        inverse_rgb_gain=0.8,
    ),
    isp=IspPlan("smoothstep", 2.2, "per_channel", highlight_threshold=0.9),
    sensor=SensorPlan("RGGB", bits=12, black_level_dn=240, white_level_dn=4095),
    noise=NoisePlan(
        "imx385_iso3200", "gaussian", a_dn=7.0, b_dn2=38.0, effects=("heteroscedastic", "quantise"), skipped=()
    ),
    accuracy="exact",
)  # fmt: skip


PATCH = Patch(3, 2)


PHYSICS = Physics(
    iso=800.0, exposure_s=0.02, temperature_c=25.0, dn_per_e=1.5, prnu_std=0.005, dark_e=0.02, dark_offset="removed",
    hot_pixel_share=1e-5, hot_pixel_e=1.0, full_well_e=0.0, read_law="tukey_lambda", read_shape=-0.1, read_std_dn=3.0,
    row_std_dn=0.5, column_std_dn=0.25, black_error_dn=(0.1, -0.2, 0.3, -0.4), dead_pixel_share=1e-6,
    sensor_unit="000000000000001f", body_key=0xF1, fixed_pattern_in_clean=True,
)  # fmt: skip
