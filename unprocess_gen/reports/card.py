"""Write the card of a dataset: ``README.md`` for people and ``croissant.json`` (Croissant 1.1) for programs.

The card describes ``dataset.json``, ``config.yaml`` and ``manifest.csv``. It is no part of the dataset: nothing reads
it. What only the author knows, such as the licence of the photographs, is left to the author.
"""

from __future__ import annotations

import html
import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath, folder_name
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.manifest import read_columns, read_rows
from unprocess_gen.pipeline.workspace import CARD_FILES
from unprocess_gen.reports.dataset_page.page import checked_facts, shown_settings
from unprocess_gen.reports.dataset_page.statistics import MEANINGS, ManifestStatistics, read_statistics, values_text
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.reports.report_files import writable_folder, write_files
from unprocess_gen.sources.names import encode_name

CROISSANT = "http://mlcommons.org/croissant/1.1"

CITATIONS = (
    "Tim Brooks et al.: Unprocessing Images for Learned Raw Denoising. CVPR 2019, arXiv:1811.11127.",
    "Image Unprocessing: A Pipeline to Recover Raw Data from sRGB Images. Image Processing On Line (IPOL), MLBriefs.",
)

SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
"""Categories of Hugging Face: numbers of pairs below which each applies."""

CARD_TEMPLATE = Path(__file__).parent / "templates" / "card.md"

SHARDS = "- `shards/`: uncompressed tar files in WebDataset layout: `KEY.clean.npy`, `KEY.noisy.npy`, `KEY.json`\n"
"""Line about the files with frames."""

LEFT_TO_AUTHOR = "The author states here the licence of the source photographs, and of this dataset."


@dataclass(frozen=True, slots=True)
class _Described:
    """Hold what a card describes: the dataset's name, facts, settings, columns and statistics of its rows.

    The author states ``licence`` and ``published``, the date of publication (ISO 8601).
    """

    name: str
    facts: dict[str, Any]
    config: Config
    columns: tuple[str, ...]
    statistics: ManifestStatistics
    licence: str
    published: str

    @property
    def summary(self) -> str:
        """One sentence about the dataset."""
        return (
            f"{counted(self.facts['pairs'], 'pair')} of a clean and a noisy raw frame, simulated by unprocess_gen "
            f"{self.version} from {self.sources}."
        )

    @property
    def version(self) -> str:
        """Version of unprocess_gen that finished the dataset."""
        return str((self.facts.get("versions") or {}).get("unprocess_gen", "of an unknown version"))

    @property
    def sources(self) -> str:
        """Number and kind of the sources."""
        kind = "sRGB photograph" if self.facts["source"]["kind"] == "folder" else "built-in scene"
        return counted(self.statistics.images, kind)


def write_card(folder: AnyPath, to: Path | None = None, licence: str = "", published: str = "") -> Path:
    """Write the card of a finished dataset into it, or to another folder; return the folder.

    ConfigError if mlcroissant is missing, the folder cannot be written, or it has other files of these names, which the
    author may have edited; DamageError if the dataset is not finished or was changed.
    """
    require("mlcroissant", "report: --card needs mlcroissant", "card")
    out = to or writable_folder(folder, "folder")
    if to is not None and not (isinstance(folder, Path) and to.resolve() == folder.resolve()):
        check_output_folder(to, f"--to {to}")
    facts, config = checked_facts(folder)
    manifest = folder / "manifest.csv"
    statistics = read_statistics(read_rows(manifest), facts["pairs"])
    name, columns = encode_name(folder_name(folder)), read_columns(manifest)
    described = _Described(name, facts, config, columns, statistics, licence, published)
    contents = dict(zip(CARD_FILES, (_readme(described), _croissant(described)), strict=True))
    for name, text in contents.items():
        if (out / name).exists() and (out / name).read_bytes() != text.encode():
            raise ConfigError(
                f"report: {out / name}: exists with another text, which may be yours; expected no such file; move it "
                "away, or give --to FOLDER"
            )
    write_files(out, {name: text.encode() for name, text in contents.items()})
    return out


# ----------------------------------------------------------------------------------------------------------- README.md


def _readme(described: _Described) -> str:
    facts, statistics, config = described.facts, described.statistics, described.config
    licence, shards = described.licence or LEFT_TO_AUTHOR, facts["shards"]
    if facts["source"]["kind"] == "synthetic" and not described.licence:
        licence = "No photograph is contained: the sources are scenes that unprocess_gen (MIT) draws."
    contents = {
        "pairs": f"{facts['pairs']:,}, of {described.sources}",
        "failed sources": f"{sum(facts['failed'].values()):,}",
        "size": f"{byte_size(sum(entry['bytes'] for entry in shards))} in {counted(len(shards), 'shard')}"
        if config.output.frames
        else "no frames stored; ug.LivePairs makes them from the sources",
        "width × height": values_text(statistics.sizes),
        "pattern": values_text(statistics.texts["pattern"]),
        **{name: values_text(statistics.texts[name]) for name in ("camera", "noise", "scene")},
        "effects": values_text(statistics.effects),
    }
    return CARD_TEMPLATE.read_text(encoding="utf-8").format(
        title=html.escape(described.name, quote=False),
        name=json.dumps(described.name, ensure_ascii=False),
        quoted=shlex.quote(described.name),
        licence_key=f"license: {json.dumps(described.licence)}\n" if described.licence else "",
        size=next((name for bound, name in SIZES if facts["pairs"] < bound), "n>10M"),
        summary=described.summary,
        contents=_markdown_table("property", "value", contents),
        settings=_markdown_table("setting", "value", shown_settings(config)),
        shards=SHARDS if config.output.frames else "",
        reader="RawPairs" if config.output.frames else "LivePairs",
        fingerprint=facts["fingerprint"],
        licence=licence,
        citations="\n".join(f"- {text}" for text in CITATIONS),
    )


def _markdown_table(first: str, second: str, rows: Mapping[str, str]) -> str:
    cells = (f"| {key} | {text.replace('|', chr(92) + '|')} |" for key, text in rows.items())
    return "\n".join([f"| {first} | {second} |", "|---|---|", *cells])


# ------------------------------------------------------------------------------------------------------ croissant.json


def _croissant(described: _Described) -> str:
    """Return Croissant JSON: the rows of the manifest as records, and the arrays in the shards with their keys."""
    import mlcroissant as mlc  # optional library, extra "card"

    facts = described.facts
    listed = {"manifest.csv": ("text/csv", facts["manifest_sha256"])}
    shards = {entry["file"]: ("application/x-tar", entry["sha256"]) for entry in facts["shards"] if entry["file"]}
    files = [
        mlc.FileObject(id=file, name=file, content_url=file, encoding_formats=[kind], sha256=sha256)
        for file, (kind, sha256) in (listed | shards).items()
    ]
    arrays = {"encoding_formats": ["application/x-npy"], "includes": ["*.npy"]}
    sets = [mlc.FileSet(id="arrays", name="arrays", contained_in=[*shards], **arrays)] if shards else []
    metadata = mlc.Metadata(
        name=described.name,
        description=described.summary,
        conforms_to=[CROISSANT],
        keywords=["raw", "denoising", "image restoration", "synthetic"],
        license=[described.licence] if described.licence else None,
        date_published=described.published or None,
        cite_as=" ".join(CITATIONS),
        version="1.0.0",
        data_collection=f"Simulated by unprocess_gen {described.version}; fingerprint {facts['fingerprint']}.",
        distribution=[*files, *sets],
        record_sets=[_rows_record(mlc, described.columns), *([_arrays_record(mlc)] if shards else [])],
    )
    content = metadata.to_json()
    content["@context"]["containedIn"] = "cr:containedIn"  # a term of 1.1 that mlcroissant reads and does not write
    return json.dumps(content, indent=1, default=str) + "\n"


def _rows_record(mlc: Any, names: tuple[str, ...]) -> Any:
    """Describe the rows of the manifest, with a field for each of its columns."""
    types: dict[object, Any] = {int: mlc.DataType.INTEGER, float: mlc.DataType.FLOAT}
    fields = [
        mlc.Field(
            id=f"pairs/{column.name}",
            name=column.name,
            description=MEANINGS[column.name],
            data_types=[types.get(column.type, mlc.DataType.TEXT)],
            source=mlc.Source(file_object="manifest.csv", extract=mlc.Extract(column=column.name)),
        )
        for column in COLUMNS
        if column.name in names
    ]
    description = "Rows of the manifest. Readers that take a key for a number drop its leading zeros."
    return mlc.RecordSet(id="pairs", name="pairs", description=description, key="pairs/key", fields=fields)


def _arrays_record(mlc: Any) -> Any:
    """Describe the arrays in the shards: key, name of the array, and the content of the file."""
    regex = {"key": r"^([^.]+)\.", "array": r"^[^.]+\.(.+)\.npy$"}
    meanings = {
        "key": "key of the sample: source index, and patch if there is one",
        "array": "clean, noisy, noisy.l00d01 of level 0 and draw 1, or another array of the sample",
        "content": "NPY file: numpy.load(io.BytesIO(content))",
    }
    fields = []
    for name, meaning in meanings.items():
        extract = mlc.Extract(file_property="fullpath" if name in regex else "content")
        transforms = [mlc.Transform(regex=regex[name])] if name in regex else []
        source = mlc.Source(file_set="arrays", extract=extract, transforms=transforms)
        text = [mlc.DataType.TEXT]
        fields.append(mlc.Field(id=f"frames/{name}", name=name, description=meaning, data_types=text, source=source))
    return mlc.RecordSet(id="frames", name="frames", description="Arrays in the shards.", fields=fields)
