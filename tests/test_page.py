"""The page of a dataset: its figures are the manifest's, its names are harmless, its pictures are really there.

It is opened in a real browser, as wide as a desk's screen and as a phone, where there is one (chromium).
"""

from __future__ import annotations

import csv
import gc
import html
import itertools
import json
import math
import re
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Door, Make, fill
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.manifest import read_rows, write_rows
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.pipeline.workspace import dataset_facts, dataset_text, read_dataset
from unprocess_gen.planning import plan
from unprocess_gen.reports import dataset_report as page
from unprocess_gen.reports import markup, report_files
from unprocess_gen.reports import photon_transfer as transfer
from unprocess_gen.reports.benchmark import report
from unprocess_gen.reports.dataset_report import PARAMETERS, WORDS, Histogram, ManifestStatistics, ValueCounts

TreeHash = Callable[[Path], str]

HOSTILE = "<img src=x onerror=alert('&amp;')>\".png"
"""A name that would be markup, were it not escaped."""


OVERRIDES = ("output.pairs_per_shard=4", "noise=brooks2019")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, make: Make) -> Path:
    """A dataset in a folder of a hostile name: nine pairs, two photographs that cannot be read."""
    top = tmp_path_factory.mktemp("page")
    photos = fill(top / "photos", 9)
    (photos / HOSTILE).write_bytes(b"no picture")
    (photos / "empty.png").touch()
    out = top / "<b>&'\"{0} ds"
    make(photos, out, "source.max_failed=2", *OVERRIDES)
    return out


@pytest.fixture(scope="module")
def text(made: Path) -> str:
    return page.dataset_page(made)


@pytest.fixture(scope="module")
def scenes(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two built-in scenes, large enough that their noise can be fitted."""
    out = tmp_path_factory.mktemp("scenes") / "ds"
    make(None, out, "source.limit=2")
    return out


@pytest.fixture(scope="module")
def scenes_page(scenes: Path) -> str:
    return page.dataset_page(scenes)


def cells(folder: Path, column: str) -> list[str]:
    with (folder / "manifest.csv").open(newline="", encoding="utf-8") as stream:
        return [row[column] for row in csv.DictReader(stream) if row["status"] == "ok"]


# Laws -----------------------------------------------------------------------------------------------------------------

NUMBERS = st.floats(-1e15, 1e15, allow_nan=False).map(lambda value: value if abs(value) > 1e-12 else 0.0)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.lists(NUMBERS, max_size=20), min_size=1, max_size=8))
def test_a_histogram_has_every_value_in_its_bin(batches: list[list[float]]) -> None:
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


def test_a_histogram_of_uniform_values_is_flat() -> None:
    histogram = Histogram()
    for batch in np.random.default_rng(0).random((1000, 100)):
        histogram.add(batch)
    bars = histogram.bars()
    assert len(bars) == 32
    assert max(abs(count - 100_000 / 32) for count in bars) < 5 * math.sqrt(100_000 / 32)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_a_tally_does_not_depend_on_how_rows_come(made: Path, size: int) -> None:
    def tallied(count: int) -> ManifestStatistics:
        tally, rows = ManifestStatistics(), list(read_rows(made / "manifest.csv"))
        for start in range(0, len(rows), count):
            tally.add(rows[start : start + count])
        return tally

    one, other = tallied(size), tallied(100)
    for name, spread in one.spreads.items():
        assert spread.plain.counts == other.spreads[name].plain.counts
    assert (one.rows, one.images, one.failed, one.skipped) == (other.rows, other.images, other.failed, other.skipped)


def test_words_are_counted_and_too_many_are_summed_up() -> None:
    few, many, different = ValueCounts(), ValueCounts(), ValueCounts()
    for number in range(1000):
        few.add("ab"[number % 3 == 0])
        many.add(str(number % 70))
        different.add(str(number % 10)) if number < 10 else None
    assert few.said() == "a (666), b (334)"
    assert many.said() == "more than 64 different ones"
    assert different.said() == "10 different ones"


def test_every_drawn_parameter_has_a_column_on_the_page() -> None:
    shown = {draw for one in PARAMETERS for draw in one.draws} | set(WORDS)
    assert set(plan.PARAMETERS) <= shown


def test_text_becomes_html_that_shows_it_and_html_stays() -> None:
    shown = markup.element("p", "<&\"'>", markup.element("b", "x"), title='"')
    assert shown == '<p title="&quot;">&lt;&amp;&quot;&#x27;&gt;<b>x</b></p>'


@pytest.mark.parametrize("sign", ["\x00", "\x1b", "\x85", "\u202e", "\u2066", "\u2028", "\udcff", "\uffff"])
def test_what_cannot_be_seen_is_spelled_out(sign: str) -> None:
    shown = markup.escaped(f"a{sign}b")
    assert sign not in shown
    assert shown.encode() == b"a" + sign.encode("unicode_escape") + b"b"


# What it says ---------------------------------------------------------------------------------------------------------


class Reader(HTMLParser):
    """What a browser would take from a page: its elements, their attributes, its text."""

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
}
ATTRIBUTES = {"lang", "charset", "name", "content", "class", "alt", "src", "viewbox", "preserveaspectratio", "role"}
ATTRIBUTES |= {"aria-label", "x", "y", "width", "height"}


def test_names_are_escaped_and_nothing_but_known_elements_is_on_the_page(text: str) -> None:
    read = Reader(text)
    assert read.tags <= TAGS
    assert read.attributes <= ATTRIBUTES
    assert HOSTILE in read.text
    assert "<b>&'\"{0} ds" in read.text


def test_the_page_opens_offline(text: str) -> None:
    addresses = Reader(text).addresses
    assert addresses and all(address.startswith("data:image/") for address in addresses)
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)


def test_failures_are_named_with_their_reasons(text: str) -> None:
    rows = re.findall(r"<tr><td>(\d{8})</td><td>(.*?)</td><td>(\w+)</td></tr>", text)
    assert {(html.unescape(source), reason) for _, source, reason in rows} == {
        (HOSTILE, "unsupported"),
        ("empty.png", "empty"),
    }


def test_the_ends_and_means_of_what_was_drawn_are_the_manifests(made: Path, text: str) -> None:
    for column in ("red_gain", "blue_gain", "inverse_rgb_gain", "w_nexus_6p", "a_dn", "b_dn2"):
        values = [float(cell) for cell in cells(made, column)]
        (figure,) = re.findall(rf"<figure><figcaption><b>{column}</b>.*?</figure>", text)
        ends = [float(found) for found in re.findall(r"<span>(.*?)</span>", figure)]
        assert ends == [float(f"{end:.4g}") for end in (min(values), max(values))]
        assert f"mean {report.spelled(sum(values) / len(values), 4)}" in figure
        assert figure.count("<rect ") >= 2


def test_levels_over_decades_are_shown_by_their_magnitude(text: str) -> None:
    logarithmic = re.findall(r"<b>(\w+)</b>[^<]*, logarithmic", text)
    assert {"a_dn", "b_dn2"} <= set(logarithmic)
    assert not {"red_gain", "blue_gain"} & set(logarithmic)


def test_clipping_is_the_manifests(made: Path, text: str) -> None:
    sites = sum(int(w) * int(h) for w, h in zip(cells(made, "width"), cells(made, "height"), strict=True))
    for column in ("saturated", "noisy_clipped_high"):
        count = sum(map(int, cells(made, column)))
        assert f'<td>{column}</td><td class="n">{count:,}</td><td class="n">{count / sites:.3%}</td>' in text


@pytest.mark.slow
def test_effects_that_were_left_out_have_their_reason(make: Make, tmp_path: Path) -> None:
    make(None, tmp_path / "ds", "source.limit=2", "noise=sony_a7s2", "effects.prnu=off", "source.patch=[random,64,3]")
    text = page.dataset_page(tmp_path / "ds")
    assert '<tr><td>prnu</td><td class="n">6</td><td>switched off</td></tr>' in text
    assert '<tr><td>column</td><td class="n">6</td><td>noise=sony_a7s2 gives no column_std_dn</td></tr>' in text
    assert "<b>read_std_dn</b>" in text
    assert "<dd>2, rows 6</dd>" in text


def test_versions_hashes_settings_and_commands_are_there(made: Path, text: str) -> None:
    facts, read = read_dataset(made / "dataset.json"), Reader(text).text
    shards = [entry["sha256"] for entry in facts["shards"] if entry["sha256"]]
    assert len(shards) == 3
    for said in (*shards, facts["fingerprint"], facts["manifest_sha256"], facts["config_sha256"]):
        assert said in read
    assert facts["versions"]["numpy"] in read
    assert (made / "config.yaml").read_text(encoding="utf-8") in read
    assert "source.root=PHOTOGRAPHS out=again" in read
    assert facts["source"]["root"] in read


def test_noise_that_is_not_the_manifests_is_called_wrong(
    scenes: Path, scenes_page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "of 2 pairs, evenly spread (a: slope, b: intercept, with 95 % intervals). All are what" in scenes_page
    true = transfer.fit_pair
    monkeypatch.setattr(transfer, "fit_pair", lambda *given: replace(true(*given), expected=(9.0, 38.0)))
    assert "2 of them are not what the manifest says" in page.dataset_page(scenes)


def test_where_every_photograph_failed_there_is_a_page_all_the_same(make: Make, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").touch()
    make(tmp_path / "photos", tmp_path / "ds", "source.max_failed=1")
    text = page.dataset_page(tmp_path / "ds")
    assert "0 pairs" in text and "1 failed" in text
    assert '<tr><td>empty</td><td class="n">1</td></tr>' in text


# How to load it -------------------------------------------------------------------------------------------------------


def run_snippet(folder: Path, tool: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run what the page says, from the folder that holds the dataset."""
    monkeypatch.chdir(folder.parent)
    first = RawPairs(folder)[0].row
    entries = read_dataset(folder / "dataset.json")["shards"]
    names: dict[str, Any] = {}
    exec(page.snippets(folder, entries, (first["key"], first["shard"]), False)[tool], names)
    return names


@pytest.fixture(params=["hostile", "plain"])
def loaded(request: pytest.FixtureRequest, made: Path, dataset: Path) -> Path:
    return made if request.param == "hostile" else dataset


def test_the_lines_for_numpy_load_the_first_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_snippet(loaded, "NumPy", monkeypatch)
    clean, noisy, _ = RawPairs(loaded)[0]
    np.testing.assert_array_equal(names["clean"], clean)
    np.testing.assert_array_equal(names["noisy"], noisy)


@pytest.mark.filterwarnings("ignore")  # those of another library
def test_the_lines_for_webdataset_load_every_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("webdataset")
    names = run_snippet(loaded, "webdataset", monkeypatch)
    assert len(list(names["samples"])) == len(RawPairs(loaded))
    np.testing.assert_array_equal(names["noisy"], RawPairs(loaded)[len(RawPairs(loaded)) - 1].noisy)
    gc.collect()  # while warnings of files it leaves open are ignored


def test_the_lines_for_pytorch_load_every_pair(loaded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    names = run_snippet(loaded, "PyTorch", monkeypatch)
    assert sum(map(len, names["loader"])) == len(RawPairs(loaded))


# The command, and the dataset it leaves alone -------------------------------------------------------------------------


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "ds")
    return tmp_path / "ds"


def test_the_command_writes_one_file_and_the_dataset_stays_what_it_is(
    copy: Path, made: Path, door: Door, tree_hash: TreeHash
) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in copy.iterdir() if path.is_file()}
    for _ in range(2):  # an earlier page is overwritten
        done = door("report", copy)
        assert (done.code, done.out, done.err) == (0, f"{copy}/report.html\n", "")
    after = {path.name: path.stat().st_mtime_ns for path in copy.iterdir() if path.is_file()}
    assert {name: time for name, time in after.items() if name != "report.html"} == before
    assert tree_hash(copy) == tree_hash(made)
    assert verify(copy) == []


def test_a_dataset_with_a_page_is_complete_and_can_be_made_again_and_resumed(
    made: Path, copy: Path, door: Door, tmp_path: Path
) -> None:
    photos = made.parent / "photos"
    bare = ("source.max_failed=2", f"source.root={photos}", f"out={copy}", "n_jobs=1", *OVERRIDES)
    assert door("report", copy).code == 0
    done = door(*bare)
    assert (done.code, "nothing to do" in done.out) == (0, True)
    again = door("again", copy, *bare[:2], "n_jobs=1", f"out={tmp_path / 'again'}")
    assert again.code == 0
    assert "bit for bit" in again.out
    (copy / "shards/shard-00001.tar").unlink()
    assert door("verify", copy, "--repair").code == 0
    assert verify(copy) == []
    assert (copy / "report.html").exists()
    (copy / "dataset.json").unlink()  # as a run that was killed before its end
    (copy / "manifest.csv").unlink()
    shutil.rmtree(copy / "shards")
    assert door(*bare).code == 0
    assert verify(copy) == []
    assert (copy / "report.html").exists()


def test_the_page_can_be_written_elsewhere(copy: Path, door: Door, tmp_path: Path) -> None:
    done = door("report", copy, "--to", tmp_path / "page.html")
    assert (done.code, done.out) == (0, f"{tmp_path}/page.html\n")
    assert not (copy / "report.html").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ds", "page.html"]


@pytest.mark.parametrize(
    "to",
    ["ds/manifest.csv", "ds/config.yaml", "ds/dataset.json", "ds/shards/report.html", "ds/shards", "ds/.work/page"],
)
def test_a_file_of_the_dataset_is_no_place_for_the_page(to: str, copy: Path, door: Door, tree_hash: TreeHash) -> None:
    before = tree_hash(copy)
    done = door("report", copy, "--to", to)
    assert (done.code, done.err) == (2, f"gen-dataset: --to {to}: belongs to the dataset; name another file\n")
    assert tree_hash(copy) == before


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "report: expected the folder of a dataset"),
        (("--to", "x"), "report: expected the folder of a dataset"),
        (("ds", "--too", "x"), "report: --too: expected --to"),
        (("ds", "--to", "."), "--to .: expected the name of a file"),
        (("ds", "--to", "no/such.html"), "--to no/such.html: expected the name of a file in a folder that is there"),
    ],
)
def test_a_mistake_costs_one_line(arguments: tuple[str, ...], sentence: str, copy: Path, door: Door) -> None:
    done = door("report", *arguments)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"gen-dataset: {sentence}")
    assert not (copy / "report.html").exists()


def test_without_matplotlib_one_line_names_the_extra(copy: Path, door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_files, "find_spec", lambda name: None)
    done = door("report", copy)
    assert done.code == 2
    assert done.err == "gen-dataset: report: drawing needs matplotlib; pip install 'unprocess_gen[figures]'\n"


@pytest.mark.parametrize("name", ["manifest.csv", "config.yaml", "dataset.json"])
def test_a_dataset_that_is_not_as_it_was_finished_has_no_page(name: str, copy: Path, door: Door) -> None:
    (copy / name).write_bytes((copy / name).read_bytes().replace(b"0", b"1", 1))
    done = door("report", copy)
    assert (done.code, done.out, done.err.count("\n")) == (4, "", 1)
    assert name in done.err
    assert not (copy / "report.html").exists()


def test_an_unfinished_dataset_has_no_page(copy: Path, door: Door) -> None:
    (copy / "dataset.json").unlink()
    done = door("report", copy)
    assert (done.code, done.err) == (
        4,
        f"gen-dataset: {copy}: dataset.json is not here; is this a finished dataset?\n",
    )


@pytest.mark.slow
def test_the_page_of_a_hundred_thousand_rows_is_small_and_needs_no_more_memory(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = list(read_rows(made / "manifest.csv"))

    def rows(count: int) -> Iterator[Row]:
        for number in range(count):
            row = dict(known[number % len(known)]) | {"key": f"{number:08d}", "shard": number // 8}
            yield row | ({"red_gain": 2 + number / count, "sensor_unit": str(number)} if row["status"] == "ok" else {})

    facts = read_dataset(made / "dataset.json")
    entries = facts["shards"][:1] * 12_500
    monkeypatch.setattr(page, "_noise", lambda folder: [])  # no shard holds these pairs
    monkeypatch.setattr(page, "_pictures", lambda folder, source, pairs: [])
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
        sizes.append(len(page.dataset_page(out).encode()))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(sizes) < 200_000
    assert peaks[1] < 1.1 * peaks[0] < 100e6


# In a real browser ----------------------------------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND",  # whatever the page might ask the net for, it does not get
)
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
  addEventListener("message", (told) => { document.body.dataset.measured = told.data; });
</script><iframe src="%s" style="border: 0; display: block; width: %dpx; height: %dpx"></iframe></body>"""
"""The page stands in a frame, since the window of a headless browser is never narrower than 500 pixels."""


def browse(content: str, width: int, folder: Path) -> tuple[dict[str, Any], np.ndarray]:
    """Open a page in chromium: what its elements measure, and what it looks like, ``[H, W, 3]``."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")

    def called(page_name: str, height: int, *flags: str) -> str:
        frame = folder / f"frame_of_{page_name}"
        frame.write_text(FRAME % (page_name, width, height), encoding="utf-8")
        window = f"--window-size={max(width, 500)},{height}"
        command = [CHROMIUM or "", *FLAGS, f"--user-data-dir={folder / 'profile'}", window, *flags, frame.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=folder)
        assert done.returncode == 0, done.stderr
        return done.stdout

    (folder / "page.html").write_text(content, encoding="utf-8")
    (folder / "measured.html").write_text(content.replace("</body>", MEASURE + "</body>"), encoding="utf-8")
    dom = called("measured.html", 1000, "--virtual-time-budget=10000", "--dump-dom")
    (found,) = re.findall(r'data-measured="([^"]*)"', dom)
    measured: dict[str, Any] = json.loads(html.unescape(found))
    shot = folder / "shot.png"
    called("page.html", measured["high"], f"--screenshot={shot}")
    return measured, np.asarray(Image.open(shot).convert("RGB"))[:, :width]


def colours_in(picture: np.ndarray, box: list[float]) -> int:
    """How many colours a part of a picture holds; ``box`` is left, top, width and height."""
    x, y, width, height = (round(length) for length in box)
    part = picture[y : y + height, x : x + width].astype(np.uint32)
    assert part.size, f"{box} lies outside of the picture, {picture.shape}"
    return len(np.unique(part[..., 0] << 16 | part[..., 1] << 8 | part[..., 2]))


@pytest.mark.parametrize("width", [1200, 360])
def test_a_browser_shows_every_picture_and_chart_and_nothing_sticks_out(
    width: int, scenes_page: str, tmp_path: Path
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


@pytest.mark.slow
def test_the_browser_would_see_a_page_that_sticks_out_and_a_picture_that_is_not_there(
    scenes_page: str, tmp_path: Path
) -> None:
    broken = scenes_page.replace(".wide { overflow-x: auto;", ".wide {").replace("pre, .wide", "pre, .narrow")
    broken = re.sub(r'src="data:[^"]*"', 'src="gone.png"', broken)
    measured, _ = browse(broken, 360, tmp_path)
    assert measured["wide"][0] > 360 or measured["cut"]
    assert [natural for _, natural, _ in measured["pictures"]] == [0] * len(measured["pictures"])
