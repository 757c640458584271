"""Draw contact sheets of a dataset's pairs: one PNG per pair, or an overview with one strip per pair.

Sheets need only shards and manifest. The source panel is omitted, with the reason in its place, if the photograph is
not available or differs from the row's. Each panel shows the complete frame, averaged, and a detail at one pixel per
site.

Two stretches are used. ``own`` maps the least and greatest DN of a frame to the full range, as the article's demo
does, so frames cannot be compared. ``common`` maps the black to the white level, square root, for every frame of a
scene.

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
from unprocess_gen.core.object_store import AnyPath
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.types import Float, Plan
from unprocess_gen.dataset.manifest import read_header
from unprocess_gen.reports.sheets.pairs import SheetPair, selected_pairs, sheet_heading
from unprocess_gen.reports.sheets.panels import (
    PANEL_PX,
    STRIP_PX,
    DetailWindow,
    Mosaic,
    Picture,
    SheetPanel,
    average_mosaic,
    detail_window,
    fit_image,
    fit_mosaic,
    lay_out,
    tile_channels,
    to_codes,
)
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
    """Write ``KEY.png`` for each pair, and ``KEY.stages.png`` if asked for.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset.
    to : Path
        Folder for the PNG files.
    keys : sequence of str
        As for `contact_sheet`.
    source : Path or ObjectPath, optional
        As for `contact_sheet`.
    with_stages : bool
        Whether to write the photograph after each step of unprocessing, too.

    Yields
    ------
    SheetFiles
        The files of each pair, once they are written.

    Raises
    ------
    ConfigError
        If ``to`` is inside a dataset, is not a folder or contains sheets of another dataset, and as for
        `contact_sheet`.
    DamageError
        As for `contact_sheet`.
    MachineError
        If a file cannot be written.
    """
    check_output_folder(to, f"--to {to}")
    mark = _mark(folder)
    _check_sheets(to, mark, folder)
    for pair in selected_pairs(folder, keys, source):
        pictures = {f"{pair.key}.png": pair_sheet(pair)}
        if with_stages and pair.source is not None:
            pictures[f"{pair.key}.stages.png"] = stages_sheet(pair)
        files = tuple(_write(picture, to / name, mark) for name, picture in pictures.items())
        yield SheetFiles(pair.key, str(pair.row["source"]), files, pair.missing_source)


def contact_sheet(folder: AnyPath, keys: Sequence[str] = (), source: AnyPath | None = None) -> Picture:
    """Return an overview of some pairs, one strip per pair in the order of the manifest.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset.
    keys : sequence of str
        Keys of pairs, or of images and patches, which select all of their pairs. By default,
        `pairs.PAIRS_SHOWN` evenly spaced pairs.
    source : Path or ObjectPath, optional
        Folder of the photographs; by default the one recorded in ``dataset.json``.

    Returns
    -------
    ndarray of uint8, [H, W, 3]
        The overview, RGB.

    Raises
    ------
    ConfigError
        If the manifest has no pair with a key, or ``source`` is not a folder.
    DamageError
        If the dataset is damaged.
    """
    return np.vstack([_strip(pair) for pair in selected_pairs(folder, keys, source)])


def _mark(folder: AnyPath) -> bytes:
    """Return the text chunk of a PNG file (PNG specification, 11.3.3.2) that identifies a dataset."""
    manifest = folder / "manifest.csv"
    read_header(manifest)  # DamageError if it cannot be read
    body = f"tEXtunprocess_gen\0manifest_sha256={file_sha256(manifest)}".encode("ascii")
    return (len(body) - 4).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")


def _check_sheets(to: Path, mark: bytes, folder: AnyPath) -> None:
    """Raise ConfigError if a file named like a sheet is not one of this dataset."""
    names = sorted(path.name for path in to.iterdir() if SHEET_NAME.fullmatch(path.name)) if to.is_dir() else []
    for name in names:
        if not _is_marked(to / name, mark):
            raise ConfigError(
                f"--to {to}: {name} is not a sheet of {folder}; expected a folder without sheets of other datasets; "
                "choose another folder, or remove them"
            )


def _is_marked(path: Path, mark: bytes) -> bool:
    try:
        with path.open("rb") as stream:
            stream.seek(PNG_HEADER_BYTES)
            return stream.read(len(mark)) == mark
    except OSError:
        return False


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
    window = detail_window(pair.clean.shape)
    clean, noisy = average_mosaic(pair.clean, window.side), average_mosaic(pair.noisy, window.side)
    panels = (
        _source_panel(pair, window),
        *_frame_panels("clean", pair.clean, clean, pair.plan, window),
        _difference_panel(pair, noisy - clean, window),
        *_frame_panels("noisy", pair.noisy, noisy, pair.plan, window),
    )
    return lay_out(sheet_heading(pair, window), panels)


def _strip(pair: SheetPair) -> Picture:
    """Return the strip of a pair in an overview, without details."""
    window = detail_window(pair.clean.shape, STRIP_PX)
    clean, noisy = average_mosaic(pair.clean, window.side), average_mosaic(pair.noisy, window.side)
    panels = (
        _source_panel(pair, window, STRIP_PX),
        *_frame_panels("clean", pair.clean, clean, pair.plan, window, STRIP_PX)[1:],
        *_frame_panels("noisy", pair.noisy, noisy, pair.plan, window, STRIP_PX)[1:],
        _difference_panel(pair, noisy - clean, window, STRIP_PX),
    )
    overviews = [SheetPanel(one.title, one.note if one.overview is None else "", one.overview) for one in panels]
    return lay_out([f"{pair.key}   {pair.row['source']}"], overviews, STRIP_PX, len(overviews))


def _source_panel(pair: SheetPair, window: DetailWindow, panel_px: tuple[int, int] = PANEL_PX) -> SheetPanel:
    if pair.source is None:
        return SheetPanel("source", f"not available: {pair.missing_source}", None)
    white = float(np.iinfo(pair.source.dtype).max)
    overview, detail = fit_image(pair.source, panel_px), pair.source[window.rows, window.columns]
    return SheetPanel(
        "source", f"{8 * pair.source.itemsize} bits", to_codes(overview / white), to_codes(detail / white)
    )


def _frame_panels(
    name: str,
    raw: Mosaic,
    averaged: Float,
    plan: Plan,
    window: DetailWindow,
    panel_px: tuple[int, int] = PANEL_PX,
) -> tuple[SheetPanel, SheetPanel, SheetPanel]:
    """Return a raw frame with its own and with the common stretch, and developed."""
    low, high = float(raw.min()), float(raw.max())
    overview, detail = fit_mosaic(averaged, panel_px), raw[window.rows, window.columns]

    def stretch_own(dn: Mosaic) -> Picture:
        return to_codes(np.asarray((dn - low) / max(high - low, 1.0), dtype=np.float64))

    def stretch_common(dn: Mosaic) -> Picture:
        return to_codes(np.sqrt(np.clip(to_light(dn, plan), 0, 1)))

    white_dn = plan.black_level_dn + (plan.white_level_dn - plan.black_level_dn) * plan.exposure
    return (
        SheetPanel(
            f"{name} raw, own stretch",
            f"{low:.6g} to {high:.6g} DN, its minimum and maximum",
            stretch_own(overview),
            stretch_own(detail),
        ),
        SheetPanel(
            f"{name} raw, common stretch",
            f"{plan.black_level_dn} to {white_dn:.5g} DN, square root",
            stretch_common(overview),
            stretch_common(detail),
        ),
        _developed_panel(name, raw, averaged, plan, window, panel_px),
    )


def _developed_panel(
    name: str, raw: Mosaic, averaged: Float, plan: Plan, window: DetailWindow, panel_px: tuple[int, int]
) -> SheetPanel:
    title = f"{name} raw, developed"
    if min(raw.shape) < 2:
        return SheetPanel(title, "not available: fewer than 2 x 2 sites do not contain all three colours", None)
    if window.side == 1:
        rgb = develop(averaged, plan)
    else:
        rgb = process(to_light(tile_channels(averaged, plan.pattern), plan), plan)
    detail = _developed_detail(raw, plan, window)
    return SheetPanel(title, "with the parameters of the row", to_codes(fit_image(rgb, panel_px)), to_codes(detail))


DEMOSAIC_REACH_PX = 2
"""Distance from which sites influence a demosaicked pixel (`isp.KERNELS`)."""


def _developed_detail(raw: Mosaic, plan: Plan, window: DetailWindow) -> Float:
    """Develop the detail with a border as wide as the demosaicking filter, as if the complete frame were developed."""
    reach = DEMOSAIC_REACH_PX  # even, so that y and x are even
    y, x = (max(0, part.start - reach) for part in (window.rows, window.columns))
    bordered = develop(raw[y : window.rows.stop + reach, x : window.columns.stop + reach], plan)
    top, left = window.rows.start - y, window.columns.start - x
    height, width = (part.stop - part.start for part in (window.rows, window.columns))
    return bordered[top : top + height, left : left + width]


RMS_SHOWN = 4.0


def _difference_panel(
    pair: SheetPair, averaged: Float, window: DetailWindow, panel_px: tuple[int, int] = PANEL_PX
) -> SheetPanel:
    """Show noisy minus clean around middle grey; black and white are `RMS_SHOWN` times its RMS, at least 1 DN."""
    overview = fit_mosaic(averaged, panel_px)
    clean = pair.clean[window.rows, window.columns]
    detail = pair.noisy[window.rows, window.columns].astype(np.float64) - clean
    limits = [max(RMS_SHOWN * float(np.sqrt(np.mean(one * one))), 1.0) for one in (overview, detail)]
    note = f"black to white: {_symmetric(limits[0])} (averaged), {_symmetric(limits[1])} (detail)"
    pictures = [to_codes((one / dn + 1) / 2) for one, dn in zip((overview, detail), limits, strict=True)]
    return SheetPanel("noisy - clean", note, *pictures)


def _symmetric(dn: float) -> str:
    """Return the range from -dn to dn in words, because OpenCV's font lacks the plus-minus sign."""
    return f"from -{dn:.3g} to {dn:.3g} DN"
