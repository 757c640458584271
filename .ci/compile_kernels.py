"""Compile the kernels of every kind of noise and frames, for pictures of 8 and 16 bits and of floats.

Two processes of pytest that need the same kernels at once would both compile them.
"""

import numpy as np

from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.self_test import GOLDEN_PLANS, failures, golden_image, kernels

for plan in GOLDEN_PLANS.values():
    assert not any(map(failures, kernels([plan])))
    if not plan.source.is_linear:
        make_pair(golden_image().astype(np.uint16), plan)
