"""Write the HTML page of a dataset: settings, contents, failures, parameters, noise check, how to load it.

The page is one self-contained file. It is not part of the dataset: nothing reads it. It describes ``dataset.json``,
``config.yaml`` and ``manifest.csv``, whose SHA-256 are checked first; ``gen-dataset verify`` checks every byte. Of the
arrays, only a few evenly spaced pairs are read: `PAIRS_FITTED` for the noise check, and those of the contact sheet.
"""

from __future__ import annotations

import functools
import io
import os
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.values import error_in_one_line, value_text
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.paths import AnyPath, folder_name
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.pipeline.workspace import REPORT, read_dataset
from unprocess_gen.reports import photon_transfer
from unprocess_gen.reports.dataset_page.statistics import (
    NUMBER_COLUMNS,
    SITE_COLUMNS,
    ManifestStatistics,
    NumberSummary,
    read_statistics,
    values_text,
)
from unprocess_gen.reports.formatting import byte_size, short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.noise_check.checks import Alarm, failed_checks, pair_scores, pair_sums, threshold
from unprocess_gen.reports.report_files import require_libraries, write_files
from unprocess_gen.reports.sheets.contact_sheet import contact_sheet
from unprocess_gen.sources.dark_frames import NO_DARK_FRAMES, DarkFolder, DarkPlaces
from unprocess_gen.sources.names import encode_name

PAIRS_FITTED = 8
SHARDS_LISTED = 20
JPEG_QUALITY = 88

MEANINGS = {column.name: ", ".join(filter(None, (column.meaning, column.unit))) for column in COLUMNS}


def write_dataset_report(
    folder: AnyPath, to: Path | None = None, source: AnyPath | None = None, dark: DarkPlaces = NO_DARK_FRAMES
) -> Path:
    """Write the page of a finished dataset to ``to``, ``report.html`` in a local dataset by default.

    ``source`` is the folder of the photographs, for the contact sheet, by default the recorded one; ``dark`` the place
    of the dark frames. ConfigError if a library is missing or ``to`` may not be written; DamageError if the dataset is
    not finished or was changed; MachineError if writing fails.
    """
    require_libraries("report")
    _check_finished(folder)
    file = _file_to_write(folder, to)
    write_files(file.parent, {file.name: dataset_page(folder, source, dark).encode()})
    return file


def _file_to_write(folder: AnyPath, to: Path | None) -> Path:
    default = folder / REPORT
    if to is None:
        if not isinstance(default, Path):
            raise ConfigError(f"report: {folder} is in an object store; expected a local file; give --to FILE")
        if not os.access(default.parent, os.W_OK):
            raise ConfigError(f"report: {folder} is read-only; expected a file that can be written; give --to FILE")
        return default
    if not isinstance(default, Path) or to.resolve() != default.resolve():
        check_output_file(to, f"--to {to}", "an HTML page", b"<!doctype html", b"<html")
    return to


def dataset_page(folder: AnyPath, source: AnyPath | None = None, dark: DarkPlaces = NO_DARK_FRAMES) -> str:
    """Return the HTML page of a finished dataset; DamageError as for `write_dataset_report`."""
    from jinja2 import TemplateError  # optional library, extra "figures"

    facts, config = _checked_facts(folder)
    rows = with_bar(read_rows(folder / "manifest.csv"), "row", facts["pairs"] + sum(facts["failed"].values()))
    statistics = read_statistics(rows, facts["pairs"])
    sections = {} if statistics.first_pair is None else _pair_sections(folder, source, dark, statistics)
    name = folder_name(folder)
    try:
        return render_page(
            "dataset.html",
            title=f"Dataset {encode_name(name)}",
            facts=facts,
            size=byte_size(sum(entry["bytes"] for entry in facts["shards"])),
            config_yaml=(folder / "config.yaml").read_text(encoding="utf-8"),
            settings=_settings(config),
            statistics=statistics,
            pixels=values_text(statistics.sizes) if sections else "no pair",
            site_columns=SITE_COLUMNS,
            meanings=MEANINGS,
            shards=[(shard_name(number), entry) for number, entry in enumerate(facts["shards"][:SHARDS_LISTED])],
            name=name,
            quoted=shlex.quote(name),
            **sections,
        )
    except (TypeError, ValueError, ZeroDivisionError, TemplateError) as error:  # what a row of facts should have
        raise DamageError(f"{folder / 'dataset.json'}: cannot be shown ({error_in_one_line(error)})") from error


def _check_finished(folder: AnyPath) -> None:
    if not (folder / "dataset.json").exists():
        raise DamageError(f"{folder}: dataset.json does not exist; expected a finished dataset")


def _checked_facts(folder: AnyPath) -> tuple[dict[str, Any], Config]:
    """Return ``dataset.json`` and the config, after comparing the digests of manifest and config."""
    _check_finished(folder)
    facts = read_dataset(folder / "dataset.json")
    for name, key in (("manifest.csv", "manifest_sha256"), ("config.yaml", "config_sha256")):
        path = folder / name
        if not path.is_file() or file_sha256(path) != facts[key]:
            raise DamageError(
                f"{path}: differs from the SHA-256 in dataset.json; run gen-dataset verify {folder} for details"
            )
    try:
        return facts, read_dataset_yaml(folder / "config.yaml")[0]
    except ConfigError as error:
        raise DamageError(str(error)) from error


# --------------------------------------------------------------------------------------------------------- sections


SETTINGS_SHOWN = (
    *("seed", "source.limit", "source.clips", "source.downscale", "source.dequantize", "source.patch"),
    *("camera.name", "camera.xyz2cam", "gains.red", "gains.blue", "gains.inverse_rgb", "gains.highlight"),
    *("isp.tone", "isp.gamma", "sensor.bits", "sensor.black_level_dn", "sensor.white_level_dn", "sensor.pattern"),
    *("sensor.clip", "sensor.saturated", "noise.name", "noise.law", "noise.iso", "noise.levels", "noise.draws"),
    *("scene.name", "scene.exposure_ratio", "effects.all", "effects.tolerance", "accuracy.name"),
)
"""Settings in the table; the others are in the folded ``config.yaml``."""


def _settings(config: Config) -> PageTable:
    values = {key: functools.reduce(getattr, key.split("."), config) for key in SETTINGS_SHOWN}
    return PageTable(
        ("setting", "value"), [(key, value_text(value)) for key, value in values.items() if value is not None]
    )


def _pair_sections(
    folder: AnyPath, source: AnyPath | None, dark: DarkPlaces, statistics: ManifestStatistics
) -> dict[str, Any]:
    """Return the values of the sections about pairs."""
    numbers, first = statistics.numbers, statistics.first_pair
    assert first is not None
    texts = [(name, values_text(counts), MEANINGS[name]) for name, counts in statistics.texts.items()]
    constants = [
        (name, short_number(column.least, 6), MEANINGS[name])
        for name, column in numbers.items()
        if column.least == column.greatest != 0 and name in NUMBER_COLUMNS
    ]
    charts = {name: _chart(column) for name, column in numbers.items() if column.least < column.greatest}
    omitted = [
        (effect, f"{count:,}", next(iter(reasons)) if len(reasons) == 1 else f"for example: {next(iter(reasons))}")
        for (effect, count), reasons in zip(statistics.omitted.items(), statistics.reasons.values(), strict=True)
    ]
    return {
        "contact_sheet": _contact_sheet(folder, source),
        "omitted": PageTable(("omitted effect", "pairs", "reason"), omitted, {1}),
        "constants": PageTable(("column", "value (number of pairs, if several)", "meaning"), [*texts, *constants]),
        "parameter_charts": [charts[name] for name in NUMBER_COLUMNS if name in charts],
        "site_charts": [charts[name] for name in SITE_COLUMNS if name in charts],
        "noise": _noise_check(folder, dark),
        "first_shard": f"{folder_name(folder)}/shards/{shard_name(int(first['shard'] or 0))}",
        "first_key": sample_key(first),
    }


def _contact_sheet(folder: AnyPath, source: AnyPath | None) -> str:
    """Return the contact sheet as a ``data:`` address; as JPEG, because noise makes a PNG four times as large."""
    sheet = contact_sheet(folder, source=source)
    _, content = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data_uri(content.tobytes(), "jpeg")


class Chart(NamedTuple):
    """The histogram of a column as a ``data:`` address, and the texts around it."""

    column: str
    meaning: str
    ends: str
    picture: str


LOGARITHMIC_RATIO = 20
"""Ratio of greatest to least value from which the scale of a histogram is logarithmic."""


BARS = 24


def _chart(column: NumberSummary) -> Chart:
    from matplotlib.figure import Figure  # optional library, extra "figures"

    figure = Figure(figsize=(3, 1.1), layout="constrained")
    axes = figure.subplots()
    axes.spines[["left", "top", "right"]].set_visible(False)
    axes.set_yticks([])
    is_logarithmic = column.least > 0 and column.greatest >= LOGARITHMIC_RATIO * column.least
    axes.set_xscale("log" if is_logarithmic else "linear")
    space = np.geomspace if is_logarithmic else np.linspace
    axes.hist(column.values, space(column.least, column.greatest, BARS + 1).tolist())
    content = io.BytesIO()
    figure.savefig(content, dpi=120)
    least, mean, greatest = (short_number(value, 4) for value in (column.least, column.mean, column.greatest))
    unit = " % of the frame" if column.column in SITE_COLUMNS else ""
    ends = f"{least} to {greatest}{unit}, mean {mean}"
    return Chart(column.column, MEANINGS[column.column], ends, data_uri(content.getvalue()))


def _noise_check(folder: AnyPath, dark: DarkPlaces) -> dict[str, Any]:
    """Return checks and photon transfer fits of a few evenly spaced pairs, or why pairs with dark frames have none."""
    pairs = RawPairs(folder)
    numbers = evenly_spaced(range(len(pairs)), PAIRS_FITTED)
    fits: list[photon_transfer.NoiseFit] = []
    failed: list[Alarm] = []
    checked, missing, dark_pixels = 0, "", None
    for number in with_bar(numbers, "pair checked"):
        clean, noisy, row = pairs[number]
        try:
            dark_pixels = dark_pixels or _dark_frames_of(row, dark)
            sums = pair_sums(clean, noisy, row, dark_pixels)
        except (ConfigError, MachineError) as error:  # dark frames are no part of the dataset, whose page this is
            missing = str(error)
            break
        if sums is None:
            continue
        checked += 1
        fit = photon_transfer.fit_sums(str(row["key"]), sums)
        fits += [] if fit is None else [fit]
        failed += failed_checks(str(row["key"]), pair_scores(sums), threshold(len(numbers)))[:1]
    figure = io.BytesIO()
    if fits:
        photon_transfer.draw_fits(fits, figure)
    return {
        "count": len(numbers),
        "checked": checked,
        "failed": failed,
        "missing": missing,
        "fits": fits,
        "figure": data_uri(figure.getvalue()),
    }


def _dark_frames_of(row: Row, dark: DarkPlaces) -> DarkFolder | None:
    """Return access to the dark frames that a row names; ConfigError if there is none."""
    if not row["dark_frame"]:
        return None
    folder = dark.open()
    if folder is None:
        raise ConfigError("noise.dark_frames is missing; expected the folder of the dark frames")
    return folder
