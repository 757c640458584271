"""Write the HTML page of a dataset: settings, contents, failures, parameters, noise check, how to load it.

The page describes ``dataset.json``, ``config.yaml`` and ``manifest.csv``, whose SHA-256 are checked first. Of the
arrays, only a few evenly spaced pairs are read: `PAIRS_CHECKED` for the noise, and the pairs that are shown.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.files import write_file
from unprocess_gen.core.paths import AnyPath, folder_name
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.dataset_json import read_dataset
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.pipeline.verify import check_files
from unprocess_gen.reports.formatting import byte_size, short_number
from unprocess_gen.reports.manifest_statistics import MEANINGS, SITE_COLUMNS, read_statistics, values_text
from unprocess_gen.reports.noise_check.alarms import Checker
from unprocess_gen.reports.noise_check.repetition import measure_noise
from unprocess_gen.reports.pages import data_uri, page_file, render_page
from unprocess_gen.reports.panels import SheetPanel, byte_codes
from unprocess_gen.reports.photon_transfer import NoiseFit, draw_fits, fit_noise
from unprocess_gen.reports.pictures import picture_jpeg
from unprocess_gen.reports.sheets import overview
from unprocess_gen.sources.dark_frames import dark_folder
from unprocess_gen.sources.names import encode_name

PAIRS_CHECKED = 8
SHARDS_LISTED = 20
JPEG_QUALITY = 80


def write_dataset_report(
    folder: AnyPath, to: Path | None = None, source: AnyPath | None = None, dark_frames: str | None = None
) -> Path:
    """Write the page of a finished dataset to ``to``, ``report.html`` in a local dataset by default.

    ``source`` is the folder of the photographs for the pictures, by default the recorded one. Raises ConfigError,
    DamageError if the dataset is not finished or was changed, or MachineError.
    """
    file = page_file(folder, to)
    write_file(file, dataset_page(folder, source, dark_frames))
    return file


def dataset_page(folder: AnyPath, source: AnyPath | None = None, dark_frames: str | None = None) -> str:
    """Render the HTML page of a finished dataset; DamageError as for `write_dataset_report`."""
    from jinja2 import TemplateError  # optional library, extra "figures"

    facts, name = _checked_facts(folder), folder_name(folder)
    statistics = read_statistics(with_bar(read_rows(folder / "manifest.csv"), "row"))
    first = statistics.first_pair
    try:
        return render_page(
            "dataset.html",
            title=f"Dataset {encode_name(name)}",
            name=name,
            quoted=shlex.quote(name),
            facts=facts,
            size=byte_size(sum(entry["bytes"] for entry in facts["shards"])),
            config_yaml=(folder / "config.yaml").read_text(encoding="utf-8"),
            statistics=statistics,
            values_text=values_text,
            short_number=short_number,
            meanings=MEANINGS,
            site_columns=SITE_COLUMNS,
            shards=[(shard_name(number), entry) for number, entry in enumerate(facts["shards"][:SHARDS_LISTED])],
            **({} if first is None else _pair_values(folder, source, dark_frames, first)),
        )
    except (TypeError, ValueError, ZeroDivisionError, TemplateError) as error:  # what a row of facts should have
        raise DamageError(f"{folder / 'dataset.json'}: cannot be shown ({error_in_one_line(error)})") from error


def _checked_facts(folder: AnyPath) -> dict[str, Any]:
    """Read ``dataset.json``, and compare the digests of manifest and config."""
    if not (folder / "dataset.json").exists():
        raise DamageError(f"{folder}: dataset.json does not exist; expected a finished dataset")
    facts = read_dataset(folder / "dataset.json")
    for damage in check_files(folder, facts):
        raise DamageError(f"{folder}/{damage}; run gen-dataset verify {folder} for details")
    return facts


def _pair_values(folder: AnyPath, source: AnyPath | None, dark_frames: str | None, first: Row) -> dict[str, Any]:
    """Values of the sections about pairs; noise is examined unless the dark frames are not available."""
    pairs = RawPairs(folder)
    numbers, fits, missing = evenly_spaced(range(len(pairs)), PAIRS_CHECKED), list[NoiseFit](), ""
    checks = Checker(len(numbers))
    try:
        if first["dark_frame"] and dark_frames is None:
            raise ConfigError("noise.dark_frames is missing; expected the folder of the dark frames")
        access = dark_folder(dark_frames) if dark_frames and first["dark_frame"] else None
        for clean, noisy, row in map(pairs.__getitem__, numbers):
            noise = measure_noise(clean, noisy, row, access)
            checks.add(noise)
            fits += filter(None, [fit_noise(noise)])
    except (ConfigError, MachineError) as error:  # dark frames are no part of the dataset, whose page this is
        missing, fits = str(error), []
    return {
        "strips": [(heading, [*map(_figure, panels)]) for heading, panels in overview(folder, source=source)],
        "checks": checks,
        "fits": fits,
        "missing": missing,
        "count": len(numbers),
        "figure": data_uri(draw_fits(fits)) if fits else "",
        "first_shard": f"{folder_name(folder)}/shards/{shard_name(int(first['shard'] or 0))}",
        "first_key": sample_key(first),
    }


def _figure(panel: SheetPanel) -> tuple[str, str, str]:
    """Title, note and picture of a panel; no picture if it has none."""
    if panel.overview is None:
        return panel.title, panel.note, ""
    return panel.title, panel.note, data_uri(picture_jpeg(byte_codes(panel.overview), JPEG_QUALITY), "jpeg")
