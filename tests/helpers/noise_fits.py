"""Photon transfer fits of pairs and datasets."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen import RawPairs
from unprocess_gen.core.arrays import Frame
from unprocess_gen.dataset.columns import Row
from unprocess_gen.reports.noise_check.repetition import measure_noise
from unprocess_gen.reports.photon_transfer import NoiseFit, fit_noise


def fit_pair(clean: Frame, noisy: Frame, row: Row) -> NoiseFit | None:
    """The fit of a pair."""
    return fit_noise(measure_noise(clean, noisy, row))


def dataset_fits(folder: Path) -> list[NoiseFit]:
    """Fits of all pairs of a dataset that have one."""
    return [fit for pair in RawPairs(folder) if (fit := fit_pair(*pair)) is not None]
