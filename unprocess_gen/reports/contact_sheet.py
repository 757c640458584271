"""Contact sheets: what the pairs of a dataset look like, one PNG a pair, and what each step did to a photograph.

A sheet needs the shards and the manifest alone, but for the panel of the source, which is left out, with the reason in
its place, where the photograph is not at hand or no longer the one of the row. Everything is shown twice: the whole
frame, averaged down to its panel, and below it a part at one pixel a site. To be quick on large frames, the whole is
averaged while it is still a mosaic, colour by colour, and developed then.

Stretches: ``own`` maps a frame's least and greatest DN to the full range, as the article's demo does, so that nothing
can be compared; ``common`` is the sensor's black to white level, square root, the same for every frame of a scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.files import machine_error
from unprocess_gen.core.lookup_tables import linear_table
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Float, Frame, Plan, Row, Srgb
from unprocess_gen.dataset.keys import image_key, sample_key
from unprocess_gen.dataset.manifest import patch_from_row, plan_from_row, read_rows
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.pipeline.replay import NO_LIMIT, source_of, source_root
from unprocess_gen.simulation.reference import unprocess
from unprocess_gen.simulation.reference.cfa import mosaic, tile
from unprocess_gen.simulation.reference.isp import develop, process, to_light
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import crop_patch

Picture = NDArray[np.uint8]

SHEETS = 8
"""Pairs that are shown where no keys are given."""

PNG = (cv2.IMWRITE_PNG_COMPRESSION, 3)
"""A third smaller than by default, for 0.2 s a sheet; higher levels take longer and gain less than a tenth."""

KEYS_LOOK = "00000003 names all pairs of an image, 00000003-p0007 those of a patch, 00000003-l01d02 a level and a draw"


Mosaic = Frame | Float
"""A mosaic ``[H, W]`` in DN, of integers or not."""


@dataclass(frozen=True, slots=True)
class SheetPair:
    """A pair that is to be shown: its frames and row, its plan, and its source's pixels, or what became of them."""

    clean: Mosaic
    noisy: Mosaic
    row: Row
    plan: Plan
    source: Srgb | None
    missing_source: str

    @property
    def key(self) -> str:
        """The key of its row."""
        return str(self.row["key"])


class SheetFiles(NamedTuple):
    """What was written for a pair: its key, the name of its source, the files, and why the source is not among them."""

    key: str
    source: str
    files: tuple[Path, ...]
    missing_source: str


def write_sheets(
    folder: Path, to: Path, keys: Sequence[str] = (), source: Path | None = None, with_stages: bool = False
) -> Iterator[SheetFiles]:
    """Write ``KEY.png`` for each pair into the folder ``to``, and ``KEY.stages.png`` if asked; yield what was written.

    ``keys`` and ``source`` as for `contact_sheet`. Raises as it does, and MachineError where a file cannot be written.
    """
    _check_to(folder, to)
    for shown in _shown(folder, keys, source):
        pictures = {f"{shown.key}.png": pair_sheet(shown)}
        if with_stages and shown.source is not None:
            pictures[f"{shown.key}.stages.png"] = stages_sheet(shown)
        files = tuple(_write(picture, to / name) for name, picture in pictures.items())
        yield SheetFiles(shown.key, str(shown.row["source"]), files, shown.missing_source)


def contact_sheet(folder: Path, keys: Sequence[str] = (), source: Path | None = None) -> Picture:
    """Return an overview of some pairs, uint8 ``[H, W, 3]`` RGB: one strip a pair, in the order of the manifest.

    ``keys`` are those of pairs, or of images and patches, which stand for all of their pairs; none: `SHEETS` pairs,
    evenly spread. ``source`` is the folder of the photographs; None: the one that ``dataset.json`` names. Where a
    photograph is not there, its panel says so. Raises ConfigError for keys that the manifest has no pair of and for a
    ``source`` that is no folder, DamageError where the dataset is not whole.
    """
    return np.vstack([_strip(shown) for shown in _shown(folder, keys, source)])


def _check_to(folder: Path, to: Path) -> None:
    if to.resolve() in (folder.resolve(), (folder / "shards").resolve()):
        raise ConfigError(f"--to {to}: belongs to the dataset; name another folder")
    if to.exists() and not to.is_dir():
        raise ConfigError(f"--to {to}: is no folder")


def _write(picture: Picture, path: Path) -> Path:
    _, content = cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]), PNG)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.tobytes())
    except OSError as error:
        raise machine_error(error, path) from error
    return path


# ------------------------------------------------------------------------------------------ the pairs and their sources


def _shown(folder: Path, keys: Sequence[str], source_folder: Path | None) -> Iterator[SheetPair]:
    """Yield pairs in the order of the manifest; the photograph of several is decoded once."""
    if source_folder is not None and not source_folder.is_dir():
        raise ConfigError(f"--source {source_folder}: is no folder")
    pairs = RawPairs(folder)
    numbers = _numbers(folder / "manifest.csv", keys) if keys else _spread(folder, len(pairs))
    root = source_root(folder / "manifest.csv", None if source_folder is None else str(source_folder))
    of_image, photograph, missing_source = "", None, ""
    for number in numbers:
        clean, noisy, row = pairs[number]
        if of_image != image_key(row):
            of_image, (photograph, missing_source) = image_key(row), _photograph(row, root)
        source_part, lacks_part = _part_of(photograph, missing_source, row)
        yield SheetPair(mosaic_dn(clean, row), mosaic_dn(noisy, row), row, plan_from_row(row), source_part, lacks_part)


def _part_of(photograph: Srgb | None, missing_source: str, row: Row) -> tuple[Srgb | None, str]:
    """Return what of a photograph a row's frames show, or None and the reason."""
    if photograph is None:
        return None, missing_source
    patch = patch_from_row(row)
    part = crop_patch(photograph, patch)
    if part.shape[:2] != (patch.height, patch.width):
        return None, f"its {photograph.shape[1]} x {photograph.shape[0]} pixels are not those of the row"
    return part, ""


def _spread(folder: Path, pairs: int) -> list[int]:
    if not pairs:
        raise ConfigError(f"{folder}: every photograph failed, so there is no pair to show")
    return evenly_spaced(range(pairs), SHEETS)


def _numbers(manifest: Path, keys: Sequence[str]) -> list[int]:
    """Return the numbers, among the pairs that were made, of those with the keys; ConfigError for a key of none."""
    wanted, found, numbers = set(keys), set[str](), list[int]()
    made, first, last = 0, "", ""
    for row in read_rows(manifest):
        named = {str(row["key"]), sample_key(row), image_key(row)} & wanted
        if named and row["status"] != "ok":
            raise ConfigError(f"--keys {min(named)}: {row['source']} failed ({row['reason']}): no pair was made of it")
        first, last = first or str(row["key"]), str(row["key"])
        found |= named
        numbers += [made] if named else []
        made += row["status"] == "ok"
    if wanted - found:
        known = f"keys from {first} to {last}" if first else "no keys at all"
        raise ConfigError(f"--keys {min(wanted - found)}: no such key; {manifest} has {known}; {KEYS_LOOK}")
    return numbers


def _photograph(row: Row, root: str | None) -> tuple[Srgb | None, str]:
    """Return the pixels that a row was made from, or None and the reason why they are not at hand."""
    is_scene = row["source_bytes"] == 0
    if root is None and not is_scene:
        return None, "the dataset does not say where its photographs are; give --source ROOT"
    config = SourceConfig(root=None if is_scene else root, max_pixels=NO_LIMIT, downscale=int(row["downscale"] or 1))
    try:
        sha256, photograph = load_source(config, source_of(row))
    except (SourceError, MachineError, ConfigError) as error:  # of one photograph: the sheet is made without it
        return None, str(error)
    if sha256 != row["source_sha256"]:
        return None, "it has changed: its SHA-256 is not that of the row"
    return photograph.srgb, ""


# ----------------------------------------------------------------------------------------------------------- the sheets

PANEL_PX = (224, 336)
STRIP_PX = (120, 180)
"""Height and width that a picture is fitted into, on a sheet and on an overview's strip."""

COLUMNS = 4


class SheetPanel(NamedTuple):
    """Two pictures of one thing, the whole and a part of it one to one, with a title and what is to be known of them.

    A picture that there is none of is None, and ``note`` says why.
    """

    title: str
    note: str
    whole: Picture | None
    part: Picture | None = None


class DetailWindow(NamedTuple):
    """The part that is shown one to one, and the side of the squares that the whole is averaged over beforehand."""

    rows: slice
    columns: slice
    side: int


def detail_window(height: int, width: int, panel_px: tuple[int, int] = PANEL_PX) -> DetailWindow:
    """Return what is shown of a frame: its middle, which begins at an even row and column as the Bayer tile does.

    Averaged, the whole is still twice as large as its panel, or more: a mosaic of that size holds the panel's detail.
    """
    rows, columns = _middle(height, panel_px[0]), _middle(width, panel_px[1])
    reduction = max(height / panel_px[0], width / panel_px[1])
    return DetailWindow(rows, columns, max(1, min(int(reduction / 2), height // 2, width // 2)))


def _window(shown: SheetPair, panel_px: tuple[int, int] = PANEL_PX) -> DetailWindow:
    return detail_window(shown.clean.shape[0], shown.clean.shape[1], panel_px)


def _middle(length: int, most: int) -> slice:
    start = max(0, length - most) // 4 * 2
    return slice(start, start + min(length, most))


def binned(raw: Mosaic, side: int) -> Float:
    """Average squares of ``side`` x ``side`` sites of one colour, so that a smaller mosaic of the same pattern results.

    Rows and columns that fill no square are left out.
    """
    if side == 1:
        return raw.astype(np.float64)
    height, width = (length // (2 * side) for length in raw.shape)
    of_rows, of_all = (np.uint32, np.uint64) if raw.dtype == np.uint16 else (np.float64, np.float64)
    rows = raw[: height * 2 * side, : width * 2 * side].reshape(height, side, 2, -1).sum(axis=1, dtype=of_rows)
    sites = rows.reshape(height, 2, width, side, 2).sum(axis=3, dtype=of_all)  # rows first: ten times as fast
    return np.asarray(sites.reshape(2 * height, 2 * width) / float(side * side))


def channels(binned_dn: Float, pattern: str) -> Float:
    """Return the mean of each channel over each 2x2 tile of an averaged mosaic, ``[2 H, 2 W]`` to ``[H, W, 3]``.

    The squares that a tile's sites were averaged over lie on top of each other, but for a pixel, so that there is
    nothing to interpolate between them: a demosaic would colour every edge.
    """
    found = [binned_dn[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    filters = [channel for row in tile(pattern) for channel in row]
    return np.stack([np.mean([f for f, c in zip(found, filters, strict=True) if c == k], axis=0) for k in range(3)], -1)


def pair_sheet(shown: SheetPair) -> Picture:
    """Return a pair's contact sheet: source, clean frame, noise residual, noisy frame, and both developed."""
    at = _window(shown)
    clean, noisy = binned(shown.clean, at.side), binned(shown.noisy, at.side)
    panels = (
        _source_panel(shown, at),
        *_frame_panels("clean", shown.clean, clean, shown.plan, at),
        _residual_panel(shown, noisy - clean, at),
        *_frame_panels("noisy", shown.noisy, noisy, shown.plan, at),
    )
    return _page(_heading(shown, at), panels)


def _strip(shown: SheetPair) -> Picture:
    """Return the strip of a pair in an overview: whole frames only."""
    at = _window(shown, STRIP_PX)
    clean, noisy = binned(shown.clean, at.side), binned(shown.noisy, at.side)
    panels = (
        _source_panel(shown, at, STRIP_PX),
        *_frame_panels("clean", shown.clean, clean, shown.plan, at, STRIP_PX)[1:],
        *_frame_panels("noisy", shown.noisy, noisy, shown.plan, at, STRIP_PX)[1:],
        _residual_panel(shown, noisy - clean, at, STRIP_PX),
    )
    bare = [SheetPanel(panel.title, panel.note if panel.whole is None else "", panel.whole) for panel in panels]
    return _page([f"{shown.key}   {shown.row['source']}"], bare, STRIP_PX, len(bare))


def _heading(shown: SheetPair, at: DetailWindow) -> list[str]:
    row, plan = shown.row, shown.plan
    height, width = shown.clean.shape
    darker = f", exposure 1 / {plan.exposure_ratio:g}" if plan.exposure_ratio != 1 else ""
    return [
        f"{shown.key}   {row['source']}   {width} x {height} {plan.pattern}, {plan.bits} bits, black "
        f"{plan.black_level_dn}, white {plan.white_level_dn} DN",
        f"camera {plan.camera}, gains red {plan.red_gain:.4g}, blue {plan.blue_gain:.4g}, inverse rgb "
        f"{plan.inverse_rgb_gain:.4g}, highlights {plan.highlight}, tone {plan.tone}, gamma {plan.gamma}; "
        f"scene {plan.scene}{darker}; noise {plan.noise}: a {plan.a_dn:.4g} DN, b {plan.b_dn2:.4g} DN^2, effects "
        f"{' '.join(plan.effects) or 'none'}",
        f"below each whole frame: rows {at.rows.start} to {at.rows.stop - 1}, columns {at.columns.start} to "
        f"{at.columns.stop - 1}, one pixel a site",
    ]


def _source_panel(shown: SheetPair, at: DetailWindow, panel_px: tuple[int, int] = PANEL_PX) -> SheetPanel:
    if shown.source is None:
        return SheetPanel("source", f"left out: {shown.missing_source}", None)
    white = _white(shown.source)
    whole, part = fitted(shown.source, panel_px), shown.source[at.rows, at.columns]
    return SheetPanel("source", f"{8 * shown.source.itemsize} bits", _codes(whole / white), _codes(part / white))


def _frame_panels(
    name: str, raw: Mosaic, whole: Float, plan: Plan, at: DetailWindow, panel_px: tuple[int, int] = PANEL_PX
) -> tuple[SheetPanel, SheetPanel, SheetPanel]:
    """Return a raw frame with its own stretch and with the common one, and developed; ``whole`` is it averaged."""
    low, high = float(raw.min()), float(raw.max())
    gray, part = _shrunk(whole, panel_px), raw[at.rows, at.columns]

    def own(dn: Mosaic) -> Picture:
        return _codes(np.asarray((dn - low) / max(high - low, 1.0), dtype=np.float64))

    def common(dn: Mosaic) -> Picture:
        return _codes(np.sqrt(np.clip(to_light(dn, plan), 0, 1)))

    white_dn = plan.black_level_dn + (plan.white_level_dn - plan.black_level_dn) * plan.exposure
    return (
        SheetPanel(
            f"{name} raw, own stretch", f"{low:.6g} to {high:.6g} DN, its least and greatest", own(gray), own(part)
        ),
        SheetPanel(
            f"{name} raw, common stretch",
            f"{plan.black_level_dn} to {white_dn:.5g} DN, square root",
            common(gray),
            common(part),
        ),
        _developed_panel(name, raw, whole, plan, at, panel_px),
    )


def _developed_panel(
    name: str, raw: Mosaic, whole: Float, plan: Plan, at: DetailWindow, panel_px: tuple[int, int]
) -> SheetPanel:
    title = f"{name} raw, developed"
    if min(raw.shape) < 2:
        return SheetPanel(title, "left out: less than 2 x 2 sites do not show all three colours", None)
    rgb = develop(whole, plan) if at.side == 1 else process(to_light(channels(whole, plan.pattern), plan), plan)
    part = _developed_part(raw, plan, at)
    return SheetPanel(title, "with the row's own parameters", _codes(fitted(rgb, panel_px)), _codes(part))


REACH_PX = 2
"""How far a demosaicked pixel looks (`process.KERNELS`)."""


def _developed_part(raw: Mosaic, plan: Plan, at: DetailWindow) -> Float:
    """Develop the part and the little around it that the demosaic sees, so that the part is that of the whole."""
    y, x = (max(0, part.start - REACH_PX) for part in (at.rows, at.columns))
    around = develop(raw[y : at.rows.stop + REACH_PX, x : at.columns.stop + REACH_PX], plan)  # y and x are even
    top, left = at.rows.start - y, at.columns.start - x
    return around[top : top + at.rows.stop - at.rows.start, left : left + at.columns.stop - at.columns.start]


RMS_SHOWN = 4.0


def _residual_panel(
    shown: SheetPair, whole: Float, at: DetailWindow, panel_px: tuple[int, int] = PANEL_PX
) -> SheetPanel:
    """Show noisy less clean about a middle gray, which is 0; black and white are four times its RMS, or 1 DN."""
    gray = _shrunk(whole, panel_px)
    part = shown.noisy[at.rows, at.columns].astype(np.float64) - shown.clean[at.rows, at.columns]
    reach = [max(RMS_SHOWN * float(np.sqrt(np.mean(one * one))), 1.0) for one in (gray, part)]
    note = f"black to white: +-{reach[0]:.3g} DN (averaged), +-{reach[1]:.3g} DN (one to one)"
    pictures = [_codes((one / dn + 1) / 2) for one, dn in zip((gray, part), reach, strict=True)]
    return SheetPanel("noisy - clean", note, *pictures)


# ----------------------------------------------------------------------------------------------------------- the stages


class ProcessingStep(NamedTuple):
    """A step of the pipeline: what it did, with which numbers, and the function itself, ``[H, W, 3]`` to the same."""

    title: str
    note: Callable[[Plan], str]
    apply: Callable[[Float, Plan], Float]


def _gains_text(plan: Plan) -> str:
    return f"times {', '.join(f'{gain:.3g}' for gain in plan.inverse_gains)}; highlights {plan.highlight}"


PROCESSING_STEPS = (
    ProcessingStep("tone curve undone", lambda plan: plan.tone, lambda v, plan: unprocess.TONES[plan.tone](v, 1 - v)),
    ProcessingStep(
        "gamma undone", lambda plan: f"gamma {plan.gamma}", lambda v, plan: unprocess.expand_gamma(v, plan.gamma)
    ),
    ProcessingStep(
        "colour matrix undone",
        lambda plan: f"camera {plan.camera}",
        lambda u, plan: unprocess.apply_ccm(u, plan.rgb2cam),
    ),
    ProcessingStep(
        "gains undone",
        _gains_text,
        lambda i, plan: unprocess.invert_gains(i, plan.inverse_gains, plan.highlight, plan.highlight_threshold),
    ),
)
"""The steps of the article's Figure 1 up to the mosaic."""


def stages_sheet(shown: SheetPair) -> Picture:
    """Return a picture of the photograph after each step, 0 black and 1 white (the article, Figure 1).

    The steps are done by the readable formulas, on the whole, averaged, and on the part one to one; the last two are
    the frames of the dataset. A mosaic shows each site in the colour of its filter. Raises ValueError where the source
    is not at hand.
    """
    if shown.source is None:
        raise ValueError(f"{shown.key}: there is no source to go through the steps ({shown.missing_source})")
    plan, at = shown.plan, _window(shown)
    whole, part = _reduced(shown.source, at.side), shown.source[at.rows, at.columns] / _white(shown.source)
    panels = [_stage_panel("source", "", whole, part)]
    if plan.dequantize == "dither" and shown.source.dtype == np.uint8:
        part = _dithered(shown, at)
        panels.append(_stage_panel("codes dithered", "by up to half a code", whole, part))
    for step in PROCESSING_STEPS:
        whole, part = step.apply(whole, plan), step.apply(part, plan)
        panels.append(_stage_panel(step.title, step.note(plan), whole, part))
    panels.append(_mosaic_panel("mosaic", plan, mosaic(whole, plan.pattern), mosaic(part, plan.pattern)))
    for name, raw in (("clean", shown.clean), ("noisy", shown.noisy)):
        lights = (to_light(dn, plan) for dn in (binned(raw, at.side), raw[at.rows, at.columns]))
        panels.append(_mosaic_panel(f"{name} raw", plan, *lights))
    last = "mosaics: by their square root"
    if plan.exposure_ratio != 1:
        last += f"; the raw frames, of a scene {plan.exposure_ratio:g} times as dark, as bright as before"
    return _page([*_heading(shown, at)[:2], f"after each step, 0 black and 1 white, not stretched; {last}"], panels)


def _white(srgb: Srgb) -> float:
    return float(np.iinfo(srgb.dtype).max)


def _reduced(srgb: Srgb, side: int) -> Float:
    """Average squares of pixels, ``[H, W, 3]`` codes to values in [0, 1]."""
    height, width = srgb.shape[:2]
    size = max(1, width // side), max(1, height // side)
    return np.asarray(cv2.resize(srgb, size, interpolation=cv2.INTER_AREA), dtype=np.float64) / _white(srgb)


def _dithered(shown: SheetPair, at: DetailWindow) -> Float:
    assert shown.source is not None
    plan, patch = shown.plan, patch_from_row(shown.row)
    origin = patch.y + at.rows.start, patch.x + at.columns.start
    curve = linear_table(plan.tone, plan.gamma, 256)
    return unprocess.dequantise(shown.source[at.rows, at.columns], plan, curve, origin) / 65535


def _stage_panel(title: str, note: str, whole: Float, part: Float) -> SheetPanel:
    return SheetPanel(title, note + _outside(whole), _codes(fitted(whole, PANEL_PX)), _codes(part))


def _mosaic_panel(title: str, plan: Plan, whole: Float, part: Float) -> SheetPanel:
    pictures = [sites(np.sqrt(np.clip(light, 0, 1)), plan.pattern) for light in (whole, part)]
    return SheetPanel(title, plan.pattern + _outside(whole), _codes(fitted(pictures[0], PANEL_PX)), _codes(pictures[1]))


def _outside(values: Float) -> str:
    share = float(((values < 0) | (values > 1)).mean())
    return f"; {share:.2%} lie outside, shown clipped" if share else ""


def sites(values: Float, pattern: str) -> Float:
    """Return each value of a mosaic ``[H, W]`` in the channel of its filter, ``[H, W, 3]``, the others 0."""
    image = np.zeros((*values.shape, 3))
    for (y, x), channel in np.ndenumerate(np.array(tile(pattern))):
        image[y::2, x::2, channel] = values[y::2, x::2]
    return image


# -------------------------------------------------------------------------------------------------- pictures and text


def _codes(values: Float) -> Picture:
    """Return 8-bit codes of gray or RGB values, clipped to [0, 1], ``[H, W, 3]``."""
    codes = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2) if codes.ndim == 2 else codes


def fitted(values: Float | Srgb, panel_px: tuple[int, int]) -> Float:
    """Average values down so that they fit into a panel, or repeat each in whole numbers where they are fewer."""
    height, width = values.shape[:2]
    scale = min(panel_px[0] / height, panel_px[1] / width)
    if scale >= 1:
        return np.asarray(values.repeat(int(scale), axis=0).repeat(int(scale), axis=1), dtype=np.float64)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def _shrunk(mosaic_dn: Float, panel_px: tuple[int, int]) -> Float:
    """Fit a mosaic into a panel; where it shrinks, all four sites take part in each value, or the tile would beat."""
    shrinks = mosaic_dn.shape[0] > panel_px[0] or mosaic_dn.shape[1] > panel_px[1]
    if shrinks and min(mosaic_dn.shape) > 1:
        pairs = mosaic_dn[:-1] + mosaic_dn[1:]
        mosaic_dn = (pairs[:, :-1] + pairs[:, 1:]) / 4
    return fitted(mosaic_dn, panel_px)


PAPER, INK, BLANK = 250, 20, 225
MARGIN_PX = 10
LINE_PX = 17
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42


def _page(
    heading: Sequence[str], panels: Sequence[SheetPanel], panel_px: tuple[int, int] = PANEL_PX, columns: int = COLUMNS
) -> Picture:
    """Lay panels out in rows below a heading: title and note, the whole, and the part where there are parts."""
    width = columns * (panel_px[1] + MARGIN_PX) + MARGIN_PX
    bands = [_text(heading, width, MARGIN_PX)]
    for start in range(0, len(panels), columns):
        row = panels[start : start + columns]
        bands.append(_beside([_text([panel.title, panel.note], panel_px[1]) for panel in row], panel_px[1], width))
        bands.append(_beside([_framed(panel.whole, panel_px) for panel in row], panel_px[1], width))
        if any(panel.part is not None for panel in row):
            bands.append(_beside([_framed(panel.part, panel_px) for panel in row], panel_px[1], width))
    return np.vstack([*bands, _paper(MARGIN_PX, width)])


def _paper(height: int, width: int, gray: int = PAPER) -> Picture:
    return np.full((height, width, 3), gray, dtype=np.uint8)


def _beside(boxes: Sequence[Picture], box_width: int, width: int) -> Picture:
    """Put boxes of one width side by side, the lower ones filled up with paper."""
    band = _paper(max(len(box) for box in boxes) + MARGIN_PX // 2, width)
    for number, box in enumerate(boxes):
        left = MARGIN_PX + number * (box_width + MARGIN_PX)
        band[: len(box), left : left + box_width] = box
    return band


def _framed(picture: Picture | None, panel_px: tuple[int, int]) -> Picture:
    """Put a picture into the middle of its panel, whose empty part is grayer than the paper."""
    box = _paper(*panel_px, gray=BLANK)
    if picture is not None:
        top, left = ((most - length) // 2 for most, length in zip(panel_px, picture.shape, strict=False))
        box[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return box


def _text(paragraphs: Sequence[str], width: int, left: int = 0) -> Picture:
    """Write paragraphs, each from a line of its own; signs that the font missing_source become question marks."""
    lines = [
        line for text in paragraphs for line in wrapped(text.encode("ascii", "replace").decode(), width - 2 * left)
    ]
    box = _paper(LINE_PX * len(lines) + MARGIN_PX // 2, width)
    for number, line in enumerate(lines, start=1):
        cv2.putText(box, line, (left, number * LINE_PX - 4), FONT, FONT_SCALE, (INK, INK, INK), 1, cv2.LINE_AA)
    return box


def wrapped(text: str, width_px: int) -> list[str]:
    """Break text into lines that fit, at blanks where it can be; nothing is left out."""
    lines: list[str] = []
    line = ""
    for word in text.split(" "):
        if line and _width_px(f"{line} {word}") <= width_px:
            line = f"{line} {word}"
            continue
        lines += [line] if line else []
        line = word
        while _width_px(line) > width_px:
            fits = max(1, next(n for n in range(len(line), 0, -1) if n == 1 or _width_px(line[:n]) <= width_px))
            lines, line = [*lines, line[:fits]], line[fits:]
    return [*lines, line] if line else lines


def _width_px(text: str) -> int:
    return int(cv2.getTextSize(text, FONT, FONT_SCALE, 1)[0][0])
