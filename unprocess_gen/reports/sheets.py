"""Draw sheets of a dataset's pairs: PNG files of each pair, or an overview with one strip per pair.

Each panel shows the complete frame, averaged, and a detail at one pixel per site; raw frames from the black to the
white level of the scene, square root. The panel of a source is empty, with the reason, if the photograph is not
available or has changed. A sheet of stages shows the photograph after each step of unprocessing (Figure 1 of the
article).

Each PNG file names the digest of its manifest: sheets of two datasets in a folder would replace each other.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.arrays import Float, Srgb, last_code
from unprocess_gen.core.errors import ConfigError, DamageError, SourceChangedError
from unprocess_gen.core.files import file_sha256, write_file
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import recorded_places
from unprocess_gen.dataset.flow import flow
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.row import patch_from_row, plan_from_row
from unprocess_gen.dataset.selection import select_pairs
from unprocess_gen.dataset.training import to_light
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.pipeline.replay import source_of
from unprocess_gen.reports import panels
from unprocess_gen.reports.panels import MosaicArray, SheetPanel, Window
from unprocess_gen.reports.pictures import picture_png
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import CODE_RANGE, Plan
from unprocess_gen.simulation.profiles import light_tables
from unprocess_gen.simulation.reference import isp as display
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.primaries import light_colours
from unprocess_gen.sources.patches import crop_patch
from unprocess_gen.sources.recorded_photographs import RecordedPhotographs

PAIRS_SHOWN = 8
"""Number of pairs shown if no keys are given."""
RMS_SHOWN = 4.0
"""Differences that are drawn black and white, in units of their RMS."""
MARK = "unprocess_gen"
"""Keyword of the text in a sheet that names its dataset."""


class SheetPair(NamedTuple):
    """The frames, row and plan of a pair, and its source pixels or the reason why they are missing.

    ``base`` has the clean frame and row of the first frame of a burst; it is None for that frame and other pairs.
    """

    clean: MosaicArray
    noisy: MosaicArray
    row: Row
    plan: Plan
    source: Srgb | None
    missing_source: str
    base: tuple[MosaicArray, Row] | None = None


class SheetFiles(NamedTuple):
    """The files written for a pair; ``missing_source`` is the reason why source panels are omitted, or empty."""

    key: str
    source: str
    files: tuple[Path, ...]
    missing_source: str


def selected_pairs(folder: AnyPath, keys: str, source: AnyPath | None) -> Iterator[SheetPair]:
    """Yield the pairs of ``--keys``, by default `PAIRS_SHOWN`, with sources from ``source`` or the recorded folder."""
    if source is not None and not source.exists():
        raise ConfigError(f"source.root={source}: does not exist; expected the photographs of the dataset")
    pairs, manifest = RawPairs(folder), folder / "manifest.csv"
    if not len(pairs):
        raise ConfigError(f"{folder}: every source failed; expected a dataset with at least one pair")
    sources = RecordedPhotographs(recorded_places(folder, None if source is None else str(source)).root)
    for number in select_pairs(manifest, keys).rows if keys else evenly_spaced(range(len(pairs)), PAIRS_SHOWN):
        clean, noisy, row = pairs[number]
        plan, part, missing = plan_from_row(row), None, ""
        try:
            photograph = sources.load(source_of(row), str(row["source_sha256"]), plan.source)
            part = crop_patch(photograph.srgb, _part_of_source(row, plan))
            plan = plan.decoded(photograph.profile, photograph.pixels_xxh3)
        except (SourceChangedError, DamageError, ConfigError) as error:  # the sheet is drawn without this photograph
            missing = str(error)
        base = None
        if plan.motion is not None and plan.place.frame:
            first = pairs[re.sub(r"-f\d\d", "-f00", str(row["key"]))]
            base = mosaic_dn(first.clean, first.row), first.row
        yield SheetPair(mosaic_dn(clean, row), mosaic_dn(noisy, row), row, plan, part, missing, base)


def _part_of_source(row: Row, plan: Plan) -> Patch:
    """Part of a source that a pair shows; for a burst, its target."""
    patch, step = patch_from_row(row), plan.pixel_side
    return Patch(patch.width * step, patch.height * step, patch.patch, patch.patch_y * step, patch.patch_x * step)


# ------------------------------------------------------------------------------------------------------------- sheets


def write_sheets(
    folder: AnyPath, to: Path, keys: str = "", source: AnyPath | None = None, with_stages: bool = False
) -> Iterator[SheetFiles]:
    """Write ``KEY.png`` for each pair, and ``KEY.stages.png`` if asked for; yield the files once they are written."""
    check_output_folder(to, f"--to {to}")
    mark = f"manifest_sha256={file_sha256(folder / 'manifest.csv')}"
    for path in sorted(to.glob("[0-9]" * 8 + "*.png")):
        if f"tEXt{MARK}\0{mark}".encode() not in path.read_bytes():
            raise ConfigError(
                f"--to {to}: {path.name} is not a sheet of {folder}; expected a folder without sheets of other "
                "datasets; choose another folder, or remove them"
            )
    for pair in selected_pairs(folder, keys, source):
        key, window = str(pair.row["key"]), panels.detail_window(pair.clean.shape)
        heading = _heading(pair, window)
        drawn = {f"{key}.png": panels.lay_out(heading, _pair_panels(pair, window, panels.PANEL_PX), 3)}
        if with_stages and pair.source is not None:
            drawn[f"{key}.stages.png"] = panels.lay_out(heading, _stage_panels(pair, pair.source, window), 4)
        for name, sheet in drawn.items():
            write_file(to / name, picture_png(sheet, **{MARK: mark}))
        yield SheetFiles(key, str(pair.row["source"]), tuple(to / name for name in drawn), pair.missing_source)


def overview(folder: AnyPath, keys: str = "", source: AnyPath | None = None) -> Iterator[tuple[str, list[SheetPanel]]]:
    """Yield heading and panels without details of each pair, for a page; arguments of `selected_pairs`."""
    for pair in with_bar(selected_pairs(folder, keys, source), "pair drawn"):
        drawn = _pair_panels(pair, panels.detail_window(pair.clean.shape), panels.PANEL_PX)
        complete = [panel._replace(detail=None, note=panel.note.partition(", detail")[0]) for panel in drawn]
        yield f"{pair.row['key']} {pair.row['source']}", complete


def _heading(pair: SheetPair, window: Window) -> list[str]:
    """The lines above a sheet: identity and size, noise, and the place of the details."""
    sensor, scene, noise, (rows, columns) = pair.plan.sensor, pair.plan.scene, pair.plan.noise, window
    height, width = pair.clean.shape
    stops = f", ev {scene.ev:g}" if scene.ev else ""
    return [
        f"{pair.row['key']}   {pair.row['source']}   {width} x {height} {sensor.pattern}, {sensor.bits} bits, black "
        f"{sensor.black_level_dn}, white {sensor.white_level_dn} DN",
        f"camera {pair.plan.camera.camera}, scene {scene.scene} (exposure ratio {scene.exposure_ratio:.4g}{stops}), "
        f"noise {noise.noise}: {' '.join(noise.effects) or 'no effect'}",
        f"details: rows {rows.start} to {rows.stop - 1}, columns {columns.start} to {columns.stop - 1}",
    ]


def _pair_panels(pair: SheetPair, window: Window, panel_px: tuple[int, int]) -> list[SheetPanel]:
    """Panels of the source, of both frames raw and developed, and of their difference."""
    reason = re.sub(r"([0-9a-f]{8})[0-9a-f]{56}", r"\1...", pair.missing_source)  # of a SHA-256, the beginning
    plan, drawn = pair.plan, [SheetPanel("source", f"not available: {reason}", None)]
    if pair.source is not None:
        views = (_shown(view, plan) for view in _views(pair, pair.source, window, panel_px))
        drawn = [SheetPanel("source", f"{8 * pair.source.itemsize} bits", *views)]
    white_dn = plan.sensor.black_level_dn + plan.sensor.span_dn / plan.scene.exposure_ratio
    levels = f"{plan.sensor.black_level_dn} to {white_dn:.5g} DN, square root"
    averages = [panels.average_planes(raw, panel_px) for raw in (pair.clean, pair.noisy)]
    for name, raw, planes in zip(("clean", "noisy"), (pair.clean, pair.noisy), averages, strict=True):
        light = (panels.common_stretch(dn, plan) for dn in (planes.mean(axis=-1), raw[window]))
        developed = panels.develop_planes(planes, plan), panels.develop_detail(raw, plan, window)
        drawn += [SheetPanel(f"{name} raw", levels, *light), SheetPanel(f"{name}, developed", "", *developed)]
    detail = pair.noisy[window].astype(np.float64) - pair.clean[window]
    differences = (averages[1] - averages[0]).mean(axis=-1), detail
    limits = [max(RMS_SHOWN * float(np.sqrt(np.mean(dn * dn))), 1.0) for dn in differences]
    note = f"+-{limits[0]:.3g} DN, detail +-{limits[1]:.3g} DN"
    pictures = ((dn / limit + 1) / 2 for dn, limit in zip(differences, limits, strict=True))
    drawn.append(SheetPanel("noisy - clean", note, *pictures))
    return drawn if pair.base is None else [*drawn, *_motion_panels(pair, pair.base, window, panel_px)]


def _motion_panels(
    pair: SheetPair, base: tuple[MosaicArray, Row], window: Window, panel_px: tuple[int, int]
) -> list[SheetPanel]:
    """Panels of the first frame of a burst, and of the difference of a frame from it before and after alignment."""
    clean, row = base
    number = int(pair.row["frame"] or 0)
    start, moved = (
        panels.grey_tiles(to_light(dn, row)) / np.float32(plan_from_row(row).scene.exposure)
        for dn, row in ((clean, row), (pair.clean, pair.row))
    )
    aligned = panels.moved(moved, flow_between_tiles([row, pair.row], number))
    limit = max(RMS_SHOWN * float(np.sqrt(np.mean(np.square(moved - start)))), 1e-6)
    before, after = (np.nan_to_num(frame - start) / limit / 2 + 0.5 for frame in (moved, aligned))
    note = f"frame {number} - frame 0, +-{limit:.3g} of white, exposure undone"
    shown = (
        ("frame 0, clean", "square root", np.sqrt(np.clip(start, 0, 1))),
        ("difference", note, before),
        ("difference, aligned by flow", note, after),
    )
    rows, columns = (slice(part.start // 2, part.stop // 2) for part in window)
    return [
        SheetPanel(title, text, panels.fit_image(picture, panel_px), picture[rows, columns].repeat(2, 0).repeat(2, 1))
        for title, text, picture in shown
    ]


def flow_between_tiles(rows: Sequence[Row], frame: int) -> Float:
    """Flow from frame 0 of a burst at the centres of the 2 x 2 tiles, in tiles."""
    sites = flow(rows, frame)
    height, width = (side // 2 * 2 for side in sites.shape[1:])
    tiles = sites[:, :height, :width].reshape(2, height // 2, 2, width // 2, 2)
    return np.asarray(tiles.mean(axis=(2, 4)) / 2, dtype=np.float32)


def _views(pair: SheetPair, source: Srgb, window: Window, panel_px: tuple[int, int]) -> tuple[Float, Float]:
    """The source scaled to a panel, and its detail, in [0, 1]; light of a linear source may be beyond."""
    white = 1.0 if source.dtype.kind == "f" else float(last_code(source))
    rows, columns = (slice(part.start * pair.plan.pixel_side, part.stop * pair.plan.pixel_side) for part in window)
    detail = panels.fit_image(
        source[rows, columns], (window[0].stop - window[0].start, window[1].stop - window[1].start)
    )
    return panels.fit_image(source, panel_px) / white, detail / white


def _shown(values: Float, plan: Plan) -> Float:
    """Display-referred values of a source, in [0, 1]."""
    return display.compress_gamma(np.clip(values, 0, 1), plan.isp.gamma) if plan.source.is_linear else values


# -------------------------------------------------------------------------------------------------------------- stages


def _stage_panels(pair: SheetPair, source: Srgb, window: Window) -> list[SheetPanel]:
    """Panels of the source after each step, black 0 and white 1, and of the frames in the colours of their filters."""
    plan, pattern, views = pair.plan, pair.plan.sensor.pattern, _views(pair, source, window, panels.PANEL_PX)
    steps = zip(*(processing_steps(view, plan) for view in views), strict=True)
    drawn = [SheetPanel("source", "", *(_shown(view, plan) for view in views))]
    drawn += [SheetPanel(title, note, overview, detail) for (title, note, overview), (*_, detail) in steps]
    for name, raw in (("clean", pair.clean), ("noisy", pair.noisy)):
        averaged = panels.planes_to_rgb(panels.average_planes(raw, panels.PANEL_PX), pattern)
        light, sites = (panels.common_stretch(dn, plan) for dn in (averaged, raw[window]))
        drawn.append(SheetPanel(f"{name} raw", f"{pattern}, square root", light, panels.colour_sites(sites, pattern)))
    return drawn


def processing_steps(values: Float, plan: Plan) -> Iterator[tuple[str, str, Float]]:
    """Yield title, note and result of the steps of the article's Figure 1 before the mosaic, ``[H, W, 3]``."""
    isp, camera = plan.isp, plan.camera
    if plan.source.is_raw:
        (black, *_), (white, *_) = plan.source.code_levels
        yield "levels", "black 0, white 1", (values * CODE_RANGE - black) / (white - black)
        return
    matrix, inverse_gains = light_colours(plan.source, camera)
    profile = plan.source.profile
    if plan.source.is_linear:
        values = values * plan.scene.exposure
        yield "exposed", f"ev {plan.scene.ev:g}, exposure ratio {plan.scene.exposure_ratio:g}", values
        values = unprocess.apply_ccm(values, matrix)
        yield "colour matrix inverted", f"camera {camera.camera}, primaries {plan.source.primaries}", values
        yield "gains inverted", f"times {_gain_text(inverse_gains)}", values * inverse_gains
        return
    if profile.is_srgb:
        values = unprocess.INVERSE_TONES[isp.tone](values, 1 - values)
        yield "tone curve inverted", isp.tone, values
        values = unprocess.expand_gamma(values, isp.gamma)
        yield "gamma inverted", f"gamma {isp.gamma}", values
    else:
        tables, levels = light_tables(profile, isp.tone, isp.gamma, 256), np.linspace(0, 1, 256)
        values = np.stack([np.interp(values[..., n], levels, table) for n, table in enumerate(tables)], axis=-1)
        yield "curves inverted", f"{profile.name}, {isp.tone}, gamma {isp.gamma}", values
    values = unprocess.apply_ccm(values, matrix)
    yield "colour matrix inverted", f"camera {camera.camera}", values
    values = unprocess.invert_gains(values, camera.inverse_gains, isp.highlight, isp.highlight_threshold)
    yield "gains inverted", f"times {_gain_text(inverse_gains)}; highlights {isp.highlight}", values


def _gain_text(gains: Sequence[float]) -> str:
    return ", ".join(f"{gain:.3g}" for gain in gains)
