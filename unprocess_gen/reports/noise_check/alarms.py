"""Check the noise of a dataset: pair by pair, and with the scores of all pairs added.

An alarm is raised for a score that noise as recorded would reach with a probability below `FALSE_ALARM`, over all
checks, planes and pairs of the dataset together (Bonferroni).
"""

from __future__ import annotations

import math
import zlib
from collections import defaultdict
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from unprocess_gen.calibration.deviations import Score, alarm_limit
from unprocess_gen.dataset.reader import Sample
from unprocess_gen.reports.noise_check.pair_scores import Residual, Scores, scores_of
from unprocess_gen.reports.noise_check.repetition import Noise, measure_noise
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.plan import Plan

LEAST_SITES = 64
"""Fewest sites of a pair that is checked."""
GROUPS = 4096
"""Groups of pairs whose scores may depend on each other."""
PAIRS_LISTED = 20
"""Pairs with wrong noise that are listed."""
CHECKS_LISTED = 3
"""Failed checks that are listed for all pairs together: the first ones, which often cause the others."""


class Check(NamedTuple):
    """Text of a check: estimated quantity, its unit, and causes of a value too low and too high."""

    quantity: str
    unit: str
    low: str
    high: str


_LEVEL, _GAIN = "wrong black level or plane offset", "wrong exposure or gain, or other sites"
_WEAK, _STRONG = "weaker noise than recorded, or another distribution", "stronger noise, or another distribution"
_SHARP, _SMOOTH = "sharpened frames", "smoothed frames"
CHECKS = {
    "mean": Check("mean", "DN", _LEVEL, _LEVEL),
    "signal": Check("signal", "%", _GAIN, _GAIN),
    "order of sites": Check("correlation with the detail of the clean frame", "%", *2 * ("swapped or moved sites",)),
    "rows": Check("variance of row offsets", "DN²", "row noise is missing", "row noise is too strong"),
    "columns": Check("variance of column offsets", "DN²", "column offsets are missing", "column stripes"),
    "variance": Check("variance", "DN²", _WEAK, _STRONG),
    "gain": Check("variance per signal", "DN", "smaller gain", "larger gain"),
    "shape": Check("mean cosine of noise / std", "%", _STRONG, _WEAK),
    "adjacent sites": Check("correlation of adjacent sites", "%", _SHARP, _SMOOTH),
    "neighbours": Check("correlation of neighbours of a plane", "%", _SHARP, _SMOOTH),
    "repetition": Check("correlation with the pair before", "%", *2 * ("noise of another pair is repeated",)),
    "odd codes": Check("surplus of odd codes", "%", *2 * ("codes are missing",)),
    "hot pixels": Check("share of the body's hot pixels", "%", "missing hot pixels", "unknown defects"),
    "outliers": Check("share of outliers", "per million", "missing defects or weaker tails", "unknown defects"),
}
"""Checks by name; failed ones are listed in this order."""

TESTS = len(CHECKS) + 20
"""Scores of one pair: five checks have a score for each plane too."""


class Alarm(NamedTuple):
    """Score that contradicts the manifest; ``key`` is empty for all pairs together, ``plane`` for all planes."""

    key: str
    check: str
    plane: str
    score: Score

    def __str__(self) -> str:
        check, score = CHECKS[self.check], self.score
        size = (100 if check.unit == "%" else 1) * abs(score.total) / score.information
        side, cause = ("above", check.high) if score.excess > 0 else ("below", check.low)
        return (
            f"noise of {self.key or 'all pairs together'}: {check.quantity}{self.plane and f' of plane {self.plane}'} "
            f"is {size:.4g} {check.unit} {side} that of recorded noise "
            f"(probability below 1e-{score.surprise / math.log(10):.0f}): {cause}"
        )


def failed_checks(key: str, scores: Scores, limit: float) -> list[Alarm]:
    """One alarm for each check with a surprise above ``limit``, in the order of `CHECKS`."""
    surprising = sorted(scores.items(), key=lambda item: item[1].surprise)
    worst = {check: Alarm(key, check, plane, score) for (check, plane), score in surprising if score.surprise > limit}
    return [worst[check] for check in CHECKS if check in worst]


class Pool:
    """Sums of the scores of pairs.

    Variances add, but standard deviations do within groups: pairs with the same curve and gains have the same rounding
    errors of clean frames, and overlapping patches the same noise.
    """

    def __init__(self) -> None:
        self._totals: dict[tuple[str, str], Any] = defaultdict(lambda: np.zeros(4))
        self._std: dict[tuple[str, str], dict[int, float]] = defaultdict(lambda: defaultdict(float))

    def add(self, scores: Scores, plan: Plan) -> None:
        """Add the scores of a pair."""
        group = zlib.crc32(repr((plan.scene.exposure_ratio, plan.camera, plan.isp, plan.sensor)).encode()) % GROUPS
        for name, score in scores.items():
            self._totals[name] += score.total, score.information, score.low, score.high
            self._std[name][group] += score.std

    def scores(self) -> Scores:
        """Scores of all pairs together."""
        return {
            name: Score(total, information, sum(std * std for std in self._std[name].values()), low=low, high=high)
            for name, (total, information, low, high) in self._totals.items()
        }


class Checker:
    """Check the noise of a number of pairs, one after the other.

    ``count``, ``unchecked`` and ``wrong_pairs`` count pairs that were checked, that cannot be, and with wrong noise;
    ``pair_alarms`` has the first alarm of the first wrong pairs.
    """

    def __init__(self, pairs: int) -> None:
        self._limit = alarm_limit(TESTS * (pairs + 1))
        self._pool, self.pair_alarms = Pool(), list[Alarm]()
        self._before: tuple[tuple[object, ...], Residual] | None = None
        self.count = self.unchecked = self.wrong_pairs = 0

    def add(self, noise: Noise | None) -> None:
        """Check the next pair; one with few usable sites, or whose dark frame is not available, counts as unchecked."""
        if noise is None or np.count_nonzero(noise.weight) < LEAST_SITES:
            self.unchecked += 1
            return
        self.count += 1
        frame = noise.plan.stream_key, noise.plan.place
        before = self._before if self._before is not None and self._before[0] != frame else None
        scores, residual = scores_of(noise, before and before[1])  # patches of a frame share its noise
        self._before = frame, residual
        self._pool.add(scores, noise.plan)
        failed = failed_checks(noise.key, scores, self._limit)
        self.wrong_pairs += bool(failed)
        self.pair_alarms += failed[:1] if self.wrong_pairs <= PAIRS_LISTED else []

    @property
    def alarms(self) -> list[Alarm]:
        """First alarms of all pairs together, and of the first wrong pairs."""
        failed = failed_checks("", self._pool.scores(), self._limit) if self.count > 1 else []
        return [*failed[:CHECKS_LISTED], *self.pair_alarms]


def check_pairs(pairs: Iterable[Sample], count: int, dark_pixels: DarkPixels | None = None) -> Checker:
    """Check the noise of a number of pairs."""
    checker = Checker(count)
    for pair in pairs:
        checker.add(measure_noise(*pair, dark_pixels))
    return checker
