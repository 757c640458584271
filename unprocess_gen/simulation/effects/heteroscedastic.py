"""Noise of a two-parameter profile: shot and read noise with a variance linear in the signal.

Foi et al. 2008 and the article, section 2; in Poisson form CRVD (Yue et al. 2020).
"""

from __future__ import annotations

from unprocess_gen.core.random_streams import declare_stream
from unprocess_gen.simulation.effects.effect import Effect

STREAM = declare_stream("heteroscedastic", 1)


class Heteroscedastic(Effect):
    """Noise with the variance max(0, a·u + b), u = max(0, x - black); the only effect of a two-parameter profile.

    For ``law="gaussian"``, it is one normal deviate of this variance. For ``"poisson"``, it is a times a Poisson count
    of mean (x - black) / a, plus a normal deviate of variance b.
    """

    name = "heteroscedastic"
    meaning = "noise of a two-parameter profile, its only effect"
