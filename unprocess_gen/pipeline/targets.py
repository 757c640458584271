"""Compute the targets of a pair: arrays for a training, next to its frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import FLOAT32, Array, Frame, Srgb
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.training import noise_std
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.pair import linear_rgb
from unprocess_gen.simulation.plan import EXACT, Plan
from unprocess_gen.sources.patches import crop_patch

Targets = dict[str, Array]


def targets_of(
    names: Sequence[str], srgb: Srgb, plan: Plan, patch: Patch, pair: Pair, *, as_float: bool = False
) -> Targets:
    """Compute targets by name from the complete image; with ``as_float``, noise is in units of white."""
    targets: Targets = {}
    for name in names:
        pixels = crop_patch(srgb, patch)
        if name == "srgb":
            targets[name] = pixels.copy()
        elif name == LINEAR_RGB:
            targets[name] = linear_rgb(pixels, plan, patch.origin)
        else:
            targets[name] = _noise(name, pair.clean if name == "variance" else pair.noisy, plan, as_float)
    return targets


def levels_of(plan: Plan) -> dict[str, Value]:
    """Return the levels of a plan as columns of a row."""
    return {"black_level_dn": plan.sensor.black_level_dn, "white_level_dn": plan.sensor.white_level_dn}


def kernels_for(names: Sequence[str], plan: Plan) -> list[str]:
    """Return the sets of kernels that simulate a plan and its targets (`self_test.kernels`)."""
    own = self_test.kernels(plan)
    if LINEAR_RGB not in names:
        return [own]
    rounded = plan.replace(accuracy=EXACT)
    plans = rounded, rounded.replace(clean_dtype=FLOAT32)
    return list(dict.fromkeys([own, *map(self_test.kernels, plans)]))


def _noise(name: str, frame: Frame, plan: Plan, as_float: bool) -> NDArray[np.float32]:
    """Compute the variance (DN²) or the standard deviation (DN) of the noise at each site of a frame."""
    black, span = plan.sensor.black_level_dn, plan.sensor.span_dn
    law = {**levels_of(plan), "a_dn": plan.noise.a_dn, "dark_variance_dn2": dark_variance_dn2(plan)}
    frame_dn = frame if frame.dtype == np.uint16 else frame * np.float32(span) + np.float32(black)
    std = noise_std(frame_dn, law) / np.float32(span if as_float else 1)
    return std * std if name == "variance" else std
