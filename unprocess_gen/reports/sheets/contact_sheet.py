"""Draw sheets of a dataset's pairs: PNG files of each pair, or an overview with one strip per pair.

Sheets need only shards and manifest. The source panel is omitted, with the reason in its place, if the photograph is
not available or differs from the row's. Each panel shows the complete frame, averaged, and a detail at one pixel per
site.

Two stretches are used. ``own`` maps the percentiles `STRETCHED` of a picture to black and white, so that a few
defective sites do not hide the picture; frames cannot be compared. ``common`` maps the black to the white level,
square root, for every frame of a scene.

A sheet of stages shows the photograph after each step of unprocessing (Figure 1 of the article), computed with the
reference functions on the complete image scaled to a panel and on a detail, and the frames of the dataset.

Each PNG file contains the digest of the manifest that it shows. A folder with sheets of another dataset is refused,
because their names are keys: sheets of two datasets would replace each other or be mixed.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.tone_curves import linear_table
from unprocess_gen.core.types import CODE_RANGE, Float, Plan, Srgb
from unprocess_gen.dataset.manifest import patch_from_row, read_columns
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.reports.encoding import picture_png
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.pairs import SheetPair, selected_pairs
from unprocess_gen.reports.sheets.panels import MosaicArray, Picture, SheetPanel, Window
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import MONO, mosaic
from unprocess_gen.simulation.reference.isp import develop, process, to_light

PNG_HEADER_BYTES = 33
"""Bytes of the signature and the first chunk of a PNG file, behind which text may follow (PNG specification, 5.6)."""

SHEET_NAME = re.compile(r"\d{8,}(-p\d+)?(-l\d+d\d+)?(\.stages)?\.png")
"""Names of sheets: the key of a pair, and what they show."""


class SheetFiles(NamedTuple):
    """The files written for a pair; ``missing_source`` is the reason why source panels are omitted, or empty."""

    key: str
    source: str
    files: tuple[Path, ...]
    missing_source: str


def write_sheets(
    folder: AnyPath, to: Path, keys: Sequence[str] = (), source: AnyPath | None = None, with_stages: bool = False
) -> Iterator[SheetFiles]:
    """Write ``KEY.png`` for each pair, and ``KEY.stages.png`` if asked for; yield the files once they are written.

    ConfigError if ``to`` is inside a dataset, is not a folder or contains sheets of another dataset, and as for
    `contact_sheet`.
    """
    check_output_folder(to, f"--to {to}")
    mark = _mark(folder)
    for path in sorted(to.glob("*.png")):
        if SHEET_NAME.fullmatch(path.name) and not _is_marked(path, mark):
            raise ConfigError(
                f"--to {to}: {path.name} is not a sheet of {folder}; expected a folder without sheets of other "
                "datasets; choose another folder, or remove them"
            )
    for pair in selected_pairs(folder, keys, source):
        contents = {f"{pair.key}.png": _marked_png(pair_sheet(pair), mark)}
        if with_stages and pair.source is not None:
            contents[f"{pair.key}.stages.png"] = _marked_png(stages_sheet(pair, pair.source), mark)
        write_files(to, contents)
        yield SheetFiles(pair.key, str(pair.row["source"]), tuple(to / name for name in contents), pair.missing_source)


def contact_sheet(folder: AnyPath, keys: Sequence[str] = (), source: AnyPath | None = None) -> Picture:
    """Draw an overview, RGB, with one strip per pair in the order of the manifest.

    ``keys`` identify pairs, or images and patches, which select all of their pairs; by default, `PAIRS_SHOWN`
    evenly spaced pairs. ``source`` is the folder of the photographs, by default the recorded one. ConfigError for an
    unknown key or folder; DamageError if the dataset is damaged.
    """
    return np.vstack([_strip(pair) for pair in with_bar(selected_pairs(folder, keys, source), "pair drawn")])


def _mark(folder: AnyPath) -> bytes:
    """Text chunk of a PNG file (PNG specification, 11.3.3.2) that identifies a dataset."""
    manifest = folder / "manifest.csv"
    read_columns(manifest)  # DamageError if it cannot be read
    body = f"tEXtunprocess_gen\0manifest_sha256={file_sha256(manifest)}".encode("ascii")
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")


def _is_marked(path: Path, mark: bytes) -> bool:
    with suppress(OSError), path.open("rb") as stream:
        return mark in stream.read(PNG_HEADER_BYTES + len(mark))
    return False


def _marked_png(picture: Picture, mark: bytes) -> bytes:
    content = picture_png(picture)
    return content[:PNG_HEADER_BYTES] + mark + content[PNG_HEADER_BYTES:]


# ------------------------------------------------------------------------------------------------------ contact sheets


def pair_sheet(pair: SheetPair) -> Picture:
    """Draw the contact sheet of a pair: source, clean frame, difference, noisy frame, and both developed."""
    window = panels.detail_window(pair.clean.shape)
    return panels.lay_out(_heading(pair, window), _pair_panels(pair, window, panels.PANEL_PX))


def _strip(pair: SheetPair) -> Picture:
    """Draw the strip of a pair in an overview: without details and own stretches, the difference last."""
    drawn = [
        panel._replace(note=panel.note if panel.overview is None else "", detail=None)
        for panel in _pair_panels(pair, panels.detail_window(pair.clean.shape), panels.STRIP_PX)
        if not panel.title.endswith("own stretch")
    ]
    drawn.sort(key=lambda panel: panel.title == DIFFERENCE)
    return panels.lay_out([f"{pair.key}   {pair.row['source']}"], drawn, panels.STRIP_PX, len(drawn))


def _pair_panels(pair: SheetPair, window: Window, panel_px: tuple[int, int]) -> list[SheetPanel]:
    """Panels of the source, of the clean frame, of the difference, and of the noisy frame."""
    source = SheetPanel("source", f"not available: {pair.missing_source}", None)
    if pair.source is not None:
        source = SheetPanel("source", f"{8 * pair.source.itemsize} bits", *_views(pair.source, window, panel_px))
    clean, noisy = (panels.average_planes(raw, panel_px) for raw in (pair.clean, pair.noisy))
    return [
        source,
        *_frame_panels("clean", pair.clean, clean, pair.plan, window),
        _difference_panel(pair, noisy - clean, window),
        *_frame_panels("noisy", pair.noisy, noisy, pair.plan, window),
    ]


def _views(source: Srgb, window: Window, panel_px: tuple[int, int]) -> tuple[Float, Float]:
    """The source scaled to a panel, and its detail, in [0, 1]."""
    white = float(np.iinfo(source.dtype).max)
    return panels.fit_image(source, panel_px) / white, source[window] / white


def _frame_panels(name: str, raw: MosaicArray, planes: Float, plan: Plan, window: Window) -> list[SheetPanel]:
    """A raw frame with its own and with the common stretch, and developed; ``planes`` are its averages."""
    sensor, overview, detail = plan.sensor, planes.mean(axis=-1), raw[window]
    stretched, ranges = zip(*map(stretch, (overview, detail)), strict=True)
    white_dn = sensor.black_level_dn + (sensor.white_level_dn - sensor.black_level_dn) * plan.scene.exposure
    common = (common_stretch(dn, plan) for dn in (overview, detail))
    rgb = process(to_light(panels.planes_to_rgb(planes, sensor.pattern), plan), plan)
    return [
        SheetPanel(f"{name} raw, own stretch", f"{ranges[0]} (averaged), {ranges[1]} (detail)", *stretched),
        SheetPanel(
            f"{name} raw, common stretch", f"{sensor.black_level_dn} to {white_dn:.5g} DN, square root", *common
        ),
        SheetPanel(f"{name} raw, developed", "with the parameters of the row", rgb, develop_detail(raw, plan, window)),
    ]


STRETCHED = (0.1, 99.9)
"""Percentiles of a picture that its own stretch maps to black and white."""


def stretch(dn: MosaicArray, least: float = 1.0) -> tuple[Float, str]:
    """Stretch a frame to [0, 1] between its percentiles `STRETCHED`, which are also given in words.

    A range of less than ``least`` is not stretched to [0, 1].
    """
    low, high = np.percentile(dn, STRETCHED)
    return np.clip((dn - low) / max(high - low, least), 0, 1), f"{low:.5g} to {high:.5g} DN"


def common_stretch(dn: MosaicArray, plan: Plan) -> Float:
    """Stretch a frame from black to white of the darkened scene, square root, the same for every frame of a scene."""
    return np.sqrt(np.clip(to_light(dn, plan), 0, 1))


DEMOSAIC_REACH_PX = 2
"""Distance from which sites influence a demosaicked pixel (`isp.KERNELS`)."""


def develop_detail(raw: MosaicArray, plan: Plan, window: Window) -> Float | None:
    """Develop the detail with a border as wide as the demosaicking filter, as if the complete frame were developed.

    A frame of one row or column lacks a colour: it is not developed.
    """
    if min(raw.shape) == 1:
        return None
    y, x = (max(0, part.start - DEMOSAIC_REACH_PX) for part in window)  # even, as the reach is
    rows, columns = window
    bordered = develop(raw[y : rows.stop + DEMOSAIC_REACH_PX, x : columns.stop + DEMOSAIC_REACH_PX], plan)
    return bordered[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]


DIFFERENCE = "noisy - clean"
RMS_SHOWN = 4.0


def _difference_panel(pair: SheetPair, planes: Float, window: Window) -> SheetPanel:
    """Noisy minus clean around middle grey; black and white are `RMS_SHOWN` times its RMS, at least 1 DN."""
    differences = planes.mean(axis=-1), pair.noisy[window].astype(np.float64) - pair.clean[window]
    limits = [max(RMS_SHOWN * float(np.sqrt(np.mean(dn * dn))), 1.0) for dn in differences]
    note = f"within {limits[0]:.3g} DN (averaged), {limits[1]:.3g} DN (detail) of middle grey"
    pictures = ((dn / limit + 1) / 2 for dn, limit in zip(differences, limits, strict=True))
    return SheetPanel(DIFFERENCE, note, *pictures)


def _heading(pair: SheetPair, window: Window) -> list[str]:
    """The lines above a sheet: identity and size, parameters, and the place of the details."""
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


# -------------------------------------------------------------------------------------------------------------- stages


def stages_sheet(pair: SheetPair, source: Srgb) -> Picture:
    """Draw a sheet of the source after each step, uint8 ``[H, W, 3]`` RGB; black is 0 and white is 1."""
    plan, window = pair.plan, panels.detail_window(pair.clean.shape)
    overview, detail = _views(source, window, panels.PANEL_PX)
    drawn = [_image_panel("source", "codes of the raw file" if plan.source.is_raw else "", overview, detail)]
    if plan.source.dequantize != "off" and source.dtype == np.uint8:
        detail = _dithered(pair, source, window)
        drawn.append(_image_panel("codes dithered", "by up to half a code", overview, detail))
    both = zip(processing_steps(overview, plan), processing_steps(detail, plan), strict=True)
    for (title, note, overview), (_, _, detail) in both:
        drawn.append(_image_panel(title, note, overview, detail))
    drawn.append(_mosaic_panel("mosaic", plan, overview, mosaic(detail, plan.sensor.pattern)))
    for name, raw in (("clean", pair.clean), ("noisy", pair.noisy)):
        averaged = panels.planes_to_rgb(panels.average_planes(raw, panels.PANEL_PX), plan.sensor.pattern)
        drawn.append(_mosaic_panel(f"{name} raw", plan, to_light(averaged, plan), to_light(raw[window], plan)))
    note = "after each step, black 0, white 1, not stretched; mosaics: square root, each site in its filter's colour"
    if plan.scene.exposure_ratio != 1:
        note += f"; raw frames brightened {plan.scene.exposure_ratio:.4g} times, as the scene is darker"
    return panels.lay_out([*_heading(pair, window), note], drawn)


def processing_steps(values: Float, plan: Plan) -> Iterator[tuple[str, str, Float]]:
    """Yield title, note and result of the steps of the article's Figure 1 before the mosaic, ``[H, W, 3]``."""
    isp, camera = plan.isp, plan.camera
    if plan.source.is_raw:
        (black, *_), (white, *_) = plan.source.code_levels
        yield "levels", "black 0, white 1", (values * CODE_RANGE - black) / (white - black)
        return
    values = unprocess.INVERSE_TONES[isp.tone](values, 1 - values)
    yield "tone curve inverted", isp.tone, values
    values = unprocess.expand_gamma(values, isp.gamma)
    yield "gamma inverted", f"gamma {isp.gamma}", values
    values = unprocess.apply_ccm(values, camera.rgb2cam)
    yield "colour matrix inverted", f"camera {camera.name}", values
    gains = ", ".join(f"{gain:.3g}" for gain in camera.inverse_gains)
    values = unprocess.invert_gains(values, camera.inverse_gains, camera.highlight, camera.highlight_threshold)
    yield "gains inverted", f"times {gains}; highlights {camera.highlight}", values


def _dithered(pair: SheetPair, source: Srgb, window: Window) -> Float:
    """The detail with its codes dithered as the frames were, values in [0, 1]."""
    plan, patch = pair.plan, patch_from_row(pair.row)
    origin = patch.y + window[0].start, patch.x + window[1].start
    curve = linear_table(plan.isp.tone, plan.isp.gamma, 256)
    return unprocess.dequantise(source[window], plan, curve, origin) / 65535


def _image_panel(title: str, note: str, overview: Float, detail: Float) -> SheetPanel:
    fraction = float(((overview < 0) | (overview > 1)).mean())
    clipped = f"; {fraction:.2%} outside [0, 1], shown clipped" if fraction else ""
    return SheetPanel(title, note + clipped, overview, detail)


def _mosaic_panel(title: str, plan: Plan, overview: Float, detail: Float) -> SheetPanel:
    """Panel of a mosaic, of which the overview has the mean of each colour ``[h, w, 3]``."""
    shares = (1.0, 1.0, 1.0) if plan.sensor.pattern == MONO else (0.25, 0.5, 0.25)  # of the sites of a tile
    shown, sites = (np.sqrt(np.clip(light, 0, 1)) for light in (overview, detail))
    panel = _image_panel(title, plan.sensor.pattern, overview, detail)
    return panel._replace(overview=shown * shares, detail=panels.colour_sites(sites, plan.sensor.pattern))
