"""Photon transfer fits of pairs and of datasets."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen import RawPairs
from unprocess_gen.core.types import Frame, Row
from unprocess_gen.reports.noise_check.checks import pair_sums
from unprocess_gen.reports.photon_transfer import NoiseFit, fit_sums


def fit_pair(clean: Frame, noisy: Frame, row: Row) -> NoiseFit | None:
    """Fit of a pair; None if it has too few sites or clean values."""
    sums = pair_sums(clean, noisy, row)
    return None if sums is None else fit_sums(str(row["key"]), sums)


def dataset_fits(folder: Path) -> list[NoiseFit]:
    """Fits of all pairs of a dataset that have one."""
    return [fit for clean, noisy, row in RawPairs(folder) if (fit := fit_pair(clean, noisy, row)) is not None]
