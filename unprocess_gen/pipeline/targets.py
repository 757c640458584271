"""Compute the targets of a pair: arrays for a training, next to its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.targets import FRAME_TARGETS
from unprocess_gen.core.types import EXACT, FLOAT32, Array, Frame, Pair, Patch, Plan, Row, Srgb, Value
from unprocess_gen.dataset.training import noise_std
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.pair import linear_rgb
from unprocess_gen.sources.patches import crop_patch

Targets = dict[str, Array]


def targets_of(
    names: Sequence[str],
    srgb: Srgb,
    plan: Plan,
    patch: Patch,
    pair: Pair,
    row: Row,
    *,
    known: Mapping[str, Array] = MappingProxyType({}),
    as_float: bool = False,
) -> Targets:
    """Compute targets by name.

    ``srgb`` is the complete image, ``known`` the targets of another pair of the sample. With ``as_float``, noise is in
    units of white.
    """
    targets: Targets = {}
    for name in names:
        if name in FRAME_TARGETS:
            targets[name] = _noise(name, pair.clean if name == "variance" else pair.noisy, row, as_float)
        elif name in known:
            targets[name] = known[name]
        else:
            pixels = crop_patch(srgb, patch)
            targets[name] = pixels.copy() if name == "srgb" else linear_rgb(pixels, plan, patch.origin)
    return targets


def levels_of(plan: Plan) -> dict[str, Value]:
    """Return the levels of a plan as columns of a row."""
    return {"black_level_dn": plan.sensor.black_level_dn, "white_level_dn": plan.sensor.white_level_dn}


def noise_law(plan: Plan) -> dict[str, Value]:
    """Return the columns of a row that targets need; a complete row takes longer than a small pair."""
    return {**levels_of(plan), "a_dn": plan.noise.a_dn, "dark_variance_dn2": dark_variance_dn2(plan)}


def kernels_for(names: Sequence[str], plan: Plan) -> list[str]:
    """Return the sets of kernels that simulate a plan and its targets (`self_test.kernels`)."""
    own = self_test.kernels(plan)
    if "linear_rgb" not in names:
        return [own]
    rounded = plan.replace(accuracy=EXACT)
    plans = rounded, rounded.replace(clean_dtype=FLOAT32)
    return list(dict.fromkeys([own, *map(self_test.kernels, plans)]))


def _noise(name: str, frame: Frame, row: Row, as_float: bool) -> NDArray[np.float32]:
    """Compute the variance (DN²) or the standard deviation (DN) of the noise at each site of a frame."""
    black, white = int(row["black_level_dn"] or 0), int(row["white_level_dn"] or 0)
    frame_dn = frame if frame.dtype == np.uint16 else frame * np.float32(white - black) + np.float32(black)
    std = noise_std(frame_dn, row) / np.float32(white - black if as_float else 1)
    return std * std if name == "variance" else std
