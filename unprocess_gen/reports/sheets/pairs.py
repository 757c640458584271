"""Select the pairs of a dataset that sheets show, and load their frames and sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Plan, Row, Srgb
from unprocess_gen.dataset.keys import image_key
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.pipeline.replay import ADVICE, NO_LIMIT, source_of, source_root
from unprocess_gen.reports.sheets.panels import Mosaic, Window
from unprocess_gen.sources.loader import load_source
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
    if source is not None and not source.is_dir():
        raise ConfigError(f"--source {source}: is not a folder; expected the folder of the photographs")
    pairs, manifest = RawPairs(folder), folder / "manifest.csv"
    if not len(pairs):
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    spaced = evenly_spaced(range(len(pairs)), PAIRS_SHOWN)
    root = source_root(manifest, None if source is None else str(source))
    image, photograph, missing = "", None, ""
    for number in select_pairs(manifest, ",".join(keys)).rows if keys else spaced:
        clean, noisy, row = pairs[number]
        if image != image_key(row):
            image, (photograph, missing) = image_key(row), _load_source(row, root)
        part, missing_part = _crop_source(photograph, missing, row)
        yield SheetPair(mosaic_dn(clean, row), mosaic_dn(noisy, row), row, plan_from_row(row), part, missing_part)


def _load_source(row: Row, root: str | None) -> tuple[Srgb | None, str]:
    """Return the complete source image of a row, or None and the reason why it is not available."""
    is_scene = row["source_bytes"] == 0
    if root is None and not is_scene:
        return None, "the dataset does not record where its photographs are; give --source ROOT"
    config = SourceConfig(root=None if is_scene else root, max_pixels=NO_LIMIT, downscale=int(row["downscale"] or 1))
    try:
        sha256, photograph = load_source(config, source_of(row))
    except (SourceError, MachineError, ConfigError) as error:  # the sheet is drawn without this photograph
        return None, f"{str(error).partition(';')[0]}; {ADVICE}"
    if sha256 != row["source_sha256"]:
        return None, f"it has changed: its SHA-256 differs from the row's; {ADVICE}"
    return photograph.srgb, ""


def _crop_source(photograph: Srgb | None, missing: str, row: Row) -> tuple[Srgb | None, str]:
    """Return the part of a photograph that a row's frames show, or None and the reason."""
    if photograph is None:
        return None, missing
    patch = patch_from_row(row)
    part = crop_patch(photograph, patch)
    if part.shape[:2] != (patch.height, patch.width):
        return None, f"its {photograph.shape[1]} x {photograph.shape[0]} pixels do not contain the row's patch"
    return part, ""


def sheet_heading(pair: SheetPair, window: Window) -> list[str]:
    """Return the lines above a sheet: identity and size, parameters, and the place of the details."""
    row, sensor, camera, isp = pair.row, pair.plan.sensor, pair.plan.camera, pair.plan.isp
    scene, noise, (rows, columns) = pair.plan.scene, pair.plan.noise, window
    height, width = pair.clean.shape
    darkened = f", darkened by a factor of {scene.exposure_ratio:.4g}" if scene.exposure_ratio != 1 else ""
    return [
        f"{pair.key}   {row['source']}   {width} x {height} {sensor.pattern}, {sensor.bits} bits, black "
        f"{sensor.black_level_dn}, white {sensor.white_level_dn} DN",
        f"camera {camera.name}, gains red {camera.red_gain:.4g}, blue {camera.blue_gain:.4g}, inverse rgb "
        f"{camera.inverse_rgb_gain:.4g}, highlights {camera.highlight}, tone {isp.tone}, gamma {isp.gamma}; "
        f"scene {scene.name}{darkened}; noise {noise.name}: a {noise.a_dn:.4g} DN, b {noise.b_dn2:.4g} DN squared, "
        f"effects {' '.join(noise.effects) or 'none'}",
        f"details: rows {rows.start} to {rows.stop - 1}, columns {columns.start} to {columns.stop - 1}, one pixel per "
        "site",
    ]
