"""Write the HTML report of a dataset: settings, contents, failures, parameters, noise check, how to load it.

The report is one self-contained file. It is not part of the dataset: nothing reads it. It describes ``dataset.json``,
``config.yaml`` and ``manifest.csv``, whose SHA-256 are checked first; ``gen-dataset verify`` checks every byte. The
manifest is read once (`statistics`). Of the arrays, only a few evenly spaced pairs are read: `PAIRS_FITTED`
for the noise check, and those of the contact sheet.
"""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import yaml

from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.files import commit_file, file_sha256, machine_error
from unprocess_gen.core.object_store import AnyPath, folder_name
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.keys import sample_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.workspace import REPORT, read_dataset
from unprocess_gen.reports import photon_transfer
from unprocess_gen.reports.dataset_page.statistics import (
    PARAMETER_COLUMNS,
    SITE_COLUMNS,
    TEXT_COLUMNS,
    ColumnStatistics,
    ManifestStatistics,
)
from unprocess_gen.reports.formatting import byte_size, percentage, short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.noise_check.checks import Alarm, failed_checks, pair_scores, pair_sums, threshold
from unprocess_gen.reports.report_files import require_libraries
from unprocess_gen.reports.sheets.contact_sheet import contact_sheet
from unprocess_gen.sources.dark_frames import NO_DARK_FRAMES, DarkFolder, DarkPlaces
from unprocess_gen.sources.listing import encode_name

PAIRS_FITTED = 8
SHARDS_LISTED = 20
JPEG_QUALITY = 88

MEANINGS = {column.name: ", ".join(filter(None, (column.meaning, column.unit))) for column in COLUMNS}


def write_dataset_report(
    folder: AnyPath, to: Path | None = None, source: AnyPath | None = None, dark: DarkPlaces = NO_DARK_FRAMES
) -> Path:
    """Write the HTML report of a finished dataset.

    Parameters
    ----------
    folder : Path or ObjectPath
        Folder of the dataset.
    to : Path, optional
        File to write; ``report.html`` in the dataset's folder by default. Required for a URL.
    source : Path or ObjectPath, optional
        Folder of the photographs, for the contact sheet; the recorded one by default.
    dark : DarkPlaces
        Where the dark frames and their map are, for the check of the noise.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ConfigError
        If a library is missing, ``to`` is inside a dataset or a file that is no HTML page, or ``source`` is not a
        folder.
    DamageError
        If the dataset is not finished, or its manifest or config differs from the one ``dataset.json`` records.
    MachineError
        If the file cannot be written.
    """
    require_libraries("report")
    _check_finished(folder)
    to = _file_to_write(folder, to)
    content = dataset_page(folder, source, dark).encode()
    temporary = to.with_name(to.name + ".part")
    try:
        temporary.write_bytes(content)
        commit_file(temporary, to)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise machine_error(error, to) from error
    return to


def _file_to_write(folder: AnyPath, to: Path | None) -> Path:
    """Return the file of the report, ``report.html`` in a local dataset by default; ConfigError if it may not be."""
    default = folder / REPORT
    if to is None and isinstance(default, Path):
        return default
    if to is None:
        raise ConfigError(f"report: {folder} is in an object store; expected a local file; give --to FILE")
    if not isinstance(default, Path) or to.resolve() != default.resolve():
        check_output_file(to, f"--to {to}", "an HTML page", b"<!doctype html", b"<html")
    return to


def dataset_page(folder: AnyPath, source: AnyPath | None = None, dark: DarkPlaces = NO_DARK_FRAMES) -> str:
    """Return the HTML report of a finished dataset; DamageError as for `write_dataset_report`."""
    facts = _checked_facts(folder)
    statistics = ManifestStatistics.of_rows(read_rows(folder / "manifest.csv"))
    name = encode_name(folder_name(folder))
    sections: dict[str, Any] = {
        "headline": _headline(facts),
        "contact_sheet": _contact_sheet(folder, source) if facts["pairs"] else None,
        "settings": _settings(facts),
        "config_yaml": facts["config"],
        "contents": _contents(facts, statistics),
        "failures": _failures(facts, statistics),
        "pairs": facts["pairs"],
        "commands": _commands(folder, facts),
        "origin": _origin(facts),
        "versions": PageTable(("package", "version"), sorted(facts["versions"].items())),
        "checksums": {key: str(facts[key]) for key in ("fingerprint", "manifest_sha256", "config_sha256")},
        "shards": _shards(facts["shards"]),
    }
    if statistics.first_pair is not None:
        is_one_size = len(statistics.sizes.counts) == 1
        sections |= {
            "effects": _effects(statistics),
            "parameters": _parameters(statistics),
            "clipping": _clipping(facts, statistics),
            "noise": _noise_check(folder, dark),
            "snippets": snippets(folder, facts["shards"], statistics.first_pair, is_one_size),
        }
    return render_page("dataset.html", title=f"Dataset {name}", **sections)


def _check_finished(folder: AnyPath) -> None:
    if not (folder / "dataset.json").exists():
        raise DamageError(f"{folder}: dataset.json does not exist; expected a finished dataset")


def _checked_facts(folder: AnyPath) -> dict[str, Any]:
    """Return the contents of ``dataset.json`` after comparing the digests of manifest and config."""
    _check_finished(folder)
    facts = read_dataset(folder / "dataset.json")
    for name, key in (("manifest.csv", "manifest_sha256"), ("config.yaml", "config_sha256")):
        path = folder / name
        if not path.is_file() or file_sha256(path) != facts[key]:
            raise DamageError(
                f"{path}: differs from the SHA-256 in dataset.json; run gen-dataset verify {folder} for details"
            )
    return facts


# --------------------------------------------------------------------------------------------------------- sections


def _headline(facts: Mapping[str, Any]) -> str:
    size = byte_size(sum(entry["bytes"] for entry in facts["shards"]))
    return (
        f"{facts['pairs']:,} pairs of clean and noisy raw frames, {size}; shards: {len(facts['shards']):,}; "
        f"failed rows: {sum(facts['failed'].values()):,}."
    )


def _contact_sheet(folder: AnyPath, source: AnyPath | None) -> str:
    """Return the contact sheet as a ``data:`` address; as JPEG, because noise makes a PNG four times as large."""
    sheet = contact_sheet(folder, source=source)
    _, content = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data_uri(content.tobytes(), "jpeg")


SETTINGS_SHOWN = (
    *("seed", "source.kind", "source.limit", "source.clips", "source.downscale", "source.dequantize", "source.patch"),
    *("camera.name", "camera.xyz2cam", "gains.red", "gains.blue", "gains.inverse_rgb", "gains.highlight"),
    *("isp.tone", "isp.gamma", "sensor.bits", "sensor.black_level_dn", "sensor.white_level_dn", "sensor.pattern"),
    *("sensor.clip", "sensor.saturated", "noise.name", "noise.law", "noise.iso", "noise.levels", "noise.draws"),
    *("scene.name", "scene.exposure_ratio", "effects.all", "effects.tolerance", "accuracy.name"),
)
"""Settings in the table; the others are in the folded ``config.yaml``."""


def _settings(facts: Mapping[str, Any]) -> PageTable:
    config = yaml.safe_load(facts["config"])
    values = {key: _setting(config, key) for key in SETTINGS_SHOWN}
    return PageTable(("setting", "value"), [(key, value) for key, value in values.items() if value != "null"])


def _setting(value: Any, key: str) -> str:
    for name in key.split("."):
        value = value[name]
    return yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True).partition("\n")[0]


def _contents(facts: Mapping[str, Any], statistics: ManifestStatistics) -> dict[str, str]:
    run = facts["run"]
    return {
        "sources": f"{statistics.images:,}, rows {statistics.rows:,}",
        "pairs": f"{facts['pairs']:,}, with {facts['sites']['all']:,} sites in total",
        "width × height": statistics.sizes.summary() if statistics.first_pair else "no pair",
        "files that no pattern of source.include matched": f"{facts['not_matched']:,}",
        "symbolic links not followed": f"{facts['skipped_links']:,}",
        "generated on": f"{run['host']}, {run['platform']}, Python {run['python']}; {_work(run)}",
        "self-test": str(facts["self_test"]),
        **_dark_frames(facts.get("dark_frames") or {}),
    }


def _work(run: Mapping[str, Any]) -> str:
    """Return who made the shards; a run in parts records no time, because its parts run on different hosts."""
    if "parts" in run:
        return f"merged from {run['parts']:,} parts"
    return f"{run['n_jobs']} workers, {run['seconds']:,} s for the last {run['shards_made']:,} shards"


def _dark_frames(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return what the page says about dark frames; nothing without them, or if the run could not read them."""
    if "count" not in facts:
        return {}
    return {
        "dark frames": f"{facts['count']:,} in {facts['root']}, {', '.join(facts['sizes'])} pixels, black level "
        f"{facts['black_dn']:g} DN, standard deviation {facts['std_dn']:.4g} DN of the sensor"
        + (f", minus the dark-shading map {facts['shading']}" if "shading" in facts else "")
    }


class FailureTables(NamedTuple):
    """Failed rows by reason, the first of them in detail, and how many more there are."""

    reasons: PageTable
    rows: PageTable
    more: int


def _failures(facts: Mapping[str, Any], statistics: ManifestStatistics) -> FailureTables | None:
    if not facts["failed"]:
        return None
    reasons = [(reason, f"{count:,}") for reason, count in facts["failed"].items()]
    more = sum(facts["failed"].values()) - len(statistics.failed)
    rows = PageTable(("key", "source", "reason", "detail"), statistics.failed, wrapped={3})
    return FailureTables(PageTable(("reason", "rows"), reasons, {1}), rows, more)


def _effects(statistics: ManifestStatistics) -> dict[str, PageTable | None]:
    simulated = [(effect, f"{count:,}") for effect, count in statistics.effects.counts.items()]
    omitted = [
        (effect, f"{item.pairs:,}", item.reason if item.same_reason else f"for example: {item.reason}")
        for effect, item in statistics.omitted.items()
    ]
    return {
        "simulated": PageTable(("simulated effect", "pairs"), simulated, {1}),
        "omitted": PageTable(("omitted effect", "pairs", "reason"), omitted, {1}) if omitted else None,
    }


class HistogramChart(NamedTuple):
    """The histogram of a column: heights of its bars, 0 to 100, and the texts around it."""

    column: str
    meaning: str
    least: str
    mean: str
    greatest: str
    is_logarithmic: bool
    bars: tuple[float, ...]


def _chart(column: str, statistics: ColumnStatistics, as_percentage: bool = False) -> HistogramChart:
    linear = statistics.linear
    counts = (statistics.log2 if statistics.is_logarithmic else linear).bars()
    least, mean, greatest = (
        percentage(value, 3) if as_percentage else short_number(value, 4)
        for value in (linear.least, linear.mean, linear.greatest)
    )
    bars = tuple(100 * count / max(counts) for count in counts)
    return HistogramChart(column, MEANINGS[column], least, mean, greatest, statistics.is_logarithmic, bars)


def _parameters(statistics: ManifestStatistics) -> dict[str, Any]:
    """Return charts of the parameters that differ between pairs, and a table of the others."""
    texts = {
        name: statistics.texts[name].summary() for name in TEXT_COLUMNS if statistics.physical or name != "sensor_unit"
    }
    shown = {
        parameter.column: statistics.parameters[parameter.column]
        for parameter in PARAMETER_COLUMNS
        if (statistics.physical or not parameter.physical) and statistics.parameters[parameter.column].linear.number
    }
    numbers = {name: short_number(column.linear.least, 6) for name, column in shown.items() if column.is_constant}
    lines = [(name, value, MEANINGS[name]) for name, value in (texts | numbers).items()]
    return {
        "charts": [_chart(name, column) for name, column in shown.items() if not column.is_constant],
        "constants": PageTable(("column", "value (number of pairs, if several)", "meaning"), lines),
    }


def _clipping(facts: Mapping[str, Any], statistics: ManifestStatistics) -> dict[str, Any]:
    sites = facts["sites"]
    lines = [(name, f"{sites[name]:,}", f"{sites[name] / sites['all']:.3%}", MEANINGS[name]) for name in SITE_COLUMNS]
    fractions = statistics.site_fractions.items()
    return {
        "totals": PageTable(("count", "sites", "of all sites", "meaning"), lines, {1, 2}),
        "charts": [_chart(name, column, as_percentage=True) for name, column in fractions if not column.is_constant],
    }


def _noise_check(folder: AnyPath, dark: DarkPlaces) -> dict[str, Any]:
    """Return checks and photon transfer fits of a few evenly spaced pairs, or why pairs with dark frames have none."""
    pairs = RawPairs(folder)
    numbers = evenly_spaced(range(len(pairs)), PAIRS_FITTED)
    fits: list[photon_transfer.NoiseFit] = []
    failed: list[Alarm] = []
    checked, missing, dark_pixels = 0, "", None
    for number in numbers:
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
    verdict = (
        f"The noise of {len(failed)} of them differs from the manifest: {'; '.join(map(str, failed))}. "
        "gen-dataset verify --noise checks every pair."
        if failed
        else "All agree with the manifest."
    )
    return {
        "count": len(numbers),
        "checked": checked,
        "verdict": verdict,
        "missing": missing,
        "fits": _fits(fits) if fits else None,
    }


def _dark_frames_of(row: Row, dark: DarkPlaces) -> DarkFolder | None:
    """Return access to the dark frames that a row names; ConfigError if there is none."""
    if not row["dark_frame"]:
        return None
    found = dark.open()
    if found is None:
        raise ConfigError("noise.dark_frames is missing; expected the folder of the dark frames")
    return found


def _fits(fits: list[photon_transfer.NoiseFit]) -> dict[str, Any]:
    """Return number, figure and table of photon transfer fits."""
    figure = io.BytesIO()
    photon_transfer.draw_fits(fits, figure)
    lines = [
        (
            fit.key,
            f"{fit.slope:.5g} ± {1.96 * fit.slope_error:.2g}",
            f"{fit.expected[0]:.5g}",
            f"{fit.intercept:.5g} ± {1.96 * fit.intercept_error:.2g}",
            f"{fit.expected[1]:.5g}",
            f"{fit.deviation:.1f}",
        )
        for fit in fits
    ]
    headings = ("pair", "a fitted, DN", "a expected", "b fitted, DN²", "b expected", "difference, standard errors")
    return {
        "count": len(fits),
        "figure": data_uri(figure.getvalue()),
        "table": PageTable(headings, lines, range(1, len(headings))),
    }


def snippets(
    folder: AnyPath, entries: Sequence[Mapping[str, Any]], first: tuple[str, int], is_one_size: bool
) -> dict[str, str]:
    """Return code that loads a dataset, by library; ``first`` is the key and the shard number of its first pair."""
    name = folder_name(folder)
    key = sample_key({"key": first[0]})
    count = len(entries)
    if re.fullmatch(r"[\w.+-]+", name) and all(entry["file"] for entry in entries):
        urls = repr(
            f"{name}/shards/shard-{{00000..{count - 1:05d}}}.tar" if count > 1 else f"{name}/{entries[0]['file']}"
        )
    else:  # brace expansion needs consecutive files and a name without braces; shards without a pair have no file
        urls = f"sorted(glob.glob(glob.escape({name!r}) + '/shards/*.tar'))"
    imports = "import glob\n\n" if urls.startswith("sorted") else ""
    size = "" if is_one_size else "  # frames differ in size: crop them before stacking"
    return {
        "NumPy": (
            "import io\nimport tarfile\n\nimport numpy as np\n\n"
            f"with tarfile.open({f'{name}/shards/{shard_name(first[1])}'!r}) as shard:\n"
            f'    clean, noisy = (\n        np.load(io.BytesIO(shard.extractfile(f"{key}.{{kind}}.npy").read()))\n'
            '        for kind in ("clean", "noisy")\n    )  # uint16 [H, W] mosaics, DN\n'
        ),
        "PyTorch": (
            "from torch.utils.data import DataLoader\n\nfrom unprocess_gen import RawPairs\n\n"
            f"pairs = RawPairs({name!r})  # pairs[0] is (clean, noisy, row), mapped from the shard\n"
            f"loader = DataLoader(pairs, batch_size=8, shuffle=True, collate_fn=list){size}\n"
        ),
        "webdataset": (
            f"{imports}import webdataset as wds\n\nsamples = wds.WebDataset({urls}, shardshuffle=False).decode()\n"
            'for sample in samples:\n    clean, noisy, row = sample["clean.npy"], sample["noisy.npy"], sample["json"]\n'
        ),
    }


def _commands(folder: AnyPath, facts: Mapping[str, Any]) -> str:
    """Return shell commands that regenerate or check the dataset."""
    name = shlex.quote(folder_name(folder))
    root = " source.root=PHOTOGRAPHS" if facts["source"]["kind"] == "folder" else ""
    return "\n".join(
        (
            "# regenerate all of it, bit for bit",
            f"gen-dataset again {name}{root} out=again",
            "# check every byte against the manifest",
            f"gen-dataset verify {name}",
            "# regenerate ten rows and compare",
            f"gen-dataset replay {name} --rows 0:10{root}",
        )
    )


def _origin(facts: Mapping[str, Any]) -> str:
    if facts["source"]["kind"] == "folder":
        return f"The photographs were in {facts['source']['root']}."
    return "The sources are the built-in scenes."


def _shards(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    lines = [
        (shard_name(number), str(entry["pairs"]), str(entry["failed"]), f"{entry['bytes']:,}", entry["sha256"] or "–")
        for number, entry in enumerate(entries[:SHARDS_LISTED])
    ]
    headings = ("shard", "pairs", "failed", "bytes", "SHA-256")
    return {"table": PageTable(headings, lines, {1, 2, 3}), "more": len(entries) - len(lines)}
