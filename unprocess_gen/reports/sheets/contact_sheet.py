"""Draw contact sheets of a dataset's pairs: one PNG per pair, or an overview with one strip per pair.

Sheets need only shards and manifest. The source panel is omitted, with the reason in its place, if the photograph is
not available or differs from the row's. Each panel shows the complete frame, averaged, and a detail at one pixel per
site.

Two stretches are used. ``own`` maps the percentiles `STRETCHED` of a picture to black and white, so that a few
defective sites do not hide the picture; frames cannot be compared. ``common`` maps the black to the white level,
square root, for every frame of a scene.

Each PNG file contains the digest of the manifest that it shows. A folder with sheets of another dataset is refused,
because their names are keys: sheets of two datasets would replace each other or be mixed.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import file_sha256, machine_error
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.types import Float
from unprocess_gen.dataset.manifest import read_header
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.pairs import SheetPair, selected_pairs, sheet_heading
from unprocess_gen.reports.sheets.panels import Mosaic, Picture, SheetPanel, Window
from unprocess_gen.reports.sheets.stages_sheet import stages_sheet
from unprocess_gen.simulation.reference.isp import develop, process, to_light

PNG = (cv2.IMWRITE_PNG_COMPRESSION, 3)

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
    _check_sheets(to, mark, folder)
    for pair in selected_pairs(folder, keys, source):
        pictures = {f"{pair.key}.png": pair_sheet(pair)}
        if with_stages and pair.source is not None:
            pictures[f"{pair.key}.stages.png"] = stages_sheet(pair, pair.source)
        files = tuple(_write(picture, to / name, mark) for name, picture in pictures.items())
        yield SheetFiles(pair.key, str(pair.row["source"]), files, pair.missing_source)


def contact_sheet(folder: AnyPath, keys: Sequence[str] = (), source: AnyPath | None = None) -> Picture:
    """Return an overview, RGB, with one strip per pair in the order of the manifest.

    ``keys`` are those of pairs, or of images and patches, which select all of their pairs; by default, `PAIRS_SHOWN`
    evenly spaced pairs. ``source`` is the folder of the photographs, by default the recorded one. ConfigError for an
    unknown key or folder; DamageError if the dataset is damaged.
    """
    return np.vstack([_strip(pair) for pair in with_bar(selected_pairs(folder, keys, source), "pair drawn")])


def _mark(folder: AnyPath) -> bytes:
    """Return the text chunk of a PNG file (PNG specification, 11.3.3.2) that identifies a dataset."""
    manifest = folder / "manifest.csv"
    read_header(manifest)  # DamageError if it cannot be read
    body = f"tEXtunprocess_gen\0manifest_sha256={file_sha256(manifest)}".encode("ascii")
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")


def _check_sheets(to: Path, mark: bytes, folder: AnyPath) -> None:
    """Raise ConfigError if a file named like a sheet is not one of this dataset."""
    sheets = sorted(path for path in to.iterdir() if SHEET_NAME.fullmatch(path.name)) if to.is_dir() else []
    for path in sheets:
        try:
            with path.open("rb") as stream:
                is_marked = mark in stream.read(PNG_HEADER_BYTES + len(mark))
        except OSError:
            is_marked = False
        if not is_marked:
            raise ConfigError(
                f"--to {to}: {path.name} is not a sheet of {folder}; expected a folder without sheets of other "
                "datasets; choose another folder, or remove them"
            )


def _write(picture: Picture, path: Path, mark: bytes) -> Path:
    _, encoded = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]), PNG)
    content = encoded.tobytes()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content[:PNG_HEADER_BYTES] + mark + content[PNG_HEADER_BYTES:])
    except OSError as error:
        raise machine_error(error, path) from error
    return path


# ------------------------------------------------------------------------------------------------------------- sheets


def pair_sheet(pair: SheetPair) -> Picture:
    """Return the contact sheet of a pair: source, clean frame, difference, noisy frame, and both developed."""
    window = panels.detail_window(pair.clean.shape)
    clean, noisy = (panels.average_planes(raw, panels.PANEL_PX) for raw in (pair.clean, pair.noisy))
    drawn = [
        _source_panel(pair, window, panels.PANEL_PX),
        *_frame_panels("clean", pair, clean, window),
        _difference_panel(pair, noisy - clean, window),
        *_frame_panels("noisy", pair, noisy, window),
    ]
    return panels.lay_out(sheet_heading(pair, window), drawn)


def _strip(pair: SheetPair) -> Picture:
    """Return the strip of a pair in an overview, without details."""
    window = panels.detail_window(pair.clean.shape)
    clean, noisy = (panels.average_planes(raw, panels.STRIP_PX) for raw in (pair.clean, pair.noisy))
    drawn = [
        _source_panel(pair, window, panels.STRIP_PX),
        *_frame_panels("clean", pair, clean, window)[1:],
        *_frame_panels("noisy", pair, noisy, window)[1:],
        _difference_panel(pair, noisy - clean, window),
    ]
    overviews = [panel._replace(note=panel.note if panel.overview is None else "", detail=None) for panel in drawn]
    return panels.lay_out([f"{pair.key}   {pair.row['source']}"], overviews, panels.STRIP_PX, len(overviews))


def _source_panel(pair: SheetPair, window: Window, panel_px: tuple[int, int]) -> SheetPanel:
    if pair.source is None:
        return SheetPanel("source", f"not available: {pair.missing_source}", None)
    white = float(np.iinfo(pair.source.dtype).max)
    overview, detail = panels.fit_image(pair.source, panel_px) / white, pair.source[window] / white
    return SheetPanel("source", f"{8 * pair.source.itemsize} bits", overview, detail)


def _frame_panels(name: str, pair: SheetPair, planes: Float, window: Window) -> list[SheetPanel]:
    """Return a raw frame with its own and with the common stretch, and developed; ``planes`` are its averages."""
    raw, plan, sensor = (pair.clean if name == "clean" else pair.noisy), pair.plan, pair.plan.sensor
    overview, detail = planes.mean(axis=-1), raw[window]
    stretched, ranges = zip(*map(stretch, (overview, detail)), strict=True)
    white_dn = sensor.black_level_dn + (sensor.white_level_dn - sensor.black_level_dn) * plan.scene.exposure
    common = (np.sqrt(np.clip(to_light(dn, plan), 0, 1)) for dn in (overview, detail))
    rgb = process(to_light(panels.planes_to_rgb(planes, sensor.pattern), plan), plan)
    has_all_colours = min(raw.shape) > 1
    developed = rgb, _develop_detail(raw, pair, window) if has_all_colours else None
    return [
        SheetPanel(f"{name} raw, own stretch", f"{ranges[0]} (averaged), {ranges[1]} (detail)", *stretched),
        SheetPanel(
            f"{name} raw, common stretch", f"{sensor.black_level_dn} to {white_dn:.5g} DN, square root", *common
        ),
        SheetPanel(f"{name} raw, developed", "with the parameters of the row", *developed),
    ]


STRETCHED = (0.1, 99.9)
"""Percentiles of a picture that its own stretch maps to black and white."""


def stretch(dn: Mosaic) -> tuple[Float, str]:
    """Return a frame stretched to [0, 1] between its percentiles `STRETCHED`, and these in words."""
    low, high = np.percentile(dn, STRETCHED)
    return np.clip((dn - low) / max(high - low, 1.0), 0, 1), f"{low:.5g} to {high:.5g} DN"


DEMOSAIC_REACH_PX = 2
"""Distance from which sites influence a demosaicked pixel (`isp.KERNELS`)."""


def _develop_detail(raw: Mosaic, pair: SheetPair, window: Window) -> Float:
    """Develop the detail with a border as wide as the demosaicking filter, as if the complete frame were developed."""
    y, x = (max(0, part.start - DEMOSAIC_REACH_PX) for part in window)  # even, as the reach is
    rows, columns = window
    bordered = develop(raw[y : rows.stop + DEMOSAIC_REACH_PX, x : columns.stop + DEMOSAIC_REACH_PX], pair.plan)
    return bordered[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]


RMS_SHOWN = 4.0


def _difference_panel(pair: SheetPair, planes: Float, window: Window) -> SheetPanel:
    """Show noisy minus clean around middle grey; black and white are `RMS_SHOWN` times its RMS, at least 1 DN."""
    differences = planes.mean(axis=-1), pair.noisy[window].astype(np.float64) - pair.clean[window]
    limits = [max(RMS_SHOWN * float(np.sqrt(np.mean(dn * dn))), 1.0) for dn in differences]
    note = f"within {limits[0]:.3g} DN (averaged), {limits[1]:.3g} DN (detail) of middle grey"
    pictures = ((dn / limit + 1) / 2 for dn, limit in zip(differences, limits, strict=True))
    return SheetPanel("noisy - clean", note, *pictures)
