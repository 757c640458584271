"""Numbers of a row that develop its frames to sRGB, as arrays: what `unprocess_gen.torch.develop` reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.dataset.columns import Value
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.cfa import MONO, PATTERNS

FILTERS = (*PATTERNS, MONO)
"""Patterns by their positions in `DevelopmentParameters`."""

SRGB = 0.0
"""Value of gamma that means the piecewise curve of sRGB."""


class DevelopmentParameters(NamedTuple):
    """Numbers of a row that `develop` needs, as arrays that PyTorch's default ``collate_fn`` stacks.

    Attributes
    ----------
    pattern, highlight, tone : ndarray of int64, []
        Positions in ``FILTERS``, ``isp.HIGHLIGHTS`` and ``isp.TONES``.
    gamma : ndarray of float64, []
        Exponent; 0 for the curve of sRGB.
    levels_dn : ndarray of float64, [2]
        Black and white level.
    exposure_ratio, threshold : ndarray of float64, []
        Darkening by the scene, and where highlights begin.
    inverse_gains : ndarray of float64, [3]
        Factors from white-balanced to camera RGB.
    cam2rgb : ndarray of float64, [3, 3]
        Matrix from camera RGB to linear sRGB.
    """

    pattern: Any
    highlight: Any
    tone: Any
    gamma: Any
    levels_dn: Any
    exposure_ratio: Any
    threshold: Any
    inverse_gains: Any
    cam2rgb: Any


def development_parameters(row: Mapping[str, Value] | Plan) -> DevelopmentParameters:
    """Read the parameters of `develop` from a row, for example in a Dataset's ``__getitem__``.

    Parameters
    ----------
    row : mapping or Plan
        Manifest row or plan of a pair.

    Returns
    -------
    DevelopmentParameters
        Arrays of fixed shapes. Stacked, they have the number of the frame as first axis.

    Raises
    ------
    DamageError
        If the row is not the row of a pair.
    """
    from unprocess_gen.simulation.reference import isp  # imports OpenCV, which the readers do not need

    plan = row if isinstance(row, Plan) else plan_from_row(row)
    values = (
        FILTERS.index(plan.sensor.pattern),
        list(isp.HIGHLIGHTS).index(plan.isp.highlight),
        list(isp.TONES).index(plan.isp.tone),
        SRGB if plan.isp.gamma == "srgb" else float(plan.isp.gamma),
        np.array([plan.sensor.black_level_dn, plan.sensor.white_level_dn], np.float64),
        float(plan.scene.exposure_ratio),
        float(plan.isp.highlight_threshold),
        np.array(plan.camera.inverse_gains),
        np.array(isp.cam2rgb(plan)).reshape(3, 3),
    )
    return DevelopmentParameters(*map(np.asarray, values))
