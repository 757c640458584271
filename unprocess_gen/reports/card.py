"""Write the card of a dataset: ``README.md`` for people, and ``croissant.json`` for programs (Croissant 1.1).

Both are in the dataset's folder and no part of it, as ``report.html``: ``verify`` does not read them. mlcroissant
builds and validates the metadata.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.libraries import require
from unprocess_gen.core.paths import AnyPath, folder_name, local_path
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.workspace import read_dataset
from unprocess_gen.reports.formatting import byte_size
from unprocess_gen.reports.report_files import write_files

README, CROISSANT = FILES = ("README.md", "croissant.json")

MARK = "<!-- written by gen-dataset report --card; delete this line to keep your changes -->"
"""First line of a README that a later card may replace."""

DESCRIPTION = (
    "Pairs of clean and noisy raw frames that unprocess_gen simulated from sRGB photographs: tone curve, gamma, colour "
    "matrix and white balance are inverted, and a sensor samples and reads the light. Noise, cameras and gains are "
    "simulated."
)
FRAMES = ("clean", "noisy")
ROWS = "Rows of manifest.csv. A reader that guesses types drops the leading zeros of keys without patch or level."
LICENCE = "Licence: that of the photographs; the author of the dataset states it here."
CITATION = (
    "Brooks, Mildenhall, Xue, Chen, Sharlet, Barron: Unprocessing Images for Learned Raw Denoising. CVPR 2019. "
    "Image Unprocessing: A Pipeline to Recover Raw Data from sRGB Images. IPOL, MLBriefs."
)


def write_card(folder: AnyPath) -> tuple[Path, ...]:
    """Write the card of a finished dataset into its folder; return the files.

    Raises ConfigError if mlcroissant is missing, the folder is in an object store, or its README is another one;
    DamageError if the dataset is not finished or was changed; MachineError if writing fails.
    """
    require("mlcroissant", "report: --card needs mlcroissant", "card")
    place = local_path(folder, f"report: {folder} is in an object store; expected a local dataset for --card")
    if not (place / "dataset.json").is_file():
        raise DamageError(f"{folder}: dataset.json does not exist; expected a finished dataset")
    facts = read_dataset(folder / "dataset.json")
    if not (place / "manifest.csv").is_file() or file_sha256(place / "manifest.csv") != facts["manifest_sha256"]:
        raise DamageError(f"{folder}: manifest.csv differs from its SHA-256; run gen-dataset verify {folder}")
    readme = place / README
    if readme.exists() and MARK not in readme.read_text(encoding="utf-8", errors="replace"):
        raise ConfigError(f"report: --card: {readme} is not a card of gen-dataset; expected none; rename it")
    rows = _distinct(read_rows(folder / "manifest.csv"))
    contents = {
        README: _readme(folder_name(folder), facts, rows).encode(),
        CROISSANT: _croissant(folder_name(folder), facts).encode(),
    }
    write_files(place, contents)
    return tuple(place / name for name in FILES)


SHOWN = ("camera", "noise", "scene", "iso", "pattern", "bits", "dtype", "layout", "split")
"""Columns whose values a README lists."""


def _distinct(rows: Iterator[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return the values of `SHOWN` that occur in rows of pairs."""
    found: dict[str, dict[str, None]] = {name: {} for name in SHOWN}
    for row in rows:
        for name in SHOWN if row["status"] == "ok" else ():
            if row[name] not in (None, "", 0):
                found[name][str(row[name])] = None
    return {name: list(values) for name, values in found.items()}


def _readme(name: str, facts: Mapping[str, Any], values: Mapping[str, list[str]]) -> str:
    size = byte_size(sum(entry["bytes"] for entry in facts["shards"]))
    failed = sum(facts["failed"].values())
    version = (facts.get("versions") or {}).get("unprocess_gen", "unknown")
    table = "\n".join(
        f"| {column} | {', '.join(some[:12])}{f' and {len(some) - 12} more' if len(some) > 12 else ''} |"
        for column, some in values.items()
        if some
    )
    return f"""{MARK}
# {name}

{DESCRIPTION}

{facts["pairs"]} pairs, {failed} failed sources, {size} in {len(facts["shards"])} shards. Version {version}.
Fingerprint of settings and manifest: `{facts["fingerprint"]}`.

| column | values |
|---|---|
{table}

## Files

- `shards/`: WebDataset archives with `KEY.clean.npy`, `KEY.noisy.npy` and `KEY.json`
- `manifest.csv`: one row for each pair, with every parameter
- `config.yaml`: all settings; `gen-dataset again . out=FOLDER` regenerates the dataset from the same photographs
- `dataset.json`: SHA-256 of each file
- `croissant.json`: Croissant 1.1 metadata

```python
import unprocess_gen as ug

clean, noisy, row = ug.RawPairs("{name}")[0]
```

## Licence

{LICENCE.removeprefix("Licence: ").capitalize()}

## Citation

{CITATION}
"""


def _croissant(name: str, facts: Mapping[str, Any]) -> str:
    """Return the text of the metadata; raise DamageError if mlcroissant finds an error in them."""
    import mlcroissant as mlc

    shards = [entry for entry in facts["shards"] if entry["file"] is not None]
    files = [("config.yaml", "application/yaml", facts["config_sha256"])]
    files += [("manifest.csv", mlc.EncodingFormat.CSV, facts["manifest_sha256"])]
    files += [(entry["file"], mlc.EncodingFormat.TAR, entry["sha256"]) for entry in shards]
    distribution = [
        mlc.FileObject(id=file, name=file, content_url=file, encoding_formats=[form], sha256=sha256)
        for file, form, sha256 in files
    ]
    distribution += [
        mlc.FileSet(
            id=f"{frame}-frames",
            name=f"{frame}-frames",
            description=f"{frame.capitalize()} frames as NPY files, named by the key of the sample.",
            contained_in=[entry["file"] for entry in shards],
            encoding_formats=["application/octet-stream"],
            includes=[f"*.{frame}*.npy"],
        )
        for frame in (FRAMES if shards else ())
    ]
    try:
        metadata = mlc.Metadata(
            name=name,
            description=f"{DESCRIPTION} {LICENCE}",
            cite_as=CITATION,
            conforms_to=["http://mlcommons.org/croissant/1.1"],
            distribution=distribution,
            record_sets=[mlc.RecordSet(id="pairs", name="pairs", description=ROWS, fields=[*_fields(mlc)])],
        )
        return str(json.dumps(metadata.to_json(), indent=1) + "\n")
    except mlc.ValidationError as error:
        raise DamageError(f"{name}: mlcroissant refuses the metadata ({error_in_one_line(error)})") from error


def _fields(mlc: Any) -> Iterator[Any]:
    """Yield a field for each column; integers that may be missing are read as floats."""
    types: dict[Any, Any] = {int: mlc.DataType.INTEGER, float: mlc.DataType.FLOAT}
    for column in COLUMNS:
        kind: Any = float if column.type is int and column.empty_if else column.type
        yield mlc.Field(
            id=f"pairs/{column.name}",
            name=column.name,
            description=", ".join(filter(None, (column.meaning, column.unit))),
            data_types=[types.get(kind, mlc.DataType.TEXT)],
            source=mlc.Source(file_object="manifest.csv", extract=mlc.Extract(column=column.name)),
        )
