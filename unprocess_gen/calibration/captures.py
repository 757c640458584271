"""List the frames of a folder of captures: what each one is, and the levels of the sensor that recorded them.

Facts come from ``captures.csv``, or from the metadata of raw files and the words dark and flat in their names. A folder
with ``EMVA1288_Data.txt`` is read as that file describes it. A fact that neither states is measured or assumed, with a
note. Frames are decoded by the functions that use them, one at a time.
"""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.raw_files import RAW_FILES, SUFFIXES, list_raw_files
from unprocess_gen.core.tables import read_table, record_of_cells
from unprocess_gen.simulation.reference.cfa import MONO, PATTERNS
from unprocess_gen.sources.raw.decode import read_metadata
from unprocess_gen.sources.raw.mosaics import even_sides, read_mosaic

TABLE, EMVA = "captures.csv", "EMVA1288_Data.txt"
REQUIRED = ("file", "kind", "iso")
OPTIONAL = ("exposure_s", "level", "temperature_c", "black_level_dn", "white_level_dn", "bits", "pattern")
NUMBERS = ("iso", "exposure_s", "temperature_c", "black_level_dn", "white_level_dn", "bits")
SENSOR_FACTS = ("bits", "black_level_dn", "white_level_dn", "pattern")
KIND_NAMES = {"dark": ("dark", "bias"), "flat": ("flat",)}
"""Kinds of frames, and the words by which names state them."""
EMVA_ISO = 100.0
LEAST_SIDE = 32
LEAST_FRAMES = 2
"""Fewest frames of one exposure and level, which show noise."""
SAME_EXPOSURE = 0.05
"""Relative difference of ISO and exposure from metadata, which cameras round."""
APART = 0.03
"""Relative difference of signals from which flats without a stated level are of different levels."""

Number = Annotated[float, Meta(ge=0, le=1e9)]
Pattern = Annotated[str, Meta(pattern=f"^({'|'.join((*PATTERNS, MONO))})$")]


@dataclass(frozen=True, slots=True)
class Capture:
    """One frame: its file, what it is, and the levels of the sensor as far as they are stated.

    ``level`` labels the light of a flat; flats of one ISO, exposure and level belong together. ``pattern`` is a CFA
    pattern or ``MONO``.
    """

    path: Path
    kind: str
    iso: Annotated[float, Meta(gt=0, le=1e9)]
    exposure_s: Number | None = None
    level: str = ""
    black_level_dn: Number | None = None
    white_level_dn: Number | None = None
    pattern: Pattern | None = None
    bits: Annotated[int, Meta(ge=1, le=16)] | None = None
    temperature_c: Annotated[float, Meta(gt=-273, le=1e9)] | None = None

    @property
    def group(self) -> tuple[float, str]:
        """Key that the frames of one ISO and measurement share."""
        return -1.0 if self.exposure_s is None else self.exposure_s, self.level

    def pixels(self) -> NDArray[np.uint16]:
        """Decode the mosaic, uint16 [H, W] with even sides; ConfigError or MachineError."""
        mosaic = read_mosaic(self.path, "calibrate", numbers=True, white_dn=self.white_level_dn).pixels
        if mosaic.dtype not in (np.uint16, np.uint8) or min(mosaic.shape) < LEAST_SIDE:
            actual = f"is {mosaic.dtype} {list(mosaic.shape)}"
            raise ConfigError(
                f"calibrate: {self.path}: {actual}; expected a mosaic of uint16 with sides of {LEAST_SIDE} or more"
            )
        return even_sides(mosaic).astype(np.uint16, copy=False)


@dataclass(frozen=True, slots=True)
class Sensor:
    """Levels and pattern of the sensor that recorded all frames, and the shape of the frames."""

    bits: int
    black_dn: float
    white_dn: float
    pattern: str
    shape: tuple[int, int]

    @property
    def span_dn(self) -> float:
        """White above black."""
        return self.white_dn - self.black_dn


def place_of(frames: Sequence[Capture]) -> str:
    """The name of a measurement for messages: its first frame, ISO and number of frames."""
    first = frames[0]
    light = f", level {first.level}" if first.level else ""
    return f"calibrate: {first.path} ({first.kind}, ISO {first.iso:g}{light}, {len(frames)} frames)"


class CaptureSet(NamedTuple):
    """Frames of a folder, their sensor, digest of all files, and notes for the user, which measurements add to."""

    captures: list[Capture]
    sensor: Sensor
    sha256: str
    notes: list[str]

    def groups(self, kind: str, iso: float) -> Iterator[list[Capture]]:
        """Yield the frames of each exposure and level of one ISO; levels that are not stated follow from the light.

        Single frames are left out with a note.
        """
        groups = defaultdict(list)
        for frame in self.captures:
            if (frame.kind, frame.iso) == (kind, iso):
                groups[frame.group].append(frame)
        for (_, level), frames in sorted(groups.items()):
            has_level = kind == "dark" or level or len(frames) <= 2
            for alike in [frames] if has_level else _by_light(frames, self.sensor.black_dn):
                if len(alike) >= LEAST_FRAMES:
                    yield alike
                else:
                    self.notes.append(f"{place_of(alike)}: one frame shows no noise, and is left out")

    @property
    def isos(self) -> list[float]:
        """ISOs of the frames, in ascending order."""
        return sorted({capture.iso for capture in self.captures})


def read_captures(folder: Path, default: Sensor | None = None) -> CaptureSet:
    """List the frames of a folder; ``default`` has the levels that no file states. ConfigError or MachineError."""
    if not folder.is_dir():
        raise ConfigError(f"calibrate: {folder}: no such folder; expected a folder of raw frames, darks and flats")
    notes: list[str] = []
    with machine_errors(folder):
        if (folder / TABLE).is_file():
            lines = read_table(folder / TABLE, REQUIRED, OPTIONAL, NUMBERS)
            captures = [_listed(folder, place, cells) for place, cells in lines]
        elif (folder / EMVA).is_file():
            captures = list(_from_emva(folder))
        else:
            files, hidden = list_raw_files(folder, SUFFIXES)
            captures = [_named(folder, file) for file in files]
            notes += [f"{folder}: {hidden}"] if hidden else []
        if not captures:
            raise ConfigError(f"calibrate: {folder}: contains no raw frame; expected {', '.join(SUFFIXES)}")
        digests = [file_sha256(capture.path) for capture in captures]
    _check_twins(captures, digests)
    return CaptureSet(captures, _sensor(captures, notes, default), joined_sha256(digests), notes)


def joined_sha256(digests: Iterable[str]) -> str:
    """The SHA-256 of the list of digests, one a line in ascending order."""
    return hashlib.sha256("\n".join(sorted(digests)).encode()).hexdigest()


def _check_twins(captures: Iterable[Capture], digests: Iterable[str]) -> None:
    """Refuse a frame that occurs twice: its noise would cancel. Saturated frames are equal."""
    seen: dict[str, Path] = {}
    for capture, digest in zip(captures, digests, strict=True):
        if digest in seen and int(np.ptp(capture.pixels())) > 0:
            raise ConfigError(f"calibrate: {capture.path}: has the bytes of {seen[digest].name}; remove one of them")
        seen[digest] = capture.path


# ------------------------------------------------------------------------------------------------------------- sources


def _named(folder: Path, file: Path) -> Capture:
    """The frame of a raw file; its name, or the name of its folder, states the kind."""
    name = str(file.relative_to(folder))
    kinds = [kind for kind, words in KIND_NAMES.items() if any(word in name.lower() for word in words)]
    return _listed(folder, f"calibrate: {file}", {"file": name, "kind": kinds[0] if len(kinds) == 1 else ""})


def _listed(folder: Path, place: str, row: Mapping[str, str]) -> Capture:
    """The frame of a line of ``captures.csv``; empty cells follow from the metadata of a raw file."""
    file, kind = folder / row["file"], row["kind"].lower()
    if not file.is_file() or file.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{place}: file={row['file']}: no such frame; expected a file as {', '.join(SUFFIXES)}")
    if kind not in KIND_NAMES:
        raise ConfigError(f"{place}: kind={kind}: expected dark or flat, in {TABLE} or in the name of the file")
    cells = {name: text for name, text in row.items() if name not in ("file", "kind") and text}
    stated = _metadata(file) if file.suffix.lower() in RAW_FILES else {}
    if "iso" not in stated | cells:
        raise ConfigError(f"{place}: iso is empty, and {file.name} does not state it; expected an ISO in {TABLE}")
    capture = record_of_cells({"path": file, "kind": kind} | stated | cells, Capture, place)
    for name in ("iso", "exposure_s"):
        own = getattr(capture, name)
        if own and stated.get(name) and not math.isclose(own, stated[name], rel_tol=SAME_EXPOSURE):
            problem = f"the metadata of {file.name} state {stated[name]:g}; expected frames that are listed as recorded"
            raise ConfigError(f"{place}: {name}={own:g}: {problem}")
    return capture


def _metadata(file: Path) -> dict[str, Any]:
    """The facts of a raw file by the names of `Capture`."""
    facts = read_metadata(file, "calibrate")
    stated = {name: getattr(facts, name) for name in ("iso", "exposure_s", "pattern", "bits")}
    black = None if facts.black_dn is None else sum(facts.black_dn) / len(facts.black_dn)
    stated |= {"black_level_dn": black, "white_level_dn": facts.white_dn}
    assumed = ("bits", "white_level_dn") if facts.white_is_assumed else ()
    return {name: value for name, value in stated.items() if value is not None and name not in assumed}


def _from_emva(folder: Path) -> Iterator[Capture]:
    """Yield the frames of an EMVA 1288 description: those below each line b (flats) or d (darks) are a measurement."""
    path, bits = folder / EMVA, None
    kind, seconds, level = "", 0.0, ""
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] == "v":
            continue
        try:
            if words[0] == "n":
                bits = int(words[1])
            elif words[0] in ("b", "d"):
                kind, seconds = {"b": "flat", "d": "dark"}[words[0]], float(words[1]) * 1e-9
                level = f"of line {number}"
            elif words[0] == "i" and kind:
                file = folder / words[1].replace("\\", "/")
                if not file.is_file():
                    raise ConfigError(f"{path}, line {number}: {words[1]}: no such file; restore it")
                yield Capture(file, kind, EMVA_ISO, seconds, level, pattern=MONO, bits=bits)
            else:
                raise ValueError
        except (ValueError, IndexError):
            raise ConfigError(f"{path}, line {number}: {line!r}: expected v, n, b, d or i and its values") from None


# -------------------------------------------------------------------------------------------------------------- sensor


def _sensor(captures: list[Capture], notes: list[str], default: Sensor | None) -> Sensor:
    """The sensor of all frames; levels that no file states are measured, with a note."""
    files = {capture.path: capture for capture in captures}
    bits, black, white, pattern = (common(files, name) for name in SENSOR_FACTS)
    if default is not None:
        bits, pattern = bits or default.bits, pattern or default.pattern
        black, white = default.black_dn if black is None else black, white or default.white_dn
    height, width = captures[0].pixels().shape
    if bits is None:
        brightest = max(int(capture.pixels().max()) for capture in captures) if white is None else int(white)
        bits = next(number for number in (8, 10, 12, 14, 16) if brightest < 2**number)
        notes.append(f"bits={bits}: not stated, follows from the largest value, {brightest} DN")
    if white is None:
        white = 2.0**bits - 1
        notes.append(f"white_level_dn={white:g}: not stated, the largest value of {bits} bits is assumed")
    darks = [capture for capture in captures if capture.kind == "dark"]
    if black is None and darks:
        shortest = min(darks, key=lambda capture: capture.exposure_s or 0.0)
        black = float(np.rint(shortest.pixels().mean()))
        notes.append(f"black_level_dn={black:g}: not stated, rounded mean of {shortest.path.name}")
    if pattern is None:
        notes.append("pattern=RGGB: not stated, and assumed; only the names of the sites depend on it")
    if not (black or 0.0) < white < 2**bits:
        raise ConfigError(
            f"calibrate: black_level_dn={black:g}, white_level_dn={white:g}, bits={bits}: expected black below white "
            "within the bits; correct them in captures.csv"
        )
    return Sensor(bits, float(round(black or 0.0)), float(round(white)), pattern or "RGGB", (height, width))


def common(files: Mapping[Path, Any], name: str) -> Any:
    """The fact that all files have; ConfigError names the first file that differs."""
    (first, facts), *others = files.items()
    expected = getattr(facts, name)
    for path, other in others:
        if getattr(other, name) != expected:
            raise ConfigError(
                f"calibrate: {path}: {name}={getattr(other, name)}: {first.name} has {expected}; expected frames of "
                "one camera and mode; remove those that differ"
            )
    return expected


def _by_light(frames: Iterable[Capture], black_dn: float) -> Iterator[list[Capture]]:
    """Yield flats of nearly the same mean signal, with a number for their level."""
    signals = {frame: float(frame.pixels().mean()) - black_dn for frame in frames}
    ordered = sorted(signals, key=lambda frame: signals[frame])
    values = np.array([signals[frame] for frame in ordered])
    starts = 1 + np.flatnonzero(values[1:] > np.maximum(values[:-1] * (1 + APART), 0.0))
    for number, places in enumerate(np.split(np.arange(len(ordered)), starts), start=1):
        yield [replace(ordered[place], level=f"{number}") for place in places]
