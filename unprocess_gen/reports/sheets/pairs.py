"""Select the pairs of a dataset that sheets show, and load their frames and sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Plan, Row, Srgb
from unprocess_gen.dataset.keys import image_key
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.reports.sheets.panels import DetailWindow, Mosaic
from unprocess_gen.sources.patches import crop_patch

PAIRS_SHOWN = 8
"""Number of pairs shown if no keys are given."""


@dataclass(frozen=True, slots=True)
class SheetPair:
    """The frames, row and plan of a pair, and its source pixels or the reason why they are missing."""

    clean: Mosaic
    noisy: Mosaic
    row: Row
    plan: Plan
    source: Srgb | None
    missing_source: str

    @property
    def key(self) -> str:
        """The key of the row."""
        return str(self.row["key"])


def selected_pairs(folder: AnyPath, keys: Sequence[str], source: AnyPath | None) -> Iterator[SheetPair]:
    """Yield pairs in the order of the manifest; a photograph shared by adjacent pairs is decoded once."""
    from unprocess_gen.pipeline.replay import source_root  # imports Numba
    from unprocess_gen.reports.sheets.row_sources import load_row_source  # imports Numba

    if source is not None and not source.is_dir():
        raise ConfigError(f"--source {source}: is not a folder; expected the folder of the photographs")
    pairs = RawPairs(folder)
    manifest = folder / "manifest.csv"
    numbers = list(select_pairs(manifest, ",".join(keys)).rows) if keys else _spaced_numbers(folder, len(pairs))
    root = source_root(manifest, None if source is None else str(source))
    image, photograph, missing = "", None, ""
    for number in numbers:
        clean, noisy, row = pairs[number]
        if image != image_key(row):
            image, (photograph, missing) = image_key(row), load_row_source(row, root)
        patch, missing_patch = _patch_of(photograph, missing, row)
        yield SheetPair(mosaic_dn(clean, row), mosaic_dn(noisy, row), row, plan_from_row(row), patch, missing_patch)


def _patch_of(photograph: Srgb | None, missing: str, row: Row) -> tuple[Srgb | None, str]:
    """Return the part of a photograph that a row's frames show, or None and the reason."""
    if photograph is None:
        return None, missing
    patch = patch_from_row(row)
    part = crop_patch(photograph, patch)
    if part.shape[:2] != (patch.height, patch.width):
        return None, f"its {photograph.shape[1]} x {photograph.shape[0]} pixels do not contain the row's patch"
    return part, ""


def _spaced_numbers(folder: AnyPath, pairs: int) -> list[int]:
    if not pairs:
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    return evenly_spaced(range(pairs), PAIRS_SHOWN)


def sheet_heading(pair: SheetPair, window: DetailWindow) -> list[str]:
    """Return the lines above a sheet: identity and size, parameters, and the rows and columns of the details."""
    row, plan = pair.row, pair.plan
    height, width = pair.clean.shape
    exposure = f", exposure 1 / {plan.exposure_ratio:g}" if plan.exposure_ratio != 1 else ""
    return [
        f"{pair.key}   {row['source']}   {width} x {height} {plan.pattern}, {plan.bits} bits, black "
        f"{plan.black_level_dn}, white {plan.white_level_dn} DN",
        f"camera {plan.camera}, gains red {plan.red_gain:.4g}, blue {plan.blue_gain:.4g}, inverse rgb "
        f"{plan.inverse_rgb_gain:.4g}, highlights {plan.highlight}, tone {plan.tone}, gamma {plan.gamma}; "
        f"scene {plan.scene}{exposure}; noise {plan.noise}: a {plan.a_dn:.4g} DN, b {plan.b_dn2:.4g} DN squared, "
        f"effects {' '.join(plan.effects) or 'none'}",
        f"details below the frames: rows {window.rows.start} to {window.rows.stop - 1}, columns "
        f"{window.columns.start} to {window.columns.stop - 1}, one pixel per site",
    ]
