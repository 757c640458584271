"""Noise of a two-parameter profile: shot and read noise with a variance linear in the signal.

Foi et al. 2008 and the article, section 2; in Poisson form CRVD (Yue et al. 2020).
"""

from __future__ import annotations

import numpy as np

from unprocess_gen.core.arrays import Float
from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect, Shape, frame_words
from unprocess_gen.simulation.effects.shot import counts
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference.noise import normals

STREAM = declare_stream("heteroscedastic", 1)


class Heteroscedastic(Effect):
    """Noise with the variance max(0, a·(x - black) + b); the only effect of a two-parameter profile."""

    name = "heteroscedastic"
    meaning = "noise of a two-parameter profile, its only effect"


def noise_variance(clean_dn: Float, plan: Plan) -> Float:
    """Return the variance of shot and read noise, max(0, a·(x - black) + b).

    Parameters
    ----------
    clean_dn : ndarray of float64, [H, W]
        Unrounded clean frame x, DN.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64, [H, W]
        Variance, DN².
    """
    a_dn, b_dn2 = plan.noise.variance_line
    return np.asarray(np.maximum(a_dn * (clean_dn - plan.sensor.black_level_dn) + b_dn2, 0))


def heteroscedastic(clean_dn: Float, plan: Plan, origin: Shape = (0, 0)) -> Float:
    """Add shot and read noise of a two-parameter profile to the unrounded clean frame, [H, W] DN, not clipped.

    For ``law="gaussian"``, the noise is one normal deviate of variance `noise_variance`. For ``"poisson"``, it is a
    times a Poisson count of mean (x - black) / a, plus a normal deviate of variance b.
    """
    noise, black_dn = plan.noise, plan.sensor.black_level_dn
    n = normals(frame_words(plan, STREAM, clean_dn.shape, origin))
    if noise.noise_law == "gaussian" or noise.a_dn == 0:  # a = 0: no shot noise
        return clean_dn + np.sqrt(noise_variance(clean_dn, plan)) * n
    electrons = counts(plan, (clean_dn - black_dn) / noise.a_dn, origin)
    return np.asarray((electrons * noise.a_dn + black_dn) + np.sqrt(noise.b_dn2) * n)
