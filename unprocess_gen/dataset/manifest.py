"""The manifest: one row a pair, and a row is a plan. Its columns stand in one tuple.

A row is built once, by `pair_row` or `failed_row`, as a mapping from column to typed value; where a column does not
apply, text is empty and a number None. In CSV, floats are Python's shortest round-trip spelling, so that a row read
back is the same plan bit for bit. In the shards each row also stands as JSON, padded with blanks to a size that depends
on the source's name alone: the size of a shard can then be told before it is made.
"""

from __future__ import annotations

import contextlib
import csv
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TextIO

from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.types import Pair, Patch, Physics, Plan, Row, Source, Value, gamma_text
from unprocess_gen.dataset.keys import KEY, key_text
from unprocess_gen.simulation.reference.colour import matrix


@dataclass(frozen=True, slots=True)
class Column:
    """One column: its name, its type and what it holds."""

    name: str
    type: Callable[[str], str | int | float]
    meaning: str

    @property
    def empty(self) -> Value:
        """What an empty cell reads as: no text, or no number."""
        return "" if self.type is str else None


def number_or_text(cell: str) -> str | int | float:
    """Read a cell that holds a number, or a word instead."""
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


COLUMNS = (
    Column("key", str, "source index as eight digits; then patch, and level and draw, where there are several"),
    Column("source", str, "path below the source folder, percent-encoded where unsafe"),
    Column("source_sha256", str, "SHA-256 of the source's bytes"),
    Column("source_bytes", int, "size of the source; 0 for a built-in scene"),
    Column("status", str, "ok or failed"),
    Column("reason", str, "why it failed"),
    Column("width", int, "of the arrays; twice that of packed planes"),
    Column("height", int, "of the arrays; twice that of packed planes"),
    Column("orientation", int, "EXIF orientation that was applied to the source, 1 to 8"),
    Column("shard", int, "number of the shard"),
    Column("seed", int, "seed of the run"),
    Column("stream_key", str, "key of the image's random streams, 16 hex digits"),
    Column("camera", str, "convex, or the camera"),
    Column("w_nexus_6p", float, "weight of this camera in the mix; 0 where it is not part of it"),
    Column("w_sony_a7r", float, "weight of this camera in the mix; 0 where it is not part of it"),
    Column("w_olympus_em10", float, "weight of this camera in the mix; 0 where it is not part of it"),
    Column("w_sony_rx100", float, "weight of this camera in the mix; 0 where it is not part of it"),
    *(Column(f"rgb2cam_{i}{j}", float, "linear sRGB to camera, row and column") for i in range(3) for j in range(3)),
    Column("red_gain", float, "forward white-balance gain of red"),
    Column("blue_gain", float, "forward white-balance gain of blue"),
    Column("inverse_rgb_gain", float, "inverse of the brightening gain; all channels are multiplied by it"),
    Column("tone", str, "tone curve that was inverted: smoothstep or none"),
    Column("gamma", number_or_text, "gamma that was expanded: a number or srgb"),
    Column("highlight", str, "per_channel, gray_mean or none"),
    Column("highlight_threshold", float, "intensity above which highlights are kept"),
    Column("pattern", str, "Bayer pattern of the top-left 2x2 sites"),
    Column("bits", int, "of the sensor"),
    Column("black_level_dn", int, "DN of no light"),
    Column("white_level_dn", int, "DN of saturation"),
    Column("sensor_clip", str, "how the noisy frame was clipped: sensor, black or none"),
    Column("noise", str, "name of the noise profile"),
    Column("a_dn", float, "slope of the noise variance, DN: variance = a_dn (x - black) + b_dn2"),
    Column("b_dn2", float, "noise variance at black, DN²"),
    Column("effects", str, "what was simulated, in order, separated by ;"),
    Column("skipped", str, "what was not, each with its reason, separated by ;"),
    Column("accuracy", str, "the accuracy asked for"),
    Column("methods", str, "how each stage was computed, separated by ;"),
    Column("clean_xxh3", str, "XXH3-128 of the clean array's little-endian bytes"),
    Column("noisy_xxh3", str, "XXH3-128 of the noisy array's little-endian bytes"),
    Column("clean_clipped_low", int, "clean sites below black before clipping"),
    Column("clean_clipped_high", int, "clean sites above white before clipping"),
    Column("noisy_clipped_low", int, "noisy sites below the lowest DN before clipping"),
    Column("noisy_clipped_high", int, "noisy sites above the highest DN before clipping"),
    Column("saturated", int, "clean sites at the white level"),
    Column("zero_variance", int, "sites to which the noise law gives no variance"),
    Column("law_distance", float, "how far the distribution of shot and read noise may be from its law, at most"),
    Column("scene", str, "what the scene was taken for"),
    Column("exposure_ratio", float, "what the scene was darkened by"),
    Column("saturated_as", str, "what noisy sites are where the clean ones are saturated: noisy, or pinned to white"),
    Column("noise_law", str, "of a two-parameter profile: gaussian or poisson"),
    Column(
        "iso", float, "ISO of a physical profile; this and all columns to its right are 0 or none for other profiles"
    ),
    Column("exposure_s", float, "exposure time, seconds"),
    Column("temperature_c", float, "of the sensor, degrees Celsius"),
    Column("dn_per_e", float, "system gain K, DN per electron"),
    Column("prnu_std", float, "relative deviation of the pixels' responses"),
    Column("dark_e", float, "mean dark current of the exposure, electrons"),
    Column("dark_offset", str, "whether its mean was removed or kept"),
    Column("hot_pixel_share", float, "share of pixels that are hot"),
    Column("hot_pixel_e", float, "mean excess of a hot pixel in the exposure, electrons"),
    Column("full_well_e", float, "electrons that a pixel holds; 0: not known"),
    Column("read_law", str, "gaussian or tukey"),
    Column("read_shape", float, "shape of Tukey's lambda law"),
    Column("read_std_dn", float, "deviation of the read noise, DN"),
    Column("row_std_dn", float, "deviation of a row's offset, DN"),
    Column("column_std_dn", float, "deviation of a column's offset, DN"),
    *(
        Column(f"black_error_dn_{i}{j}", float, "error of the black level at row, column of the 2x2 sites, DN")
        for i in range(2)
        for j in range(2)
    ),
    Column("dead_pixel_share", float, "share of pixels that read 0"),
    Column("sensor_unit", str, "the camera body"),
    Column("body_key", str, "key of the body's fixed patterns, 16 hex digits"),
    Column("fixed_pattern_in_clean", int, "1 where the clean frame has the fixed patterns too"),
    Column("level", int, "number of the noise level"),
    Column("draw", int, "number of the draw at this level"),
    Column("frame", int, "number of the frame in its clip"),
    Column("clip", str, "the clip"),
    Column("downscale", int, "side of the squares of source pixels that were averaged"),
    Column("dequantize", str, "whether 8-bit codes were dithered: off or dither"),
    Column("patch", int, "number of the patch in its image; 0 for a whole image too"),
    Column("patch_y", int, "row of the full frame in which the arrays begin; even"),
    Column("patch_x", int, "column of the full frame in which the arrays begin; even"),
    Column("dtype", str, "of the arrays: uint16, DN, or float32, 0 at black and 1 at white"),
    Column("layout", str, "of the arrays: mosaic, or packed planes"),
)
NAMES = tuple(column.name for column in COLUMNS)

JSON_BYTES = 5632
"""Room for a row without its source's name: the longest numbers and reasons in every column take less."""


def pair_row(
    key: str,
    source: Source,
    sha256: str,
    orientation: int,
    shard: int,
    plan: Plan,
    pair: Pair,
    digests: tuple[str, str],
    patch: Patch,
) -> Row:
    """Return the row of a pair; ``digests`` are the XXH3-128 of clean and noisy."""
    values: dict[str, Value] = {
        "status": "ok",
        "width": patch.width,
        "height": patch.height,
        "orientation": orientation,
        "stream_key": f"{plan.stream_key:016x}",
        "camera": plan.camera,
        **dict(zip(_WEIGHTS, plan.weights, strict=True)),
        **dict(zip(_MATRIX, plan.rgb2cam, strict=True)),
        "red_gain": plan.red_gain,
        "blue_gain": plan.blue_gain,
        "inverse_rgb_gain": plan.inverse_rgb_gain,
        "tone": plan.tone,
        "gamma": number_or_text(gamma_text(plan.gamma)),
        "highlight": plan.highlight,
        "highlight_threshold": plan.highlight_threshold,
        "pattern": plan.pattern,
        "bits": plan.bits,
        "black_level_dn": plan.black_level_dn,
        "white_level_dn": plan.white_level_dn,
        "sensor_clip": plan.sensor_clip,
        "noise": plan.noise,
        "a_dn": plan.a_dn,
        "b_dn2": plan.b_dn2,
        "effects": ";".join(plan.effects),
        "skipped": ";".join(plan.skipped),
        "accuracy": plan.accuracy,
        "methods": ";".join(plan.methods),
        "clean_xxh3": digests[0],
        "noisy_xxh3": digests[1],
        "clean_clipped_low": pair.counts.clean_clipped_low,
        "clean_clipped_high": pair.counts.clean_clipped_high,
        "noisy_clipped_low": pair.counts.noisy_clipped_low,
        "noisy_clipped_high": pair.counts.noisy_clipped_high,
        "saturated": pair.counts.saturated,
        "zero_variance": pair.counts.zero_variance,
        "scene": plan.scene,
        "exposure_ratio": plan.exposure_ratio,
        "law_distance": plan.law_distance,
        "saturated_as": plan.saturated,
        "noise_law": plan.noise_law,
        **_physics_values(plan.physics),
        "level": plan.level,
        "draw": plan.draw,
        "frame": plan.frame,
        "clip": source.clip,
        "downscale": plan.downscale,
        "dequantize": plan.dequantize,
        "patch": patch.number,
        "patch_y": patch.y,
        "patch_x": patch.x,
        "dtype": plan.dtype,
        "layout": plan.layout,
    }
    return _row(source, sha256, shard, plan.seed, values | {"key": key})


def _physics_values(physics: Physics | None) -> dict[str, Value]:
    if physics is None:
        return {
            column.name: "none" if column.type is str else column.type("0")
            for column in COLUMNS[_PHYSICS_FROM:_PHYSICS_TO]
        }
    return {
        **{name: getattr(physics, name) for name in _PHYSICS},
        **dict(zip(_BLACK_ERRORS, physics.black_error_dn, strict=True)),
        "body_key": f"{physics.body_key:016x}",
        "fixed_pattern_in_clean": int(physics.fixed_pattern_in_clean),
    }


def failed_row(source: Source, sha256: str | None, shard: int, seed: int, reason: str) -> Row:
    """Return the row of a photograph that could not be used; ``sha256`` is None where it could not even be read.

    A frame of a video is told by its number alone, so its row has it even then.
    """
    place: dict[str, Value] = {"frame": source.frame, "clip": source.clip} if source.is_video else {}
    return _row(source, sha256, shard, seed, {"status": "failed", "reason": reason, **place})


_WEIGHTS = tuple(name for name in NAMES if name.startswith("w_"))
_MATRIX = tuple(name for name in NAMES if name.startswith("rgb2cam_"))
_PHYSICS_FROM, _PHYSICS_TO = NAMES.index("iso"), NAMES.index("level")
_BLACK_ERRORS = tuple(name for name in NAMES if name.startswith("black_error_dn_"))
_PHYSICS = tuple(
    field.name
    for field in fields(Physics)
    if field.name not in ("black_error_dn", "body_key", "fixed_pattern_in_clean")
)


def _row(source: Source, sha256: str | None, shard: int, seed: int, values: dict[str, Value]) -> Row:
    known: dict[str, Value] = {
        "key": key_text(source.index),
        "source": source.name,
        "source_sha256": sha256 or "",
        "source_bytes": source.size_bytes,
        "shard": shard,
        "seed": seed,
    }
    known |= {name: value for name, value in values.items() if value is not None}
    return {column.name: known.get(column.name, column.empty) for column in COLUMNS}


def plan_from_row(row: Row) -> Plan:
    """Return the plan that a row holds: replay needs the row and the source, nothing else.

    Raises DamageError where a value is missing or of another type.
    """
    try:
        w0, w1, w2, w3 = (_float(row, name) for name in _WEIGHTS)
        return Plan(
            seed=_int(row, "seed"),
            stream_key=int(_str(row, "stream_key"), 16),
            downscale=_int(row, "downscale"),
            dequantize=_str(row, "dequantize"),
            scene=_str(row, "scene"),
            exposure_ratio=_float(row, "exposure_ratio"),
            camera=_str(row, "camera"),
            weights=(w0, w1, w2, w3),
            rgb2cam=matrix([_float(row, name) for name in _MATRIX]),
            red_gain=_float(row, "red_gain"),
            blue_gain=_float(row, "blue_gain"),
            inverse_rgb_gain=_float(row, "inverse_rgb_gain"),
            tone=_str(row, "tone"),
            gamma="srgb" if row["gamma"] == "srgb" else _float(row, "gamma"),
            highlight=_str(row, "highlight"),
            highlight_threshold=_float(row, "highlight_threshold"),
            pattern=_str(row, "pattern"),
            bits=_int(row, "bits"),
            black_level_dn=_int(row, "black_level_dn"),
            white_level_dn=_int(row, "white_level_dn"),
            sensor_clip=_str(row, "sensor_clip"),
            saturated=_str(row, "saturated_as"),
            noise=_str(row, "noise"),
            noise_law=_str(row, "noise_law"),
            a_dn=_float(row, "a_dn"),
            b_dn2=_float(row, "b_dn2"),
            effects=_list(row, "effects"),
            skipped=_list(row, "skipped"),
            accuracy=_str(row, "accuracy"),
            methods=_list(row, "methods"),
            law_distance=_float(row, "law_distance"),
            physics=_physics_of(row),
            level=_int(row, "level"),
            draw=_int(row, "draw"),
            frame=_int(row, "frame"),
            dtype=_str(row, "dtype"),
            layout=_str(row, "layout"),
        )
    except (TypeError, ValueError) as error:
        raise DamageError(f"row {row.get('key')}: not a plan ({error})") from error


def patch_from_row(row: Row) -> Patch:
    """Return what of the full frame a row's pair is; DamageError as `plan_from_row`."""
    try:
        number, y, x, height, width = (_int(row, name) for name in ("patch", "patch_y", "patch_x", "height", "width"))
    except ValueError as error:
        raise DamageError(f"row {row.get('key')}: not a patch ({error})") from error
    return Patch(number, y, x, height, width)


def _physics_of(row: Row) -> Physics | None:
    if row["read_law"] == "none":
        return None
    texts = ("dark_offset", "read_law", "sensor_unit")
    e0, e1, e2, e3 = (_float(row, name) for name in _BLACK_ERRORS)
    values: dict[str, Any] = {name: (_str if name in texts else _float)(row, name) for name in _PHYSICS}
    return Physics(
        **values,
        black_error_dn=(e0, e1, e2, e3),
        body_key=int(_str(row, "body_key"), 16),
        fixed_pattern_in_clean=bool(_int(row, "fixed_pattern_in_clean")),
    )


def _float(row: Row, name: str) -> float:
    return float(_present(row, name))


def _int(row: Row, name: str) -> int:
    return int(_present(row, name))


def _str(row: Row, name: str) -> str:
    return str(_present(row, name))


def _list(row: Row, name: str) -> tuple[str, ...]:
    text = row.get(name)
    return tuple(str(text).split(";")) if text else ()


def _present(row: Row, name: str) -> str | int | float:
    value = row.get(name)
    if value is None or value == "":
        raise ValueError(f"{name} is empty")
    return value


# ------------------------------------------------------------------------------------------------------------- CSV


def write_rows(stream: TextIO, rows: Iterable[Row]) -> None:
    """Write rows as CSV: ``\\n`` line ends, quotes only where needed, empty for None."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(NAMES)
    writer.writerows([_cell(row[name]) for name in NAMES] for row in rows)


def _cell(value: Value) -> str:
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def read_rows(path: Path) -> Iterator[Row]:
    """Yield the typed rows of a manifest, one at a time; unknown columns are left out.

    Raises DamageError where the file is not a manifest or a value does not fit its column.
    """
    return (row for _, row in rows_with_offsets(path))


def rows_with_offsets(path: Path) -> Iterator[tuple[int, Row]]:
    """Yield each row with the byte that it begins at; a row is one line, since names have no line ends in them.

    Raises DamageError as `read_rows` does.
    """
    try:
        with path.open("rb") as stream:
            header = _header(stream.readline(), path)
            at = stream.tell()
            for line in stream:
                yield at, _typed(header, line)
                at += len(line)
    except (csv.Error, ValueError) as error:
        raise DamageError(f"{path}: not a readable manifest ({error})") from error
    except FileNotFoundError:
        raise DamageError(f"{path}: no such manifest") from None


def readable_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of those lines of a damaged manifest that still read as rows; none where there is no file."""
    try:
        lines = path.read_bytes().splitlines(keepends=True)
    except OSError:
        return
    for line in lines[1:]:
        with contextlib.suppress(csv.Error, ValueError):
            yield _typed(NAMES, line)


def read_row(path: Path, at: int) -> Row:
    """Return the row that begins at a byte told by `rows_with_offsets`; DamageError where none does."""
    try:
        with path.open("rb") as stream:
            header = _header(stream.readline(), path)
            stream.seek(at)
            return _typed(header, stream.readline())
    except (csv.Error, ValueError, OSError) as error:
        raise DamageError(f"{path}: no row at byte {at} ({error})") from error


def _header(line: bytes, path: Path) -> list[str]:
    header = _cells(line)
    missing = [name for name in NAMES if name not in header]
    if missing:
        raise DamageError(f"{path}: not a manifest, column {missing[0]} is missing")
    return header


def _cells(line: bytes) -> list[str]:
    return next(csv.reader([line.decode("utf-8")], strict=True), [])


def _typed(header: Sequence[str], line: bytes) -> Row:
    if not line.endswith(b"\n"):
        raise ValueError("the last line is cut")
    cells = dict(zip(header, _cells(line), strict=True))
    if not KEY.fullmatch(cells["key"]):
        raise ValueError(f"the key is {cells['key'][:40]!r}, expected eight digits")
    return {column.name: column.type(cell) if (cell := cells[column.name]) else column.empty for column in COLUMNS}


# ------------------------------------------------------------------------------------------------------------ JSON


def json_size(source_name: str, pairs: int = 1) -> int:
    """Return the bytes of a sample's JSON in the shard, padding included: its source's name and its pairs decide."""
    named = 2 * len(json.dumps(source_name))  # its clip is named by a part of it, a video's by all of it
    return -(-(JSON_BYTES + named) * pairs // 512) * 512


OTHERS = "others"
"""The key under which a sample's JSON holds the rows of its pairs but the first."""


def row_json(rows: Sequence[Row]) -> bytes:
    """Return a sample's rows as typed JSON: the first one, and the others in a list; padded to `json_size`."""
    first, others = dict(rows[0]), [dict(row) for row in rows[1:]]
    content = first | {OTHERS: others} if others else first
    text = json.dumps(content, separators=(",", ":")).encode("ascii")
    size = json_size(str(first["source"]), len(rows))
    if len(text) >= size:
        raise ValueError(f"row {first['key']} takes {len(text)} bytes as JSON, more than the {size} set aside")
    return text.ljust(size - 1) + b"\n"


def rows_of_json(content: dict[str, Any]) -> list[Row]:
    """Return the rows that a sample's JSON holds."""
    others = content.pop(OTHERS, [])
    return [content, *others]
