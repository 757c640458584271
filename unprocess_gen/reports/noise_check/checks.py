"""Check the noise of a dataset: pair by pair, and with the scores of all pairs added.

An alarm is raised for a score that noise as recorded would reach with a probability below `FALSE_ALARM`, over all
checks, planes and pairs of the dataset together (Bonferroni).
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.types import DarkPixels, Frame, Plan, Row
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row, read_rows
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.reports.noise_check.scores import LEAST_SITES, Scores, repetition_score, scores_of
from unprocess_gen.reports.noise_check.sums import SparseNoise, Sums
from unprocess_gen.simulation.effects import BY_NAME
from unprocess_gen.statistics.scores import NORMAL_95, Score, alarm_limit

SHARED_ROUNDING = 0.15
"""Fraction of the rounding error that pairs with other curves or gains share, because most histograms decrease."""
CURVE_NUMBERS = 4096
"""Groups of pairs whose rounding errors are added separately."""
PAIRS_LISTED = 20
"""Pairs with wrong noise that are listed."""


class Check(NamedTuple):
    """Text of a check: estimated quantity, unit, what it is compared with, causes of a value too low and too high.

    Failed checks are named by ``rank``, equal ranks by significance.
    """

    rank: int
    quantity: str
    unit: str
    expected: str
    low: str
    high: str


_OFFSET, _GAIN = "wrong black level or plane offset", "wrong exposure or gain, or swapped sites"
_WEAK, _STRONG = "weaker noise than recorded, or another distribution", "stronger noise, or another distribution"
_ROWS, _COLUMNS = ("row noise is missing", "row noise is too strong"), ("column offsets are missing", "column stripes")
_CORRELATED, _CODES = ("0", "sharpened frames", "smoothed frames"), "codes are missing"
CHECKS = {
    "mean": Check(0, "mean", "DN", "black_level_dn", _OFFSET, _OFFSET),
    "mean against signal": Check(0, "signal", "%", "that of the clean frame", _GAIN, _GAIN),
    "row means": Check(1, "variance of row offsets", "DN²", "row_std_dn²", *_ROWS),
    "row differences": Check(1, "variance of differences of rows", "DN²", "that by row_std_dn", *_ROWS),
    "column means": Check(1, "variance of column offsets", "DN²", "the recorded one", *_COLUMNS),
    "column differences": Check(1, "variance of differences of columns", "DN²", "the recorded one", *_COLUMNS),
    "variance": Check(2, "variance", "DN²", "the recorded one", _WEAK, _STRONG),
    "variance against signal": Check(2, "variance per signal", "DN", "a_dn", "smaller gain", "larger gain"),
    "adjacent sites": Check(3, "correlation of adjacent sites", "%", *_CORRELATED),
    "diagonal sites": Check(3, "correlation of diagonal sites", "%", *_CORRELATED),
    "neighbours": Check(3, "correlation of neighbours of a plane", "%", *_CORRELATED),
    "diagonal neighbours": Check(3, "correlation of diagonal neighbours of a plane", "%", *_CORRELATED),
    "repetition": Check(4, "correlation with the pair before", "%", "0", *2 * ("noise of another pair is repeated",)),
    "odd codes": Check(5, "surplus of odd codes", "%", "0", *2 * (_CODES,)),
    "pairs of codes": Check(5, "surplus of codes with the second lowest bit", "%", "0", *2 * (_CODES,)),
    "outliers": Check(6, "share of outliers", "per million", "the expected one", "weaker tails", "unknown defects"),
    "defects": Check(7, "share of hot and dead pixels", "%", "the recorded one", "defects are missing", "a bug"),
}
"""Checks by name."""

TESTS = len(CHECKS) + 8
"""Scores of one pair: the mean and the variance against the signal have a score for each plane too."""


class Alarm(NamedTuple):
    """Score that contradicts the manifest; ``key`` is empty for all pairs together, ``plane`` for all planes."""

    key: str
    check: str
    plane: str
    score: Score

    def __str__(self) -> str:
        check, score = CHECKS[self.check], self.score
        scale = (100 if check.unit == "%" else 1) / score.information
        size, error = (scale * value for value in (abs(score.total), NORMAL_95 * score.std))
        decimals = max(0, -math.floor(math.log10(error)))
        side, cause = ("above", check.high) if score.excess > 0 else ("below", check.low)
        return (
            f"noise of {self.key or 'all pairs together'}: {check.quantity}{self.plane and f' of plane {self.plane}'} "
            f"is {size:,.{decimals}f} ± {error:,.{decimals}f} {check.unit} {side} {check.expected} "
            f"({abs(score.errors):,.0f} standard errors): {cause}"
        )


@np.errstate(under="ignore")
def pair_sums(clean: Frame, noisy: Frame, row: Row, dark_pixels: DarkPixels | None = None) -> Sums | None:
    """Sum the statistics of a pair with its manifest row.

    None if the pair has too few usable sites, an unknown effect, or a dark frame without access to its pixels.
    """
    plan = plan_from_row(row)
    if not BY_NAME.keys() >= set(plan.noise.effects) or (plan.noise.dark.sha256 and dark_pixels is None):
        return None
    sums = Sums(plan, patch_from_row(row), mosaic_dn(clean, row), mosaic_dn(noisy, row), dark_pixels)
    if sums.sites < LEAST_SITES:
        return None
    sums.fill()
    return sums


def threshold(pairs: int) -> float:
    """Surprise from which a score is an alarm, in a dataset with a number of pairs."""
    return alarm_limit(TESTS * (pairs + 1))


def failed_checks(key: str, scores: Scores, limit: float) -> list[Alarm]:
    """Scores with a surprise above ``limit``, the check that explains most first."""
    failed = [Alarm(key, *name, score) for name, score in scores.items() if score.surprise > limit]
    return sorted(failed, key=lambda alarm: (CHECKS[alarm.check].rank, -alarm.score.surprise))


class Checker:
    """Check the pairs of a dataset, one after the other.

    Attributes
    ----------
    count, unchecked, wrong_pairs : int
        Pairs that were checked, those that cannot be, and those with wrong noise.
    pair_alarms : list of Alarm
        Alarms of the first pairs with wrong noise.
    """

    def __init__(self, overlaps: NDArray[np.int64]) -> None:
        self._overlaps = overlaps
        self._limit = threshold(len(overlaps))
        self._pool, self.pair_alarms = Pool(), list[Alarm]()
        self._before: tuple[list[Any], SparseNoise] | None = None
        self.count = self.unchecked = self.wrong_pairs = 0

    def add(self, row: Row, sums: Sums | None) -> None:
        """Check the next pair of the dataset; ``sums`` is the result of `pair_sums`."""
        in_sites, in_rows = self._overlaps[self.count + self.unchecked].tolist()
        if sums is None:
            self.unchecked += 1
            return
        self.count += 1
        scores, frame = scores_of(sums), [row[name] for name in ("stream_key", "frame", "level", "draw")]
        if self._before is not None and self._before[0] != frame:  # patches of a frame share its noise
            scores["repetition", ""] = repetition_score(sums.sample, self._before[1])
        self._before = frame, sums.sample
        self._pool.add(scores, in_rows if sums.planes[0].noise.row_variance else in_sites, curve_group(sums.plan))
        failed = failed_checks(str(row["key"]), scores, self._limit)
        self.wrong_pairs += bool(failed)
        self.pair_alarms += failed[:1] if self.wrong_pairs <= PAIRS_LISTED else []

    @property
    def alarms(self) -> list[Alarm]:
        """Alarm of each rank for all pairs together, because one rank finds the same faults, and of the first pairs."""
        failed = failed_checks("", self._pool.scores(), self._limit) if self.count > 1 else []
        ranks = itertools.groupby(failed, key=lambda alarm: CHECKS[alarm.check].rank)
        return [*(next(alarms) for _, alarms in ranks), *self.pair_alarms]


class Pool:
    """Sums of the scores of pairs.

    Noise of different pairs is independent, so variances add. Patterns of the body, and rounding errors of clean frames
    with the same curve and gains, may be equal, so their standard deviations add.
    """

    def __init__(self) -> None:
        self._sums: Scores = {}
        self._rounding: defaultdict[tuple[str, str], defaultdict[int, float]] = defaultdict(lambda: defaultdict(float))

    def add(self, scores: Scores, overlap: float, group: int) -> None:
        """Add a pair that has noise in common with ``overlap`` pairs, itself included; ``group``: `curve_group`."""
        for name, score in scores.items():
            score = score._replace(variance=score.variance * overlap, step=score.step * overlap)
            before = self._sums.get(name, Score(0.0, 0.0, 0.0))
            total = Score(*map(sum, zip(before, score, strict=True)))
            self._sums[name] = total._replace(step=max(before.step, score.step))
            self._rounding[name][group] += score.rounding

    def scores(self) -> Scores:
        """Scores of all pairs together."""
        return {
            name: score._replace(rounding=math.hypot(SHARED_ROUNDING * score.rounding, *self._rounding[name].values()))
            for name, score in self._sums.items()
        }


def curve_group(plan: Plan) -> int:
    """Group of plans that map codes to the same clean values."""
    curve = plan.scene.exposure_ratio, plan.camera, plan.isp, plan.sensor
    return zlib.crc32(repr(curve).encode()) % CURVE_NUMBERS


def overlaps(folder: AnyPath) -> Iterator[tuple[int, int]]:
    """Yield, for each pair of a dataset, how many pairs have common sites with it, and common rows, including itself.

    Patches of a frame share the noise of their common sites, and the offsets of their common rows.
    """
    rows = (row for row in read_rows(folder / "manifest.csv") if row["status"] == "ok")
    names = ("patch_y", "patch_x", "height", "width", "level", "draw")
    for _, group in itertools.groupby(rows, key=lambda row: (row["stream_key"], row["frame"])):
        patches = list(group)
        y, x, height, width, level, draw = np.array([[int(row[name] or 0) for name in names] for row in patches]).T
        for n, row in enumerate(patches):
            same = (level == level[n]) & (draw == draw[n])
            gaps = np.maximum(y - y[n] - height[n], y[n] - y - height)
            in_columns = (x < x[n] + width[n]) & (x[n] < x + width)
            reach = _row_reach(float(row.get("row_correlation") or 0.0))
            yield int((same & (gaps < 0) & in_columns).sum()), int((same & (gaps < reach)).sum())


def _row_reach(correlation: float) -> int:
    """Distance of rows whose offsets have a correlation below 1 %."""
    return 0 if correlation == 0 else math.ceil(math.log(0.01) / math.log(abs(correlation)))
