"""Score differences from what is expected: by a bound on their probability, whatever the distribution.

Derivations: ``docs/design/noise_check.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.core.arrays import Float

FALSE_ALARM = 1e-6
"""Probability of any alarm for a dataset, or for captures, whose noise is as expected."""
UNFORESEEN = 1e-8
"""Probability of a rare value, beyond that which is expected."""
NORMAL_95 = 1.96
"""Half the 95 % interval of a normal distribution, in standard errors."""


def alarm_limit(scores: int) -> float:
    """Surprise from which a score is an alarm, of a number of scores in both directions (Bonferroni)."""
    return math.log(2 * scores / FALSE_ALARM)


class Score(NamedTuple):
    """Sum of a statistic over the rows, columns or clean values of a pair; or a statistic of captures.

    ``total / information`` estimates the difference of a quantity from its expected value. ``variance`` is that of the
    sum due to noise, ``step`` the largest contribution of one site or line. The expectation of the sum is from ``low``
    to ``high``, because it depends on values that the row does not state.
    """

    total: float
    information: float
    variance: float
    step: float = 0.0
    low: float = 0.0
    high: float = 0.0

    @property
    def excess(self) -> float:
        """Distance of the sum from the expectations that are possible."""
        return self.total - min(max(self.total, self.low), self.high)

    @property
    def std(self) -> float:
        """Standard deviation of the sum."""
        return math.sqrt(self.variance)

    @property
    def errors(self) -> float:
        """Excess in standard errors, with its sign."""
        return self.excess / self.std if self.std else 0.0

    @property
    def surprise(self) -> float:
        """Negative logarithm of a bound on the probability of an excess as large in one direction.

        Bernstein's inequality: P(excess > √(2·std²·x) + step·x/3) ≤ exp(-x). The bound holds for few sites too, where
        sums are not normally distributed.
        """
        root, step, excess = math.sqrt(2) * self.std, self.step / 3, abs(self.excess)
        if not excess or not root:
            return 0.0
        return (2 * excess / (root + math.sqrt(root * root + 4 * step * excess))) ** 2


def influence(design: Float, precision: Any) -> Float:
    """The matrix that turns N observations into the K parameters of the least variance, [K, N].

    ``design`` is [K, N]; ``precision`` is the inverse of the covariance of the observations, or its diagonal.
    """
    weighted = design * precision if precision.ndim == 1 else design @ precision
    return np.asarray(np.linalg.inv(weighted @ design.T) @ weighted)
