"""The report of a dataset: it agrees with the manifest, escapes names, and shows every picture.

If Chromium is installed, the report is opened in it at the widths of a desktop screen and a phone.
"""

from __future__ import annotations

import csv
import gc
import html
import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import open_page
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill
from helpers.promise_report import Figure
from hypothesis import given, settings
from hypothesis import strategies as st
from jinja2 import UndefinedError
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.pipeline.workspace import dataset_facts, dataset_text, read_dataset
from unprocess_gen.planning import plan
from unprocess_gen.reports import formatting, html_pages, report_files
from unprocess_gen.reports.dataset_page import page as dataset_report
from unprocess_gen.reports.dataset_page.statistics import (
    PARAMETER_COLUMNS,
    TEXT_COLUMNS,
    Histogram,
    ManifestStatistics,
    ValueCounts,
)

HOSTILE = "<img src=x onerror=alert('&amp;')>\".png"
"""A file name that is markup unless it is escaped."""


OVERRIDES = ("output.pairs_per_shard=4", "noise=brooks2019")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """A dataset in a folder with a hostile name: nine pairs and two unreadable photographs."""
    top = tmp_path_factory.mktemp("page")
    photos = fill(top / "photos", 9)
    (photos / HOSTILE).write_bytes(b"no picture")
    (photos / "empty.png").touch()
    out = top / "<b>&'\"{0} ds"
    make(photos, out, "source.max_failed=2", *OVERRIDES)
    return out


@pytest.fixture(scope="module")
def text(made: Path) -> str:
    return dataset_report.dataset_page(made)


@pytest.fixture(scope="module")
def scenes(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two built-in scenes, large enough that their noise can be fitted."""
    out = tmp_path_factory.mktemp("scenes") / "ds"
    make(None, out, "source.limit=2")
    return out


@pytest.fixture(scope="module")
def scenes_page(scenes: Path) -> str:
    return dataset_report.dataset_page(scenes)


def cells(folder: Path, column: str) -> list[str]:
    with (folder / "manifest.csv").open(newline="", encoding="utf-8") as stream:
        return [row[column] for row in csv.DictReader(stream) if row["status"] == "ok"]


# Statistics -----------------------------------------------------------------------------------------------------------

NUMBERS = st.floats(-1e15, 1e15, allow_nan=False).map(lambda value: value if abs(value) > 1e-12 else 0.0)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.lists(NUMBERS, max_size=20), min_size=1, max_size=8))
def test_histogram_counts_every_value_in_its_bin(batches: list[list[float]]) -> None:
    histogram = Histogram()
    for batch in batches:
        histogram.add(np.array(batch, dtype=np.float64))
    values = list(itertools.chain.from_iterable(batches))
    width = 2.0**histogram.exponent
    expected: dict[int, int] = {}
    for value in values:
        expected[math.floor(value / width)] = expected.get(math.floor(value / width), 0) + 1
    assert histogram.counts == expected
    assert histogram.number == len(values)
    if values:
        assert (histogram.least, histogram.greatest) == (min(values), max(values))
        assert max(expected) - min(expected) < Histogram.BINS
        assert sum(histogram.bars()) == len(values)


def test_histogram_of_uniform_values_is_flat() -> None:
    histogram = Histogram()
    for batch in np.random.default_rng(0).random((1000, 100)):
        histogram.add(batch)
    bars = histogram.bars()
    assert len(bars) == 32
    assert max(abs(count - 100_000 / 32) for count in bars) < 5 * math.sqrt(100_000 / 32)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_statistics_do_not_depend_on_batch_size(made: Path, size: int) -> None:
    def tallied(count: int) -> ManifestStatistics:
        tally, rows = ManifestStatistics(), list(read_rows(made / "manifest.csv"))
        for start in range(0, len(rows), count):
            tally.add(rows[start : start + count])
        return tally

    one, other = tallied(size), tallied(100)
    for name, statistics in one.parameters.items():
        assert statistics.linear.counts == other.parameters[name].linear.counts
    assert (one.rows, one.images, one.failed, one.omitted) == (other.rows, other.images, other.failed, other.omitted)


def test_values_are_counted_and_many_values_are_summarised() -> None:
    few, many, different = ValueCounts(), ValueCounts(), ValueCounts()
    for number in range(1000):
        few.add("ab"[number % 3 == 0])
        many.add(str(number % 70))
        different.add(str(number % 10)) if number < 10 else None
    assert few.summary() == "a (666), b (334)"
    assert many.summary() == "more than 64 different values"
    assert different.summary() == "10 different values"


def test_every_drawn_parameter_has_a_column_in_the_report() -> None:
    shown = {draw for one in PARAMETER_COLUMNS for draw in one.draws} | set(TEXT_COLUMNS)
    assert set(plan.PARAMETERS) <= shown


def test_values_are_escaped_in_text_and_attributes() -> None:
    figure = {"title": "<&\"'>", "file": '" onerror="x', "caption": ["<b>"], "table": None}
    page = html_pages.render_page("paper_figures.html", title="<t>", command="<c>", figures=[figure])

    assert "<h2>&lt;&amp;&#34;&#39;&gt;</h2>" in page
    assert 'src="&#34; onerror=&#34;x"' in page
    assert "<p>&lt;b&gt;</p>" in page
    assert "<title>&lt;t&gt;</title>" in page


def test_missing_template_value_is_an_error() -> None:
    with pytest.raises(UndefinedError):
        html_pages.render_page("benchmark.html", title="x")


@pytest.mark.parametrize("sign", ["\x00", "\x1b", "\x85", "\u202e", "\u2066", "\u2028", "\udcff", "\uffff"])
def test_invisible_characters_are_shown_as_escapes(sign: str) -> None:
    page = html_pages.render_page("paper_figures.html", title=f"a{sign}b", command="", figures=[])
    assert sign not in page
    assert f"<h1>a{sign.encode('unicode_escape').decode()}b</h1>" in page


# Contents -------------------------------------------------------------------------------------------------------------


class Reader(HTMLParser):
    """Collect the elements, attributes, addresses and text of a page."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.addresses: list[str] = []
        self.text = ""
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "data", "poster", "action")]

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


TAGS = {"html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "p", "pre", "div", "span", "b"}
TAGS |= {
    "table",
    "tr",
    "th",
    "td",
    "dl",
    "dt",
    "dd",
    "figure",
    "figcaption",
    "details",
    "summary",
    "svg",
    "rect",
    "img",
    "thead",
    "tbody",
}
ATTRIBUTES = {"lang", "charset", "name", "content", "class", "alt", "src", "viewbox", "preserveaspectratio", "role"}
ATTRIBUTES |= {"aria-label", "x", "y", "width", "height", "scope"}


def test_names_are_escaped_and_only_known_elements_occur(text: str) -> None:
    read = Reader(text)
    assert read.tags <= TAGS
    assert read.attributes <= ATTRIBUTES
    assert HOSTILE in read.text
    assert "<b>&'\"{0} ds" in read.text


def test_report_opens_offline(text: str) -> None:
    addresses = Reader(text).addresses
    assert addresses and all(address.startswith("data:image/") for address in addresses)
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)


def test_failures_are_listed_with_reason_and_detail(made: Path, text: str) -> None:
    rows = re.findall(r"<tr><td>(\d{8})</td><td>(.*?)</td><td>(\w+)</td><td class=\"w\">(.*?)</td></tr>", text)
    assert {(html.unescape(source), reason) for _, source, reason, _ in rows} == {
        (HOSTILE, "unsupported"),
        ("empty.png", "empty"),
    }
    details = {str(row["source"]): str(row.get("detail") or "") for row in read_rows(made / "manifest.csv")}
    assert all(html.unescape(detail) == details[html.unescape(source)] for _, source, _, detail in rows)


def test_ranges_and_means_agree_with_the_manifest(made: Path, text: str) -> None:
    for column in ("red_gain", "blue_gain", "inverse_rgb_gain", "w_nexus_6p", "a_dn", "b_dn2"):
        values = [float(cell) for cell in cells(made, column)]
        (figure,) = re.findall(rf"(?s)<figure><figcaption><b>{column}</b>.*?</figure>", text)
        ends = [float(found) for found in re.findall(r"<span>(.*?)</span>", figure)]
        assert ends == [float(f"{end:.4g}") for end in (min(values), max(values))]
        assert f"mean {formatting.short_number(sum(values) / len(values), 4)}" in figure
        assert figure.count("<rect ") >= 2


def test_wide_ranges_have_logarithmic_histograms(text: str) -> None:
    logarithmic = re.findall(r"<b>(\w+)</b>[^<]*, logarithmic", text)
    assert {"a_dn", "b_dn2"} <= set(logarithmic)
    assert not {"red_gain", "blue_gain"} & set(logarithmic)


def test_clipped_sites_agree_with_the_manifest(made: Path, text: str) -> None:
    sites = sum(int(w) * int(h) for w, h in zip(cells(made, "width"), cells(made, "height"), strict=True))
    for column in ("saturated", "noisy_clipped_high"):
        count = sum(map(int, cells(made, column)))
        assert f'<td>{column}</td><td class="n">{count:,}</td><td class="n">{count / sites:.3%}</td>' in text


@pytest.mark.slow
def test_omitted_effects_are_listed_with_their_reason(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2", "noise=sony_a7s2", "effects.prnu=off", "source.patch=[random,64,3]")
    text = dataset_report.dataset_page(tmp_path / "ds")
    assert '<tr><td>prnu</td><td class="n">6</td><td>switched off</td></tr>' in text
    assert '<tr><td>column</td><td class="n">6</td><td>noise=sony_a7s2 gives no column_std_dn</td></tr>' in text
    assert "<b>read_std_dn</b>" in text
    assert "<dd>2, rows 6</dd>" in text


def test_versions_checksums_settings_and_commands_are_listed(made: Path, text: str) -> None:
    facts, read = read_dataset(made / "dataset.json"), Reader(text).text
    shards = [entry["sha256"] for entry in facts["shards"] if entry["sha256"]]
    assert len(shards) == 3
    for said in (*shards, facts["fingerprint"], facts["manifest_sha256"], facts["config_sha256"]):
        assert said in read
    assert facts["versions"]["numpy"] in read
    assert (made / "config.yaml").read_text(encoding="utf-8") in read
    assert "source.root=PHOTOGRAPHS out=again" in read
    assert facts["source"]["root"] in read


def test_noise_that_differs_from_the_manifest_is_reported(
    scenes: Path, scenes_page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "All agree with the manifest." in scenes_page
    monkeypatch.setattr(dataset_report, "threshold", lambda pairs: 0.0)
    assert "The noise of 2 of them differs from the manifest: noise of 00000000: " in dataset_report.dataset_page(
        scenes
    )


def test_dataset_without_pairs_has_a_report(make: Make, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").touch()
    make(tmp_path / "photos", tmp_path / "ds", "source.max_failed=1")
    text = dataset_report.dataset_page(tmp_path / "ds")
    assert "0 pairs" in text and "failed rows: 1." in text
    assert "there is no pair to show" in text
    assert '<tr><td>empty</td><td class="n">1</td></tr>' in text


# Code that loads the data ---------------------------------------------------------------------------------------------


def run_snippet(folder: Path, tool: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the code of the report in the folder that contains the dataset."""
    monkeypatch.chdir(folder.parent)
    first = RawPairs(folder)[0].row
    entries = read_dataset(folder / "dataset.json")["shards"]
    names: dict[str, Any] = {}
    exec(dataset_report.snippets(folder, entries, (first["key"], first["shard"]), False)[tool], names)
    return names


@pytest.fixture(params=["hostile", "plain"])
def loaded(request: pytest.FixtureRequest, made: Path, dataset: Path) -> Path:
    return made if request.param == "hostile" else dataset


def test_numpy_code_loads_the_first_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_snippet(loaded, "NumPy", monkeypatch)
    clean, noisy, _ = RawPairs(loaded)[0]
    np.testing.assert_array_equal(names["clean"], clean)
    np.testing.assert_array_equal(names["noisy"], noisy)


@pytest.mark.filterwarnings("ignore")  # of another library
def test_webdataset_code_loads_every_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("webdataset")
    names = run_snippet(loaded, "webdataset", monkeypatch)
    assert len(list(names["samples"])) == len(RawPairs(loaded))
    np.testing.assert_array_equal(names["noisy"], RawPairs(loaded)[len(RawPairs(loaded)) - 1].noisy)
    gc.collect()  # closes its files while warnings are ignored


def test_pytorch_code_loads_every_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    names = run_snippet(loaded, "PyTorch", monkeypatch)
    assert sum(map(len, names["loader"])) == len(RawPairs(loaded))


# The verb report ------------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "ds")
    return tmp_path / "ds"


def test_report_writes_one_file_and_leaves_the_dataset_unchanged(
    copy: Path, made: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in copy.iterdir() if path.is_file()}
    for _ in range(2):  # an earlier report is overwritten
        done = run_main("report", copy)
        assert (done.code, done.out, done.err) == (0, f"{copy}/report.html\n", "")
    after = {path.name: path.stat().st_mtime_ns for path in copy.iterdir() if path.is_file()}
    assert {name: time for name, time in after.items() if name != "report.html"} == before
    assert tree_hash(copy) == tree_hash(made)
    assert verify(copy) == []


def test_dataset_with_report_can_be_regenerated_repaired_and_resumed(
    made: Path, copy: Path, run_main: RunMain, tmp_path: Path
) -> None:
    photos = made.parent / "photos"
    bare = ("source.max_failed=2", f"source.root={photos}", f"out={copy}", "n_jobs=1", *OVERRIDES)
    assert run_main("report", copy).code == 0
    done = run_main(*bare)
    assert (done.code, "nothing to do" in done.out) == (0, True)
    again = run_main("again", copy, *bare[:2], "n_jobs=1", f"out={tmp_path / 'again'}")
    assert again.code == 0
    assert "bit for bit" in again.out
    (copy / "shards/shard-00001.tar").unlink()
    assert run_main("verify", copy, "--repair").code == 0
    assert verify(copy) == []
    assert (copy / "report.html").exists()
    (copy / "dataset.json").unlink()  # like a run that was killed
    (copy / "manifest.csv").unlink()
    shutil.rmtree(copy / "shards")
    assert run_main(*bare).code == 0
    assert verify(copy) == []
    assert (copy / "report.html").exists()


def test_report_can_be_written_to_another_file(copy: Path, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("report", copy, "--to", tmp_path / "page.html")
    assert (done.code, done.out) == (0, f"{tmp_path}/page.html\n")
    assert not (copy / "report.html").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ds", "page.html"]


@pytest.mark.parametrize(
    "to",
    ["ds/manifest.csv", "ds/config.yaml", "ds/dataset.json", "ds/shards/report.html", "ds/shards", "ds/.work/page"],
)
def test_report_does_not_replace_a_file_of_the_dataset(
    to: str, copy: Path, run_main: RunMain, tree_hash: TreeHash
) -> None:
    before = tree_hash(copy)
    done = run_main("report", copy, "--to", to)
    assert done.code == 2
    assert done.err == (
        f"gen-dataset: --to {to}: is inside the dataset {copy.resolve()}; expected a file outside of datasets; "
        "choose another name\n"
    )
    assert tree_hash(copy) == before


@pytest.mark.parametrize(("content", "code"), [(b"\xff\xd8\xff a photograph", 2), (b"<!DOCTYPE html>", 0)])
def test_report_replaces_only_an_html_page(
    content: bytes, code: int, copy: Path, run_main: RunMain, tmp_path: Path
) -> None:
    (tmp_path / "page").write_bytes(content)
    assert run_main("report", copy, "--to", "page").code == code
    assert ((tmp_path / "page").read_bytes() == content) == (code == 2)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "report: expected the folder of a dataset"),
        (("--to", "x"), "report: expected the folder of a dataset"),
        (("ds", "--too", "x"), "report: --too: no such flag; expected --to, "),
        (("ds", "--to", "."), "--to .: expected the name of a file"),
        (("ds", "--to", "no/such.html"), "--to no/such.html: expected the name of a file in a folder that exists"),
    ],
)
def test_wrong_arguments_give_one_line(
    arguments: tuple[str, ...], sentence: str, copy: Path, run_main: RunMain
) -> None:
    done = run_main("report", *arguments)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"gen-dataset: {sentence}")
    assert not (copy / "report.html").exists()


def test_folder_that_cannot_be_written_is_refused(
    copy: Path, run_main: RunMain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "locked").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and access(path, mode))
    done = run_main("report", copy, "--to", "locked/page.html")
    assert done == (
        2,
        "",
        "gen-dataset: --to locked/page.html: cannot be written (Permission denied); choose another folder\n",
    )


@pytest.mark.parametrize(
    ("library", "purpose"), [("matplotlib", "drawing needs matplotlib"), ("jinja2", "HTML pages need jinja2")]
)
def test_missing_library_gives_one_line_that_names_the_extra(
    library: str, purpose: str, copy: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_files, "find_spec", lambda name: None if name == library else "spec")
    done = run_main("report", copy)
    assert done.code == 2
    assert done.err == f"gen-dataset: report: {purpose}; in the source folder, run: pip install '.[figures]'\n"


def test_import_of_the_dataset_report_leaves_numba_out() -> None:
    code = (
        "import sys, unprocess_gen.reports.dataset_page.page\n"
        "print([name for name in ('numba', 'matplotlib', 'jinja2') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("name", ["manifest.csv", "config.yaml", "dataset.json"])
def test_changed_dataset_is_damage(name: str, copy: Path, run_main: RunMain) -> None:
    (copy / name).write_bytes((copy / name).read_bytes().replace(b"0", b"1", 1))
    done = run_main("report", copy)
    assert (done.code, done.out, done.err.count("\n")) == (4, "", 1)
    assert name in done.err
    assert not (copy / "report.html").exists()


def test_unfinished_dataset_is_damage(copy: Path, run_main: RunMain) -> None:
    (copy / "dataset.json").unlink()
    done = run_main("report", copy)
    assert (done.code, done.err) == (
        4,
        f"gen-dataset: {copy}: dataset.json does not exist; expected a finished dataset\n",
    )


@pytest.mark.slow
def test_size_and_memory_do_not_grow_with_rows(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = list(read_rows(made / "manifest.csv"))

    def rows(count: int) -> Iterator[Row]:
        for number in range(count):
            row = dict(known[number % len(known)]) | {"key": f"{number:08d}", "shard": number // 8}
            yield row | ({"red_gain": 2 + number / count, "sensor_unit": str(number)} if row["status"] == "ok" else {})

    facts = read_dataset(made / "dataset.json")
    entries = [facts["shards"][0] | {"file": f"shards/shard-{number:05d}.tar"} for number in range(12_500)]
    monkeypatch.setattr(
        dataset_report, "_noise_check", lambda folder: {"count": 0, "table": None}
    )  # no shard holds these pairs
    monkeypatch.setattr(dataset_report, "_contact_sheet", lambda folder, source: None)
    sizes, peaks = [], []
    for count in (10_000, 100_000):
        out = tmp_path / str(count)
        out.mkdir()
        (out / "config.yaml").write_text(facts["config"], encoding="utf-8")
        with (out / "manifest.csv").open("w", encoding="utf-8", newline="") as stream:
            write_rows(stream, rows(count))
        kept = {key: value for key, value in facts.items() if key not in ("config", "shards", "manifest_sha256")}
        signed = dataset_facts(facts["config"], file_sha256(out / "manifest.csv"), entries, kept)
        signed["manifest_sha256"] = file_sha256(out / "manifest.csv")
        (out / "dataset.json").write_text(dataset_text(signed), encoding="ascii")
        tracemalloc.start()
        sizes.append(len(dataset_report.dataset_page(out).encode()))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(sizes) < 200_000
    assert peaks[1] < 1.1 * peaks[0] < 100e6


# In a browser ---------------------------------------------------------------------------------------------------------

MEASURE = """<script>addEventListener("load", () => {
  const box = (one) => { const {x, y, width, height} = one.getBoundingClientRect(); return [x, y, width, height]; };
  const all = (what) => [...document.querySelectorAll(what)];
  parent.postMessage(JSON.stringify({
    wide: [document.documentElement.scrollWidth, innerWidth], high: document.documentElement.scrollHeight,
    pictures: all("img").map((one) => [one.complete, one.naturalWidth, box(one)]), charts: all("svg").map(box),
    cut: all("body *").filter((one) => one.clientWidth && one.scrollWidth > one.clientWidth + 1
      && getComputedStyle(one).overflowX === "visible").map((one) => one.outerHTML.slice(0, 80)),
  }), "*");
});</script>"""
FRAME = """<!doctype html><body style="margin: 0"><script>
  addEventListener("message", (message) => { document.body.dataset.measured = message.data; });
</script><iframe src="%s" style="border: 0; display: block; width: %dpx; height: %dpx"></iframe></body>"""
"""The report is shown in a frame, because the window of headless Chromium is at least 500 pixels wide."""


def browse(content: str, width: int, folder: Path) -> tuple[dict[str, Any], np.ndarray]:
    """Return the sizes of the elements of a page in Chromium, and a screenshot, uint8 ``[H, W, 3]``."""

    def called(page_name: str, height: int, *flags: str) -> str:
        frame = folder / f"frame_of_{page_name}"
        frame.write_text(FRAME % (page_name, width, height), encoding="utf-8")
        return open_page(frame, (max(width, 500), height), folder / "profile", *flags)

    (folder / "page.html").write_text(content, encoding="utf-8")
    (folder / "measured.html").write_text(content.replace("</body>", MEASURE + "</body>"), encoding="utf-8")
    dom = called("measured.html", 1000, "--virtual-time-budget=10000", "--dump-dom")
    (found,) = re.findall(r'data-measured="([^"]*)"', dom)
    measured: dict[str, Any] = json.loads(html.unescape(found))
    shot = folder / "shot.png"
    called("page.html", measured["high"], f"--screenshot={shot}")
    return measured, np.asarray(Image.open(shot).convert("RGB"))[:, :width]


def colours_in(picture: np.ndarray, box: list[float]) -> int:
    """Return the number of colours in a part of a picture; ``box`` is left, top, width and height."""
    x, y, width, height = (round(length) for length in box)
    part = picture[y : y + height, x : x + width].astype(np.uint32)
    assert part.size, f"{box} is outside the picture, {picture.shape}"
    return len(np.unique(part[..., 0] << 16 | part[..., 1] << 8 | part[..., 2]))


@pytest.mark.parametrize("width", [1200, 360])
def test_browser_shows_every_picture_without_overflow(
    width: int, scenes_page: str, tmp_path: Path, figure: Figure
) -> None:
    measured, shot = browse(scenes_page, width, tmp_path)
    assert measured["wide"] == [width, width]
    assert shot.shape[:2] == (measured["high"], width)
    assert measured["cut"] == []
    assert len(measured["pictures"]) == scenes_page.count("<img ") == 2
    for complete, natural_width, box in measured["pictures"]:
        assert complete and natural_width > 0
        assert colours_in(shot, [box[0], box[1], min(box[2], width - box[0]), box[3]]) > 100
    assert len(measured["charts"]) == scenes_page.count("<svg ") >= 7
    for box in measured["charts"]:
        assert box[2] >= min(200, width - 40) and box[3] >= 40
        assert colours_in(shot, box) >= 2
    figure("report", f"{width} pixels: page {measured['wide'][0]} wide, {len(measured['pictures'])} pictures shown")


@pytest.mark.slow
def test_overflow_and_missing_pictures_are_detected(scenes_page: str, tmp_path: Path) -> None:
    broken = scenes_page.replace(".wide { overflow-x: auto;", ".wide {").replace("pre, .wide", "pre, .narrow")
    broken = re.sub(r'src="data:[^"]*"', 'src="gone.png"', broken)
    measured, _ = browse(broken, 360, tmp_path)
    assert measured["wide"][0] > 360 or measured["cut"]
    assert [natural for _, natural, _ in measured["pictures"]] == [0] * len(measured["pictures"])
