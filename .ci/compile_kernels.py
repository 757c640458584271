"""Compile the kernels of every kind of noise and frames, and of bursts, for pictures of 8 and 16 bits and of floats.

Two processes of pytest that need the same kernels at once would both compile them.
"""

from typing import Any

import numpy as np

from unprocess_gen.simulation.kernels import burst
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.plan import Motion
from unprocess_gen.simulation.self_test import GOLDEN_PLANS, failures, golden_image, kernels

for plan in GOLDEN_PLANS.values():
    assert not any(map(failures, kernels([plan])))
    if not plan.source.is_linear:
        make_pair(golden_image().astype(np.uint16), plan)

_STILL = Motion(1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
_KINDS: tuple[tuple[Any, str], ...] = (
    (np.uint8, "plain"), (np.uint16, "plain"), (np.float32, "linear_physical"),
)  # fmt: skip
for dtype, name in _KINDS:
    light = burst.scene_light(np.ones((1, 1, 3), dtype), GOLDEN_PLANS[name])
    burst.frame_light(light, _STILL, (0, 0), (0, 0), (1, 1))
