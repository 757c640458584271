"""Read pairs of a noisy and a clean frame that cameras recorded, raw or sRGB: the lines of ``pairs.csv``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unprocess_gen.calibration.captures import Number, Pattern
from unprocess_gen.calibration.picture_pairs import SUFFIXES, TABLE, read_picture
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import ConfigError, SourceError, refused_files
from unprocess_gen.core.files import file_sha256, leads_outside, machine_errors
from unprocess_gen.core.tables import read_table, record_of_cells
from unprocess_gen.dataset.columns import flatten
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.reports.scoring.items import Item, Items
from unprocess_gen.reports.scoring.metrics import Scores, frame_scores, raw_scores, scores_of
from unprocess_gen.simulation.reference.cfa import unpack
from unprocess_gen.sources.raw.frames import read_raw_source
from unprocess_gen.sources.raw.mosaics import even_sides

AS_CLEAN = {"exposure_ratio": 1.0, "iso": None, "exposure_s": None}
"""Columns of a frame at the exposure of the clean one, which is developed as the frame of a photograph."""


@dataclass(frozen=True, slots=True)
class RealPair:
    """Line of ``pairs.csv``, explained in ``docs/guides/score_real_pairs.md``; cells from ``scene`` on are optional."""

    place: str
    folder: Path
    noisy: str = ""
    clean: str = ""
    group: str = ""
    scene: str = ""
    pattern: Pattern | None = None
    black_dn: Number | None = None
    white_dn: Number | None = None
    iso: Number | None = None
    ratio: Number | None = None

    def item(self) -> Item:
        """Decode the frames, mosaics or sRGB codes [H, W, 3], with the row of the noisy one.

        ConfigError or MachineError.
        """
        decoded = (noisy, row), (clean, other) = self._decoded(self.noisy), self._decoded(self.clean)
        kinds = [f"{dn.dtype} {[*dn.shape]} {facts['pattern']} {facts['white_level_dn']}" for dn, facts in decoded]
        if kinds[0] != kinds[1]:
            raise ConfigError(f"{self.place}: noisy is {kinds[0]}, clean {kinds[1]}; expected the same, see pattern")
        row |= {"key": self.noisy, "source": self.scene or self.clean, "group": self.group}
        row |= {"iso": self.iso or row.get("source_iso"), "exposure_s": row.get("source_exposure_s")}
        if clean.ndim == 2:
            exposures = [facts.get("source_iso", 0.0) * facts.get("source_exposure_s", 0.0) for _, facts in decoded]
            row["exposure_ratio"] = self.ratio or (exposures[1] / exposures[0] if all(exposures) else 1.0)
            clean = np.where(clean < row["white_level_dn"], _signal(clean, other) + row["black_level_dn"], clean)
        return Item(self.folder.name, clean[None], noisy[None], [row], compare=real_scores)

    def _decoded(self, name: str) -> tuple[Any, dict[str, Any]]:
        """Decode a file, and list what it states by the names of columns."""
        file, raw = self.folder / name, RawConfig(self.pattern, self.black_dn, self.white_dn)
        with machine_errors(file), refused_files(f"{self.place}: {name}"):
            if self.pattern or file.suffix.lower() not in SUFFIXES:
                frame = read_raw_source(SourceConfig(raw=raw), file.read_bytes(), name)
                facts = {column: cell for part in (frame.raw or ())[:4] for column, cell in flatten(part).items()}
                return even_sides(frame.srgb[..., 0]), facts
            codes = read_picture(file, self.place)
            if codes.dtype == np.uint16 and not np.ptp(codes, axis=2).any():
                raise SourceError("unsupported", "has 16 bits but no colours; give the pattern of a mosaic")
            return codes, {"pattern": "sRGB", "white_level_dn": 256**codes.itemsize - 1}


def _signal(mosaic: Any, row: dict[str, Any]) -> Any:
    """DN above the black levels that the file of a row states for each plane."""
    levels = np.reshape(np.array(row["raw_black_dn"].split(";"), float), (4, 1, 1))
    return mosaic - np.tile(unpack(levels, row["pattern"]), np.array(mosaic.shape) // 2)


def real_scores(clean: Any, output: Any, row: Any) -> Scores:
    """Scores of sRGB codes, or of a mosaic at the exposure of the clean frame."""
    if clean.ndim == 3:
        return scores_of("srgb", clean.astype(np.float64), output, row["white_level_dn"])
    exposed = _signal(output, row) * row["exposure_ratio"] + row["black_level_dn"]
    if not row["rgb2cam_01"]:
        return raw_scores(clean, exposed, row)
    return frame_scores(clean, exposed, {**flatten(plan_image(load_config(), "")), **row, **AS_CLEAN})


def collect(folder: Path) -> Items:
    """List the pairs of a folder, whose files are opened one pair after the other; ConfigError or MachineError."""
    pairs, table = dict[str, RealPair](), folder.resolve() / TABLE
    _, _, *columns = RealPair.__annotations__
    with machine_errors(table):
        for place, cells in read_table(table, columns[:3], columns[3:], columns[5:]) if table.is_file() else ():
            pair = record_of_cells({**cells, "place": place, "folder": table.parent}, RealPair, place)
            for name in (pair.noisy, pair.clean):
                if leads_outside(name) or not (folder / name).is_file():
                    raise ConfigError(f"{place}: {name}: no such file below {folder}; expected a path relative to it")
            if pairs.setdefault(pair.noisy, pair) is not pair:
                raise ConfigError(f"{place}: noisy={pair.noisy}: also in {pairs[pair.noisy].place}; remove one of them")
    if not pairs:
        problem = "lists no pair" if table.is_file() else "no such file"
        raise ConfigError(f"{table}: {problem}; expected a table with the columns {','.join(columns[:3])}")
    data = {"keys": None, "split": None, "name": table.parent.name, "datasets": {table.parent.name: file_sha256(table)}}
    return Items(data, len(pairs), (pair.item() for pair in pairs.values()))
