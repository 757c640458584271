"""State in words what a tier saves in a complete run and what it costs, and recommend a tier for each use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from unprocess_gen.config.schema import AccuracyConfig
from unprocess_gen.reports.benchmark.complete_runs import RunFiles, RunMeasurement
from unprocess_gen.reports.benchmark.session import EXACT, GIVEN, REFERENCE
from unprocess_gen.reports.formatting import counted, percentage, short_number

FAST = "fast"

RATIO_DIGITS = 3
"""Significant digits of ratios and shares of time, in tables and in the conclusion."""


class Recommendation(NamedTuple):
    """A use of datasets, the tier recommended for it, and the reason."""

    use: str
    tier: str
    reason: str


RECOMMENDATIONS = (
    Recommendation(
        "training data",
        EXACT,
        "fast shortens only the simulation; use it if the simulation takes most of the time (noise.levels, "
        "noise.draws, pairs made from arrays) and the table of runs shows that fast saves time",
    ),
    Recommendation(
        "benchmark whose files are published",
        EXACT,
        "every DN is that of the reference, so the data do not depend on approximations of this package",
    ),
    Recommendation(
        "proof, or comparison with the article",
        REFERENCE,
        "NumPy code that can be read and checked; it gives the DN of exact",
    ),
    Recommendation(
        "quick look", FAST, "its errors cannot be seen in pictures; with physical noise it takes about as long as exact"
    ),
)


def conclude(
    runs: Sequence[RunMeasurement], given: AccuracyConfig, tiers: Mapping[str, AccuracyConfig], files: RunFiles
) -> str:
    """Return one sentence about the runs with the given settings.

    It compares the given tier with ``exact``, or ``fast`` if ``exact`` is given.

    Parameters
    ----------
    runs : sequence of RunMeasurement
        Every complete run.
    given : AccuracyConfig
        The budget of the config.
    tiers : mapping of str to AccuracyConfig
        The tiers by name.
    files : RunFiles
        The photographs of the runs.

    Returns
    -------
    str
        A sentence whose numbers are formatted as in the table of runs.
    """
    name = next((name for name, tier in tiers.items() if tier == given), f"{given.name}_changed")
    compared = FAST if name == EXACT else name
    run = next((run for run in runs if (run.setting, run.tier) == (GIVEN, compared)), None)
    if run is None:
        return f"No tier other than `{EXACT}` was measured."
    photographs = f"{counted(files.count, 'photograph')} ({files.pixels / 1e6:.1f} megapixels, noise={run.noise})"
    return f"In a complete run of {photographs}, `{run.tier}` {time_clause(run)} and {error_clause(run)}."


def time_clause(run: RunMeasurement) -> str:
    """Return what a tier saves: a verb and its object.

    A difference counts only if both quartiles of the ratios within rounds agree with it.
    """
    if run.ratio_to_exact is None or run.lower_quartile_ratio is None or run.upper_quartile_ratio is None:
        return "was too slow to be timed"
    ratio = short_number(run.ratio_to_exact, RATIO_DIGITS)
    ratios = (run.ratio_to_exact, run.lower_quartile_ratio, run.upper_quartile_ratio)
    if min(ratios) <= 1 <= max(ratios) or ratio == "1":
        return f"takes about as long as `{EXACT}` (ratio {ratio}, no clear difference)"
    if run.ratio_to_exact < 1:
        return f"takes {ratio} of the processor time of `{EXACT}`"
    return f"takes {ratio} times the processor time of `{EXACT}`"


def error_clause(run: RunMeasurement) -> str:
    """Return what a tier costs: a verb and its object."""
    if run.noisy_changed_share == 0:
        return "changes no noisy DN of the reference"
    largest = (
        f"{short_number(run.noisy_max_dn)} DN or {short_number(run.noisy_max_std)} standard deviations of the noise"
    )
    rms = f"RMS {short_number(run.noisy_rms_dn)} DN, {short_number(run.noisy_rms_std)} standard deviations"
    return f"moves {percentage(run.noisy_changed_share)} of the noisy DN, by at most {largest} ({rms})"
