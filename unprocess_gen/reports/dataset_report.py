"""The page of a dataset, for people: what was asked for and made, what failed, what was drawn, how to load it.

One self-contained HTML file. It is no part of the dataset: nothing reads it, and no byte of the data depends on it. The
manifest is read once, row by row, into sums, counts and histograms that stay small however many rows there are; of the
arrays only a few pairs are looked at, evenly spread (`FITTED`, and those of the contact sheet). What it says rests on
``dataset.json``, ``config.yaml`` and ``manifest.csv``, whose SHA-256 are checked first; all bytes are checked by
``gen-dataset verify``.
"""

from __future__ import annotations

import io
import itertools
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.files import commit_file, file_sha256, machine_error
from unprocess_gen.core.types import Float, Row
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.dataset.keys import image_key, sample_key
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.reader import RawPairs
from unprocess_gen.dataset.shards import shard_name
from unprocess_gen.pipeline.workspace import REPORT, read_dataset
from unprocess_gen.reports import markup
from unprocess_gen.reports import photon_transfer as transfer
from unprocess_gen.reports.contact_sheet import contact_sheet
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.markup import Html, element
from unprocess_gen.reports.report_files import DATASET_ENTRIES, require_libraries
from unprocess_gen.sources.listing import encode_name

FITTED = 8
"""Pairs whose noise is fitted."""

NAMED, SHARDS_NAMED, WORDS_NAMED = 50, 20, 16
"""Failures, shards and values of a word that are listed; what is more is counted."""


def write_dataset_report(folder: Path, to: Path | None = None, source: Path | None = None) -> Path:
    """Write the page of a finished dataset, ``report.html`` in its folder unless told otherwise; return its path.

    ``source`` is the folder of the photographs, for the contact sheet (`preview.contact_sheet`).

    Raises ConfigError where nothing can be drawn, where ``to`` is a file of the dataset and ``source`` no folder,
    DamageError where the dataset is not finished or its manifest or settings are not those it was finished with,
    MachineError where the page cannot be written.
    """
    require_libraries("report")
    _check_finished(folder)
    to = folder / REPORT if to is None else to
    _check_to(folder, to)
    content = dataset_page(folder, source).encode()
    aside = to.with_name(to.name + ".part")
    try:
        aside.write_bytes(content)
        commit_file(aside, to)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise machine_error(error, to) from error
    return to


def _check_to(folder: Path, to: Path) -> None:
    if any(to.resolve().is_relative_to((folder / name).resolve()) for name in DATASET_ENTRIES):
        raise ConfigError(f"--to {to}: belongs to the dataset; name another file")
    if to.is_dir() or not to.parent.is_dir():
        raise ConfigError(f"--to {to}: expected the name of a file in a folder that is there")


def dataset_page(folder: Path, source: Path | None = None) -> str:
    """Return the page of a finished dataset; raises DamageError as `write_benchmark` does."""
    facts = _facts(folder)
    tally = ManifestStatistics()
    for rows in _batches(read_rows(folder / "manifest.csv")):
        tally.add(rows)
    name = encode_name(folder.resolve().name)
    return markup.page(
        f"Dataset {name}",
        element("h1", f"Dataset {name}"),
        element("p", _headline(facts)),
        *_pictures(folder, source, facts["pairs"]),
        *_section("Asked for", _asked(facts)),
        *_section("Made", _made(facts, tally)),
        *_section("Failed", _failed(facts, tally)),
        *_section("Effects", _effects(tally)),
        *_section("Drawn for every pair", _drawn(tally)),
        *_section("Clipped", _clipped(facts, tally)),
        *_section("Noise in the arrays", _noise(folder)),
        *_section("Load it", _loading(folder, facts, tally)),
        *_section("Make it again", _again(folder, facts)),
        *_section("Versions and hashes", _hashes(facts)),
        style=STYLE,
    )


def _section(title: str, content: Iterable[Html]) -> list[Html]:
    return [element("h2", title), *content]


def _check_finished(folder: Path) -> None:
    if not (folder / "dataset.json").exists():
        raise DamageError(f"{folder}: dataset.json is not here; is this a finished dataset?")


def _facts(folder: Path) -> dict[str, Any]:
    _check_finished(folder)
    facts = read_dataset(folder / "dataset.json")
    for name, key in (("manifest.csv", "manifest_sha256"), ("config.yaml", "config_sha256")):
        path = folder / name
        if not path.is_file() or file_sha256(path) != facts[key]:
            raise DamageError(f"{path}: is not the one that dataset.json names; gen-dataset verify {folder} says more")
    return facts


# -------------------------------------------------------------------------------------------------- what rows come to

BATCH = 512
"""Rows that are looked at together."""


def _batches(rows: Iterable[Row]) -> Iterator[list[Row]]:
    rows = iter(rows)
    return iter(lambda: list(itertools.islice(rows, BATCH)), [])


class Histogram:
    """Counts of values in at most `BINS` bins, whose width doubles as the range grows: no value is kept.

    A bin is a whole multiple of the width 2**exponent, so that two bins always make one of twice the width.
    """

    BINS = 48
    FINEST = -60

    def __init__(self) -> None:
        self.exponent = self.FINEST
        self.counts: dict[int, int] = {}
        self.number = 0
        self.total = 0.0
        self.least, self.greatest = math.inf, -math.inf

    def add(self, values: Float) -> None:
        """Count finite values, ``[N]``."""
        if not values.size:
            return
        self.number += values.size
        self.total += float(values.sum())
        self.least = min(self.least, float(values.min()))
        self.greatest = max(self.greatest, float(values.max()))
        while self._bin(self.greatest) - self._bin(self.least) >= self.BINS:
            self.counts = _halved(self.counts)
            self.exponent += 1
        bins, counts = np.unique(np.floor(values * 2.0**-self.exponent), return_counts=True)
        for at, count in zip(map(int, bins), map(int, counts), strict=True):
            self.counts[at] = self.counts.get(at, 0) + count

    def _bin(self, value: float) -> int:
        return math.floor(value * 2.0**-self.exponent)

    @property
    def mean(self) -> float:
        """Of all values."""
        return self.total / self.number

    def bars(self) -> list[int]:
        """Return the counts of neighbouring bins from the least value to the greatest: fewer bins for fewer values."""
        counts, most = self.counts, max(8, math.ceil(2 * self.number ** (1 / 3)))
        while max(counts) - min(counts) >= most:
            counts = _halved(counts)
        return [counts.get(at, 0) for at in range(min(counts), max(counts) + 1)]


def _halved(counts: Mapping[int, int]) -> dict[int, int]:
    """Return counts in bins of twice the width."""
    halved: dict[int, int] = {}
    for at, count in counts.items():
        halved[at // 2] = halved.get(at // 2, 0) + count
    return halved


class ValueCounts:
    """How often each of a few words was met; of those that come after `MOST` different ones, how many there were."""

    MOST = 64

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.others = 0

    def add(self, word: str) -> None:
        """Count a word."""
        if word in self.counts or len(self.counts) < self.MOST:
            self.counts[word] = self.counts.get(word, 0) + 1
        else:
            self.others += 1

    def said(self) -> str:
        """Return the words, the most frequent first, each with its count where there are several."""
        ranked = sorted(self.counts.items(), key=lambda one: (-one[1], one[0]))
        if len(ranked) == 1:
            return ranked[0][0]
        if self.others or (len(ranked) > 3 and ranked[0][1] == 1):
            return f"{'more than ' if self.others else ''}{len(ranked)} different ones"
        rest = sum(count for _, count in ranked[WORDS_NAMED:])
        named = [f"{word} ({count:,})" for word, count in ranked[:WORDS_NAMED]]
        return ", ".join([*named, *([f"others ({rest:,})"] if rest else [])])


@dataclass(frozen=True, slots=True)
class ParameterColumn:
    """A column of numbers that is drawn, or follows from what is: which draws of `plan.PARAMETERS` decide it."""

    column: str
    draws: tuple[str, ...] = ()
    physical: bool = False


PARAMETERS = (
    *(
        ParameterColumn(f"w_{name}", (f"weight_{at}", "choice"))
        for at, name in enumerate(("nexus_6p", "sony_a7r", "olympus_em10", "sony_rx100"))
    ),
    ParameterColumn("red_gain", ("red",)),
    ParameterColumn("blue_gain", ("blue",)),
    ParameterColumn("inverse_rgb_gain", ("inverse_rgb",)),
    ParameterColumn("exposure_ratio", ("exposure_ratio",)),
    ParameterColumn("a_dn", ("a", "iso")),
    ParameterColumn("b_dn2", ("b", "read_std")),
    ParameterColumn("iso", ("iso",), physical=True),
    ParameterColumn("exposure_s", ("exposure_s",), physical=True),
    ParameterColumn("temperature_c", ("temperature_c",), physical=True),
    ParameterColumn("dn_per_e", physical=True),
    ParameterColumn("dark_e", physical=True),
    ParameterColumn("read_shape", ("read_shape",), physical=True),
    ParameterColumn("read_std_dn", ("read_std",), physical=True),
    ParameterColumn("row_std_dn", ("row_std",), physical=True),
    ParameterColumn("column_std_dn", ("column_std",), physical=True),
)
WORDS = ("camera", "sensor_unit", "scene", "noise", "noise_law", "tone", "gamma", "highlight", "pattern", "accuracy")
SHARES = (
    *("clean_clipped_low", "clean_clipped_high", "noisy_clipped_low", "noisy_clipped_high"),
    *("saturated", "zero_variance"),
)
"""Counts of sites, shown as shares of a frame."""

MEANING = {column.name: column.meaning for column in COLUMNS}


class ColumnStatistics:
    """A column of numbers: its values in bins, and in bins of their logarithms while all lie above 0."""

    MAGNITUDES = 20.0
    """Where the greatest is so many times the least, the logarithms are shown."""

    def __init__(self) -> None:
        self.plain = Histogram()
        self.log2 = Histogram()

    def add(self, values: Float) -> None:
        """Count values, ``[N]``."""
        self.plain.add(values)
        self.log2.add(np.log2(values[values > 0]))

    @property
    def by_magnitude(self) -> bool:
        """Whether its values are better seen on a logarithmic scale."""
        return self.plain.least > 0 and self.plain.greatest >= self.MAGNITUDES * self.plain.least

    @property
    def is_constant(self) -> bool:
        """Whether all values are one."""
        return self.plain.least == self.plain.greatest


@dataclass
class OmittedEffect:
    """An effect that was left out: of how many pairs, why it was of the first, and whether of all for that reason."""

    pairs: int
    reason: str
    always: bool = True


@dataclass
class ManifestStatistics:
    """What the rows of a manifest come to; as large for ten rows as for a million."""

    rows: int = 0
    images: int = 0
    failed: list[tuple[str, str, str]] = field(default_factory=list)
    spreads: dict[str, ColumnStatistics] = field(
        default_factory=lambda: {one.column: ColumnStatistics() for one in PARAMETERS}
    )
    shares: dict[str, ColumnStatistics] = field(default_factory=lambda: {name: ColumnStatistics() for name in SHARES})
    words: dict[str, ValueCounts] = field(default_factory=lambda: {name: ValueCounts() for name in WORDS})
    sizes: ValueCounts = field(default_factory=ValueCounts)
    effects: ValueCounts = field(default_factory=ValueCounts)
    skipped: dict[str, OmittedEffect] = field(default_factory=dict)
    physical: bool = False
    first: tuple[str, int] | None = None
    _image: str = ""

    def add(self, rows: Sequence[Row]) -> None:
        """Count some rows, in the order of the manifest."""
        self.rows += len(rows)
        made = [row for row in rows if row["status"] == "ok"]
        for row in rows:
            self._count_image(row)
            if row["status"] != "ok" and len(self.failed) < NAMED:
                self.failed.append((str(row["key"]), str(row["source"]), str(row["reason"])))
        for row in made:
            self._add_words(row)
        sites = np.array([float(row["width"] or 0) * float(row["height"] or 0) for row in made])
        for name, spread in self.spreads.items():
            spread.add(_numbers(made, name))
        for name, share in self.shares.items():
            share.add(_numbers(made, name) / sites)

    def _count_image(self, row: Row) -> None:
        image = image_key(row)
        self.images += image != self._image
        self._image = image

    def _add_words(self, row: Row) -> None:
        self.first = self.first or (str(row["key"]), int(row["shard"] or 0))
        self.physical |= row["read_law"] != "none"
        self.sizes.add(f"{row['width']} × {row['height']}")
        for name, words in self.words.items():
            words.add(str(row[name]))
        for effect in str(row["effects"]).split(";"):
            self.effects.add(effect)
        for text in filter(None, str(row["skipped"]).split(";")):
            self._skip(*text.partition(": ")[::2])

    def _skip(self, effect: str, reason: str) -> None:
        known = self.skipped.setdefault(effect, OmittedEffect(0, reason))
        known.pairs += 1
        known.always &= reason == known.reason


def _numbers(rows: Sequence[Row], name: str) -> Float:
    return np.array([float(row[name] or 0) for row in rows], dtype=np.float64)


# --------------------------------------------------------------------------------------------------------- sections

STYLE = """
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(15rem, 100%), 1fr)); gap: 1rem 1.5rem; }
.grid figure { margin: 0; } .grid figcaption { font-size: .85rem; }
svg { display: block; width: 100%; height: 5rem; background: var(--soft); fill: var(--bar); }
.ends { display: flex; justify-content: space-between; font-size: .8rem; font-variant-numeric: tabular-nums; }
.wide img { max-width: none; }
@media (min-width: 60rem) { .wide img { max-width: 100%; } }
summary { cursor: pointer; }
"""


def _headline(facts: Mapping[str, Any]) -> str:
    failed = sum(facts["failed"].values())
    size = sum(entry["bytes"] for entry in facts["shards"])
    return (
        f"{facts['pairs']:,} pairs of clean and noisy raw frames in {len(facts['shards']):,} shards, {_bytes(size)}; "
        f"{failed:,} failed."
    )


def _bytes(count: int) -> str:
    return f"{count / 1e9:,.2f} GB" if count >= 1e9 else f"{count / 1e6:,.1f} MB"


JPEG_QUALITY = 88


def _pictures(folder: Path, source: Path | None, pairs: int) -> list[Html]:
    """Return the contact sheet of a few pairs; as JPEG, since noise makes a PNG four times as large."""
    if not pairs:
        return [element("p", "Every photograph failed, so there is no pair to show.")]
    sheet = contact_sheet(folder, source=source)
    _, content = cv2.imencode(".jpg", sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return [element("div", markup.image(content.tobytes(), "contact sheet of a few pairs", "jpeg"), class_="wide")]


ASKED = (
    *("seed", "source.kind", "source.limit", "source.clips", "source.downscale", "source.dequantize", "source.patch"),
    *("camera.name", "camera.xyz2cam", "gains.red", "gains.blue", "gains.inverse_rgb", "gains.highlight"),
    *("isp.tone", "isp.gamma", "sensor.bits", "sensor.black_level_dn", "sensor.white_level_dn", "sensor.pattern"),
    *("sensor.clip", "sensor.saturated", "noise.name", "noise.law", "noise.iso", "noise.levels", "noise.draws"),
    *("scene.name", "scene.exposure_ratio", "effects.all", "effects.tolerance", "accuracy.name"),
)
"""Settings that are shown at once; the others are folded away."""


def _asked(facts: Mapping[str, Any]) -> list[Html]:
    settings = yaml.safe_load(facts["config"])
    said = {key: _setting(settings, key) for key in ASKED}
    lines = [(key, value) for key, value in said.items() if value != "null"]
    whole = element("details", element("summary", "all settings (config.yaml)"), element("pre", facts["config"]))
    return [markup.table(("setting", "value"), lines), whole]


def _setting(settings: Any, key: str) -> str:
    for name in key.split("."):
        settings = settings[name]
    return yaml.safe_dump(settings, default_flow_style=True, width=10**6, allow_unicode=True).partition("\n")[0]


def _made(facts: Mapping[str, Any], tally: ManifestStatistics) -> list[Html]:
    run = facts["run"]
    return [
        markup.facts(
            {
                "photographs": f"{tally.images:,}, rows {tally.rows:,}",
                "pairs": f"{facts['pairs']:,}, of {facts['sites']['all']:,} sites in all",
                "width × height": tally.sizes.said() if tally.first else "no pair",
                "files that no pattern matched": f"{facts['not_matched']:,}",
                "links not followed": f"{facts['skipped_links']:,}",
                "by": f"{run['host']}, {run['platform']}, Python {run['python']}; "
                f"{run['n_jobs']} at a time, {run['seconds']:,} s for the last {run['shards_made']:,} shards",
                "self-test": str(facts["self_test"]),
            }
        )
    ]


def _failed(facts: Mapping[str, Any], tally: ManifestStatistics) -> list[Html]:
    if not facts["failed"]:
        return [element("p", "Nothing failed.")]
    more = sum(facts["failed"].values()) - len(tally.failed)
    reasons = markup.table(("reason", "rows"), [(why, f"{count:,}") for why, count in facts["failed"].items()], {1})
    named = markup.table(("key", "source", "reason"), tally.failed)
    return [reasons, named, *([element("p", f"And {more:,} more; see manifest.csv.")] if more else [])]


def _effects(tally: ManifestStatistics) -> list[Html]:
    if tally.first is None:
        return [element("p", "No pair, no effect.")]
    simulated = [(effect, f"{count:,}") for effect, count in tally.effects.counts.items()]
    left_out = [
        (effect, f"{one.pairs:,}", one.reason if one.always else f"for example: {one.reason}")
        for effect, one in tally.skipped.items()
    ]
    tables = [markup.table(("simulated", "pairs"), simulated, {1})]
    return [*tables, markup.table(("left out", "pairs", "why"), left_out, {1})] if left_out else tables


def _drawn(tally: ManifestStatistics) -> list[Html]:
    if tally.first is None:
        return [element("p", "No pair, nothing drawn.")]
    words = {name: tally.words[name].said() for name in WORDS if tally.physical or name != "sensor_unit"}
    shown = {one.column: tally.spreads[one.column] for one in PARAMETERS if tally.physical or not one.physical}
    same = {name: short_number(spread.plain.least, 6) for name, spread in shown.items() if spread.is_constant}
    charts = [_chart(name, spread) for name, spread in shown.items() if not spread.is_constant]
    lines = [(name, text, MEANING[name]) for name, text in (words | same).items()]
    return [
        element("div", *charts, class_="grid"),
        markup.table(("column", "in every pair, or in how many", ""), lines),
    ]


def _chart(name: str, spread: ColumnStatistics, percent: bool = False) -> Html:
    """Return a column's histogram, with its ends below and its mean above it."""
    histogram = spread.log2 if spread.by_magnitude else spread.plain
    bars = histogram.bars()
    least, mean, greatest = (
        f"{short_number(value * 100, 3)} %" if percent else short_number(value, 4)
        for value in (spread.plain.least, spread.plain.mean, spread.plain.greatest)
    )
    scale = ", logarithmic" if spread.by_magnitude else ""
    caption = element("figcaption", element("b", name), f" {MEANING[name]}; mean {mean}{scale}")
    ends = element("div", element("span", least), element("span", greatest), class_="ends")
    return element("figure", caption, _bars(bars, f"histogram of {name}, {least} to {greatest}"), ends)


def _bars(counts: Sequence[int], label: str) -> Html:
    """Return a bar chart as SVG, as wide as its place: one bar a count, the highest fills the height."""
    most = max(counts)
    rects = (
        f'<rect x="{at + 0.05:.2f}" y="{100 - 100 * count / most:.2f}" width="0.9" height="{100 * count / most:.2f}"/>'
        for at, count in enumerate(counts)
        if count
    )
    view = f'viewBox="0 0 {len(counts)} 100" preserveAspectRatio="none" role="img"'
    return Html(f'<svg {view} aria-label="{markup.escaped(label)}">{"".join(rects)}</svg>')


def _clipped(facts: Mapping[str, Any], tally: ManifestStatistics) -> list[Html]:
    if tally.first is None:
        return [element("p", "No pair, no site.")]
    sites = facts["sites"]
    lines = [(name, f"{sites[name]:,}", f"{sites[name] / sites['all']:.3%}", MEANING[name]) for name in SHARES]
    charts = [_chart(name, one, percent=True) for name, one in tally.shares.items() if not one.is_constant]
    return [
        markup.table(("count", "sites", "of all", ""), lines, {1, 2}),
        element("p", "Shares of a frame's sites, pair by pair, where they differ:") if charts else Html(""),
        element("div", *charts, class_="grid"),
    ]


def _noise(folder: Path) -> list[Html]:
    """Return the photon-transfer check of a few pairs."""
    pairs = RawPairs(folder)
    count = min(FITTED, len(pairs))
    fits = [transfer.fit_pair(*pairs[number * len(pairs) // count]) for number in range(count)]
    found = [one for one in fits if one is not None]
    if not found:
        return [element("p", f"None of {count} pairs looked at has sites enough to fit its noise.")]
    drawing = io.BytesIO()
    transfer.draw_fits(found, drawing)
    wrong = sum(one.deviation > transfer.ALARM for one in found)
    verdict = (
        f"{wrong} of them are not what the manifest says: gen-dataset verify --noise looks at every pair."
        if wrong
        else "All are what the manifest says."
    )
    lines = [
        (
            one.key,
            f"{one.slope:.5g} ± {1.96 * one.slope_error:.2g}",
            f"{one.expected[0]:.5g}",
            f"{one.intercept:.5g} ± {1.96 * one.intercept_error:.2g}",
            f"{one.expected[1]:.5g}",
            f"{one.deviation:.1f}",
        )
        for one in found
    ]
    headings = ("pair", "a fitted, DN", "a expected", "b fitted, DN²", "b expected", "standard errors off")
    return [
        element(
            "p",
            f"Photon transfer: the variance of noisy less clean against the signal, of {len(found)} pairs, evenly "
            f"spread (a: slope, b: intercept, with 95 % intervals). {verdict} Above {transfer.ALARM:g} standard "
            "errors a fit is called wrong.",
        ),
        element("p", markup.image(drawing.getvalue(), "variance of noisy less clean against the signal")),
        markup.table(headings, lines, range(1, len(headings))),
    ]


def _loading(folder: Path, facts: Mapping[str, Any], tally: ManifestStatistics) -> list[Html]:
    if tally.first is None:
        return [element("p", "No pair, nothing to load.")]
    said = element("p", "From the folder that holds it:")
    return [said] + [
        part
        for title, text in snippets(folder, facts["shards"], tally.first, len(tally.sizes.counts) == 1).items()
        for part in (element("h3", title), element("pre", text))
    ]


def snippets(
    folder: Path, entries: Sequence[Mapping[str, Any]], first: tuple[str, int], is_one_size: bool
) -> dict[str, str]:
    """Return how to load a dataset, by tool; ``first`` is the key of its first pair and the number of its shard."""
    name = folder.resolve().name
    key = sample_key({"key": first[0]})
    count = len(entries)
    if re.fullmatch(r"[\w.+-]+", name) and all(entry["file"] for entry in entries):
        urls = repr(
            f"{name}/shards/shard-{{00000..{count - 1:05d}}}.tar" if count > 1 else f"{name}/{entries[0]['file']}"
        )
    else:  # shards with no pair have no file, and braces of its own would break the list
        urls = f"sorted(glob.glob(glob.escape({name!r}) + '/shards/*.tar'))"
    imports = "import glob\n\n" if urls.startswith("sorted") else ""
    size = "" if is_one_size else "  # frames differ in size: stack crops, not whole frames"
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


def _again(folder: Path, facts: Mapping[str, Any]) -> list[Html]:
    name = shlex.quote(folder.resolve().name)
    is_folder = facts["source"]["kind"] == "folder"
    root = " source.root=PHOTOGRAPHS" if is_folder else ""
    commands = "\n".join(
        (
            "# all of it, to the same bytes",
            f"gen-dataset again {name}{root} out=again",
            "# every byte, held against the manifest",
            f"gen-dataset verify {name}",
            "# ten rows, made again and compared",
            f"gen-dataset replay {name} --rows 0:10{root}",
        )
    )
    origin = f"The photographs were in {facts['source']['root']}." if is_folder else "Made of the built-in scenes."
    return [element("pre", commands), element("p", origin)]


def _hashes(facts: Mapping[str, Any]) -> list[Html]:
    entries = facts["shards"]
    said = {name: str(facts[name]) for name in ("fingerprint", "manifest_sha256", "config_sha256")}
    lines = [
        (shard_name(number), str(entry["pairs"]), str(entry["failed"]), f"{entry['bytes']:,}", entry["sha256"] or "–")
        for number, entry in enumerate(entries[:SHARDS_NAMED])
    ]
    more = len(entries) - len(lines)
    return [
        markup.table(("package", "version"), sorted(facts["versions"].items())),
        markup.facts(said),
        markup.table(("shard", "pairs", "failed", "bytes", "SHA-256"), lines, {1, 2, 3}),
        *([element("p", f"And {more:,} more; see dataset.json.")] if more else []),
    ]
