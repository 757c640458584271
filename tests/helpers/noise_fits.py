"""Photon transfer fits of datasets."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen import RawPairs
from unprocess_gen.reports.photon_transfer import NoiseFit, fit_pair


def dataset_fits(folder: Path) -> list[NoiseFit]:
    """Fits of all pairs of a dataset that have one."""
    return [fit for pair in RawPairs(folder) if (fit := fit_pair(*pair)) is not None]
