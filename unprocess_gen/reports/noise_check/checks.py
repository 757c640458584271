"""Check the noise of a dataset: pair by pair, and with the scores of all pairs added.

An alarm is raised for a score that noise as recorded would reach with a probability below `FALSE_ALARM`, over all
checks, planes and pairs of the dataset together (Bonferroni).
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.types import DarkPixels, Frame, Plan, Row
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row, read_rows
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.reports.noise_check.law import NoiseLaw, is_supported
from unprocess_gen.reports.noise_check.scores import LEAST_SITES, Score, Scores, scores_of
from unprocess_gen.reports.noise_check.sums import Sums

FALSE_ALARM = 1e-6
"""Probability of any alarm for a dataset whose noise is as recorded."""

SHARED_ROUNDING = 0.15
"""Fraction of the rounding error that pairs with other curves or gains share, because most histograms decrease."""

CURVES = 4096
"""Groups of pairs whose rounding errors are added separately."""

LISTED = 20
"""Pairs with wrong noise that are listed."""


class Check(NamedTuple):
    """Describe a check.

    Attributes
    ----------
    rank : int
        Order in which failed checks are named: the most specific first, equal ranks by significance.
    unit : str
        Unit of the estimate.
    low, high : str
        Likely causes of a value that is too low and too high.
    column : str
        Manifest columns with the expected value.
    """

    rank: int
    unit: str
    low: str
    high: str
    column: str


_SWAPPED = "sites were swapped, or the frame has another CFA pattern"
_OFFSET = "another black level, or an offset of the plane"
_GAIN = "another exposure or gain of the noisy frame"
_SCALE = "the noise has other numbers than the row"
CHECKS = {
    "diagonal sites": Check(0, "of the difference of two sites", _SWAPPED, _SWAPPED, "pattern"),
    "horizontal sites": Check(0, "of the difference of two sites", _SWAPPED, _SWAPPED, "pattern"),
    "vertical sites": Check(0, "of the difference of two sites", _SWAPPED, _SWAPPED, "pattern"),
    "mean": Check(0, "DN", _OFFSET, _OFFSET, "black_level_dn"),
    "mean against signal": Check(0, "of the signal", _GAIN, _GAIN, "exposure_ratio"),
    "row means": Check(1, "DN²", "row noise is missing", "row noise is too strong", "row_std_dn"),
    "column means": Check(1, "DN²", "column offsets are missing", "stripes, or another fixed pattern", "column_std_dn"),
    "row differences": Check(1, "DN²", "row noise is missing", "row noise is too strong", "row_std_dn"),
    "column differences": Check(
        1, "DN²", "column offsets are missing", "stripes, or another fixed pattern", "column_std_dn"
    ),
    "variance": Check(2, "DN²", _SCALE, _SCALE, "b_dn2"),
    "variance against signal": Check(2, "DN", _SCALE, _SCALE, "a_dn"),
    "kurtosis": Check(
        2, "in the mean of cos 2z", "a distribution with lighter tails", "a distribution with heavier tails",
        "read_law",
    ),
    "horizontal neighbours": Check(3, "correlation", "sharpened frames", "smoothed frames, or row noise", "row_std_dn"),
    "vertical neighbours": Check(3, "correlation", "sharpened frames", "smoothed frames, or stripes", "column_std_dn"),
}  # fmt: skip
"""Checks by name."""

TESTS = len(CHECKS) + 8
"""Scores of one pair: those of the mean and of the variance against the signal have one for each plane too."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """A score that contradicts the manifest.

    Attributes
    ----------
    key : str
        Key of the pair; empty for all pairs together.
    check, plane : str
        Names of the check and of the plane; the plane is empty if all planes are summed.
    score : Score
        The score.
    others : int
        Other failed checks of the same pair.
    """

    key: str
    check: str
    plane: str
    score: Score
    others: int = 0

    def __str__(self) -> str:
        check, score = CHECKS[self.check], self.score
        estimate, error = score.total / score.information, 1.96 * score.std / score.information
        where = self.key or "all pairs together"
        name = f"{self.check} of plane {self.plane}" if self.plane else self.check
        others = f" ({self.others} other checks differ too)" if self.others > 1 else " (another check differs too)"
        cause = check.high if score.excess > 0 else check.low
        return (
            f"noise of {where}: {name}: {estimate:+.4g} ± {error:.2g} {check.unit} from what {check.column} records: "
            f"{score.errors:+.1f} standard errors; likely cause: {cause}{others if self.others else ''}"
        )


@dataclass(frozen=True, slots=True)
class NoiseChecks:
    """Result for a dataset.

    Attributes
    ----------
    count, unchecked : int
        Pairs that were checked, and pairs with too few usable sites or an unknown effect.
    alarms : list of Alarm
        All pairs together, with one failed check of each rank; then the first `LISTED` wrong pairs.
    wrong_pairs : int
        Number of wrong pairs.
    """

    count: int = 0
    unchecked: int = 0
    alarms: list[Alarm] = field(default_factory=list)
    wrong_pairs: int = 0


def pair_sums(clean: Frame, noisy: Frame, row: Row, dark_pixels: DarkPixels | None = None) -> Sums | None:
    """Sum the statistics of a pair.

    Parameters
    ----------
    clean, noisy : ndarray
        Frames in the dtype and layout of the dataset.
    row : Row
        Manifest row of the pair.
    dark_pixels : DarkPixels or None
        Access to the dark frames of the dataset, which pairs with dark frames need.

    Returns
    -------
    Sums or None
        None if the pair has too few usable sites, or noise that `law.is_supported` excludes.

    Raises
    ------
    DamageError
        If the row is not a plan.
    SourceChangedError
        If its dark frame is missing or has changed.
    """
    plan = plan_from_row(row)
    if not is_supported(plan, dark_pixels):
        return None
    with np.errstate(under="ignore"):
        law = NoiseLaw(plan, patch_from_row(row), dark_pixels)
        sums = Sums(law, mosaic_dn(clean, row), mosaic_dn(noisy, row))
        if sums.sites < LEAST_SITES:
            return None
        sums.fill()
    return sums


def pair_scores(sums: Sums) -> Scores:
    """Return the scores of a pair; `scores.scores_of` without floating-point warnings of tiny values."""
    with np.errstate(under="ignore"):
        return scores_of(sums)


def threshold(pairs: int) -> float:
    """Return the surprise from which a score is an alarm, in a dataset with a number of pairs."""
    return math.log(2 * TESTS * (pairs + 1) / FALSE_ALARM)


def failed_checks(key: str, scores: Scores, limit: float) -> list[Alarm]:
    """Return the failed checks of a pair.

    Parameters
    ----------
    key : str
        Key of the pair; empty for all pairs together.
    scores : Scores
        Its scores.
    limit : float
        `threshold`.

    Returns
    -------
    list of Alarm
        The most specific check first.
    """
    failed = [Alarm(key, *name, score) for name, score in scores.items() if score.surprise > limit]
    return sorted(failed, key=lambda alarm: (CHECKS[alarm.check].rank, -alarm.score.surprise))


class Checker:
    """Check the pairs of a dataset one after the other.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset.
    """

    def __init__(self, folder: AnyPath) -> None:
        self._overlaps = np.fromiter(overlaps(folder), dtype=np.float64)
        self._limit = threshold(len(self._overlaps))
        self._pooled: dict[tuple[str, str], PooledScore] = {}
        self._count = self._seen = self._wrong = 0
        self._alarms: list[Alarm] = []

    def add(self, row: Row, sums: Sums | None) -> None:
        """Check the next pair of the dataset; ``sums`` is the result of `pair_sums`."""
        overlap = self._overlaps[self._seen]
        self._seen += 1
        if sums is None:
            return
        self._count += 1
        scores = pair_scores(sums)
        for name, score in scores.items():
            self._pooled.setdefault(name, PooledScore()).add(score, float(overlap), curve_group(sums.law.plan))
        failed = failed_checks(str(row["key"]), scores, self._limit)
        self._wrong += bool(failed)
        if failed and self._wrong <= LISTED:
            self._alarms.append(replace(failed[0], others=len(failed) - 1))

    def result(self) -> NoiseChecks:
        """Return the result for the pairs that were added."""
        pooled = {name: score.score() for name, score in self._pooled.items()} if self._count > 1 else {}
        failed = failed_checks("", pooled, self._limit)
        # checks of one rank find the same faults
        ranks = {CHECKS[alarm.check].rank: alarm for alarm in reversed(failed)}
        first = [ranks[rank] for rank in sorted(ranks)]
        return NoiseChecks(self._count, self._seen - self._count, first + self._alarms, self._wrong)


class PooledScore:
    """Add the scores of one check over pairs.

    Noise of different pairs is independent, so variances add. Patterns of the body, and rounding errors of clean frames
    with the same curve and gains, may be equal, so their standard deviations add.
    """

    def __init__(self) -> None:
        self._sums = np.zeros(6)
        self._step = 0.0
        self._one_sided = False
        self._rounding: dict[int, float] = {}

    def add(self, score: Score, overlap: float, group: int) -> None:
        """Add the score of a pair.

        Parameters
        ----------
        score : Score
            The score.
        overlap : float
            Number of pairs whose noise may have values in common with this pair.
        group : int
            `curve_group` of the pair.
        """
        below = score.below if math.isfinite(score.below) else 0.0
        self._one_sided = not math.isfinite(score.below)
        self._sums += score.total, score.variance * overlap, score.fixed, score.above, below, score.information
        self._step = max(self._step, score.step * overlap)
        self._rounding[group] = self._rounding.get(group, 0.0) + score.rounding

    def score(self) -> Score:
        """Return the score of all pairs."""
        total, variance, fixed, above, below, information = self._sums.tolist()
        groups = list(self._rounding.values())
        rounding = math.hypot(*groups, SHARED_ROUNDING * sum(groups))
        below = math.inf if self._one_sided else below
        return Score(total, variance, rounding, fixed, self._step, above, below, information)


def curve_group(plan: Plan) -> int:
    """Return the number of the group of a plan; plans that map codes to the same clean values are in one group."""
    curve = plan.rgb2cam, plan.inverse_gains, plan.exposure_ratio, plan.tone, plan.gamma, plan.highlight
    return zlib.crc32(repr((curve, plan.black_level_dn, plan.white_level_dn)).encode()) % CURVES


def overlaps(folder: AnyPath) -> Iterator[int]:
    """Yield, for each pair of a dataset, how many pairs can have noise values in common with it, including itself.

    Patches of a frame share the noise of their common sites. With row or column noise they also share the offsets of
    common rows and columns.
    """
    rows = (row for row in read_rows(folder / "manifest.csv") if row["status"] == "ok")
    for _, group in itertools.groupby(rows, key=lambda row: (row["stream_key"], row["frame"])):
        yield from _overlaps_of(list(group))


def _overlaps_of(rows: Sequence[Row]) -> Iterator[int]:
    """Yield the overlaps of the patches of one frame, each at several levels and draws."""
    names = ("patch_y", "patch_x", "height", "width", "level", "draw")
    y, x, height, width, level, draw = np.array([[int(row[name] or 0) for name in names] for row in rows]).T
    for n, row in enumerate(rows):
        same = (level == level[n]) & (draw == draw[n])
        in_rows = (y < y[n] + height[n]) & (y[n] < y + height)
        in_columns = (x < x[n] + width[n]) & (x[n] < x + width)
        shared = in_rows & in_columns
        if "row" in str(row["effects"]).split(";"):
            reach = _row_reach(float(row.get("row_correlation") or 0.0))
            shared = (y < y[n] + height[n] + reach) & (y[n] < y + height + reach)
        yield int((same & shared).sum())


def _row_reach(correlation: float) -> int:
    """Return the distance of rows whose offsets have a correlation below 1 %."""
    return 0 if correlation == 0 else math.ceil(math.log(0.01) / math.log(abs(correlation)))
