"""Manifest rows: what a row holds, flattened from records and rebuilt from cells.

A row has a file and its state (`Origin`), the plan of the pair, and what was measured (`Measured`). `COLUMNS` are the
fields of these records, in their order. A row maps each column to a typed value; where a column does not apply, text is
empty and a number is None.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any

from unprocess_gen.core.arrays import FLOAT32
from unprocess_gen.core.errors import DamageError
from unprocess_gen.core.fields import (
    FAILED,
    Choice,
    Condition,
    Field,
    Integers,
    Limit,
    Numbers,
    Text,
)
from unprocess_gen.core.files import leads_outside
from unprocess_gen.core.records import check_record, parse_record
from unprocess_gen.core.source import Source
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Column, Row, Value, flatten, places_of, rebuild
from unprocess_gen.dataset.keys import burst_key, key_text
from unprocess_gen.simulation.conditions import CLIPS, LIGHT, LINEAR, NOISY_FRAMES
from unprocess_gen.simulation.effects import dark_variance_dn2
from unprocess_gen.simulation.frames import PATCHES, Counts, Pair, Patch
from unprocess_gen.simulation.plan import ANY_TEXT, COUNT, FINITE, HEX_128, HEX_256, Plan, PlanRecord

MAX_PATH = 2**15
"""Characters of the percent-encoded path of a source."""

MAX_DETAIL = 300
"""Characters of the column ``detail``."""

FRAME_BYTES = 2**33 - 1024
"""Most bytes of one array: a member of a USTAR archive has less than 8 GiB."""

TARGET_BYTES = 12
"""Most bytes of a pixel of a target: three of float32."""

FRAMES = Condition("output.frames is false", lambda config: config.output.frames)
FOUND_FILES = Condition("the sources are synthetic pictures", lambda config: config.source.place is not None)
STORED_TARGETS = Condition("output.targets is empty", lambda config: bool(config.output.targets))

KEY_TEXT = Text(
    r"\d{8,12}(-p\d{4,12})?(-f\d\d)?(-l\d\dd\d\d)?", "eight digits, then -pNNNN, -fNN and -lNNdNN if present"
)


def _is_relative(value: Any) -> bool:
    """Check that a percent-encoded path is below the source folder, so that nothing outside it is looked up."""
    if not ANY_TEXT.allows(value) or not 0 < len(value) <= MAX_PATH:
        return False
    path = re.sub("%([0-9A-F]{2})", lambda match: chr(int(match[1], 16)), value)
    return not leads_outside(path) and "\0" not in path


RELATIVE_PATH = Limit("a path below the source folder, relative and without .. segments", _is_relative)


class Origin(PlanRecord, frozen=True, kw_only=True):
    """Source of a row, its state, and the part of it that the frames show."""

    # fmt: off
    key: Annotated[str, Field(
        "source index as eight digits, then number of patch, frame of a burst, level and draw if there are several",
        KEY_TEXT, empty_if="")]
    source: Annotated[str, Field(
        "path below the source folder, percent-encoded where unsafe", RELATIVE_PATH, empty_if="")]
    source_sha256: Annotated[str, Field("SHA-256 of the source's bytes", HEX_256, empty_if="the source cannot be read")]
    source_bytes: Annotated[int | None, Field(
        "size of the source; 0 for a synthetic picture", COUNT, "bytes", empty_if="there is no readable file")]
    status: Annotated[str, Field(
        "ok, failed if the source could not be used, or filtered if source.min_side leaves it out (other cells are "
        "then as for failed)", Choice("ok", "failed", "filtered"), empty_if="")] = "ok"
    reason: Annotated[str, Field(
        "reason of the status", Text("[a-z0-9_]*", "a reason such as corrupt"), empty_if="the status is ok")] = ""
    detail: Annotated[str, Field(
        "explanation of the reason, one line; with status ok, what the user should know about the source", ANY_TEXT,
        empty_if="there is nothing to explain")] = ""
    patch: Patch | None = None
    orientation: Annotated[int | None, Field(
        "EXIF orientation that was applied to the source, 1 to 8", Integers(1, 8))] = None
    shard: Annotated[int, Field("number of the shard", Integers(0, 10**9), empty_if="")]
    clip: Annotated[str, Field(
        "name of the clip; for a burst, the key of its source or patch", ANY_TEXT, needs=CLIPS)] = ""
    # fmt: on


class Measured(PlanRecord, frozen=True, kw_only=True):
    """Results that were computed from a pair."""

    # fmt: off
    dark_variance_dn2: Annotated[float, Field(
        "noise variance of a site at black, by all simulated effects except hot pixels, dead pixels and rounding, and "
        "without the fixed patterns of the clean frame; ug.noise_std uses it", FINITE, "DN²")]
    clean_xxh3: Annotated[str, Field("XXH3-128 of the clean array's little-endian bytes", HEX_128, needs=FRAMES)]
    noisy_xxh3: Annotated[str, Field("XXH3-128 of the noisy array's little-endian bytes", HEX_128, needs=FRAMES)]
    targets: Annotated[str, Field(
        f"the stored target with dtype and XXH3-128: {LINEAR_RGB}:float32:…",
        Text(f"({LINEAR_RGB}:float32:[0-9a-f]{{32}})?", "name:dtype:digest of a target"), needs=STORED_TARGETS)] = ""
    counts: Annotated[Counts | None, FRAMES]
    source_noise_dn: Annotated[float | None, Field(
        "estimated noise of the source itself, in the green plane of the clean frame", Numbers(0), "DN",
        needs=FOUND_FILES, empty_if=f"{FAILED}, is that of a burst, or no tile of 32 x 32 pixels is free of clipping")]
    # fmt: on


AFTER = {
    "clip": "split", "patch": "frame", "patch_y": "patch", "patch_x": "patch_y", "dark_variance_dn2": "b_dn2",
}  # fmt: skip
"""Columns that follow another one than the field before theirs, so that numbers of frame and patch are together, and
variances too."""


def _in_order(records: Iterable[type[PlanRecord]]) -> tuple[Column, ...]:
    """Columns of records, moved behind those of `AFTER`."""
    columns = {column.name: column for record in records for place in places_of(record) for column in place.columns}
    names = [name for name in columns if name not in AFTER]
    for name, before in AFTER.items():
        names.insert(names.index(before) + 1, name)
    return tuple(columns[name] for name in names)


COLUMNS = _in_order((Origin, Plan, Measured))
"""All columns, in the order of ``manifest.csv``."""

COLUMN_NAMES = tuple(column.name for column in COLUMNS)


def columns_of(config: Any) -> tuple[str, ...]:
    """Names of the columns of a manifest: those that the settings of a config can fill."""
    return tuple(column.name for column in COLUMNS if column.needs.holds(config))


# ---------------------------------------------------------------------------------------------------------------- rows


def pair_row(
    key: str,
    source: Source,
    sha256: str,
    orientation: int,
    shard: int,
    plan: Plan,
    pair: Pair | None,
    digests: tuple[str, str],
    patch: Patch,
    source_noise_dn: float | None = None,
    note: str = "",
) -> Row:
    """Row of a pair; ``note`` is about the source.

    ``sha256`` is that of the source's bytes, ``orientation`` the EXIF orientation that was applied, ``digests`` the
    XXH3-128 of the clean and of the noisy array. A manifest without frames has no pair and empty digests.
    """
    clip = source.clip or (burst_key(key) if plan.motion else "")
    uses = {
        NOISY_FRAMES: "-l" in key,
        PATCHES: "-p" in key or any(patch.origin),
        CLIPS: bool(clip),
        LINEAR: plan.source.is_linear,
        LIGHT: plan.source.is_linear or plan.motion is not None,
    }
    origin = Origin(
        key=key,
        source=source.name,
        source_sha256=sha256,
        source_bytes=source.size_bytes,
        detail=detail_text(note),
        patch=patch,
        orientation=orientation,
        shard=shard,
        clip=clip,
    )
    measured = Measured(
        dark_variance_dn2=dark_variance_dn2(plan),
        clean_xxh3=digests[0],
        noisy_xxh3=digests[1],
        counts=None if pair is None else pair.counts,
        source_noise_dn=source_noise_dn,
    )
    unused = [condition for condition, is_used in uses.items() if not is_used]
    return _complete(
        {name: cell for record in (origin, plan, measured) for name, cell in flatten(record, unused).items()}
    )


def failed_row(
    source: Source, sha256: str | None, shard: int, seed: int, reason: str, detail: str = "", status: str = "failed"
) -> Row:
    """Row of a source that could not be used (``reason`` is one of `errors.REASONS`) or was filtered."""
    origin = Origin(
        key=key_text(source.index),
        source=source.name,
        source_sha256=sha256 or "",
        source_bytes=source.size_bytes,
        status=status,
        reason=reason,
        detail=detail_text(detail),
        shard=shard,
    )
    return _complete({**flatten(origin), "seed": seed})


def _complete(cells: Mapping[str, Value]) -> Row:
    return {column.name: cells.get(column.name, column.empty) for column in COLUMNS}


def detail_text(text: str) -> str:
    """Explanation as one line of at most `MAX_DETAIL` characters, none of them control or bidirectional.

    A space precedes a leading ``= + - @``, so that spreadsheets do not run it.
    """
    line = " ".join(_UNSAFE.sub("?", " ".join(text.split())).split())
    line = f" {line}" if line.startswith(("=", "+", "-", "@")) else line
    return line if len(line) <= MAX_DETAIL else line[: MAX_DETAIL - 1] + "…"


_UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def plan_from_row(row: Row) -> Plan:
    """Plan that a row of a pair holds; with the pixels of its source it gives the arrays.

    DamageError if a value is missing, of another type or not allowed.
    """
    try:
        plan = rebuild(Plan, row)
        sensor, physics = plan.sensor, plan.physics
        if not sensor.black_level_dn < sensor.white_level_dn < 2**sensor.bits:
            raise ValueError(
                f"white_level_dn={sensor.white_level_dn}: expected more than black_level_dn={sensor.black_level_dn} "
                f"and less than 2^{sensor.bits} (bits)"
            )
        if physics is not None and not physics.dn_per_e > 0:
            raise ValueError(f"dn_per_e={physics.dn_per_e}: expected more than 0")
    except ValueError as error:
        raise DamageError(f"row {_key_of(row)}: not a plan ({error})") from error
    return plan


def patch_from_row(row: Row) -> Patch:
    """Part of the full frame that a row's pair shows; DamageError if a value is not allowed."""
    try:
        return rebuild(Patch, row)
    except ValueError as error:
        raise DamageError(f"row {_key_of(row)}: not a patch ({error})") from error


def _key_of(row: Row) -> str:
    return str(row.get("key"))[:40]


def has_frames(row: Row) -> bool:
    """True if the frames of a row are stored: not for failed sources, nor with ``output.frames=false``."""
    return row["status"] == "ok" and bool(row["clean_xxh3"])


_NEEDED_TO_PLAN = "width", "height", "shard", "dtype", "layout", "pattern"
_NEEDED = *_NEEDED_TO_PLAN, "clean_xxh3", "noisy_xxh3"
"""Columns without which the members of a pair can neither be found nor checked."""

_FRAME_COLUMNS = "clean_xxh3", "noisy_xxh3", "targets", *Counts.__struct_fields__
"""Columns that depend on frames; all of them are empty in a manifest without frames."""


def check_row(row: Row) -> None:
    """Raise ValueError for cells that are allowed one by one, but cannot be a row together."""
    if not row["status"]:
        raise ValueError("status is empty")
    if row["status"] != "ok":
        return
    for name in _NEEDED if any(row[name] not in (None, "") for name in _FRAME_COLUMNS) else _NEEDED_TO_PLAN:
        if row[name] is None or row[name] == "":
            raise ValueError(f"{name} is empty")
    target_bytes = TARGET_BYTES * int(row["burst_downscale"] or 1) ** 2
    largest = target_bytes if row["targets"] else 4 if FLOAT32 in (row["dtype"], row["clean_dtype"]) else 2
    size = int(row["width"] or 0) * int(row["height"] or 0) * largest
    if size > FRAME_BYTES:
        raise ValueError(
            f"width={row['width']}, height={row['height']}: an array of {size} bytes; expected at most {FRAME_BYTES}"
        )


# ---------------------------------------------------------------------------------------------------------------- JSON

OTHERS = "others"
"""Key of a sample's JSON for its other rows: the cells that differ from the first row."""


def row_json(rows: Sequence[Row]) -> bytes:
    """JSON of a sample in ASCII: its first row without empty cells, and in `OTHERS` how others differ."""
    first, *others = rows
    content: dict[str, Any] = without_empty(first)
    if others:
        content[OTHERS] = [{name: row[name] for name in row if row[name] != first[name]} for row in others]
    return json.dumps(content, separators=(",", ":")).encode("ascii") + b"\n"


def rows_of_json(content: bytes) -> list[Row]:
    """Rows of a sample from its JSON; ValueError if it is not that of `row_json`."""
    first = parse_record(content, dict[str, Any])
    others = check_record(first.pop(OTHERS, []), list[dict[str, Any]])
    return [_complete(first | cells) for cells in ({}, *others)]


def without_empty(row: Row) -> dict[str, Value]:
    """Cells of a row that are not empty."""
    return {name: value for name, value in row.items() if value not in (None, "")}
