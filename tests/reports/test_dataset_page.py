"""The report of a dataset: it agrees with the manifest, escapes names, and shows every picture.

If Chromium is installed, the report is opened in it at the widths of a desktop screen and a phone.
"""

from __future__ import annotations

import gc
import html
import io
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, TreeHash
from helpers.photographs import fill
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen import RawPairs
from unprocess_gen.dataset.dataset_json import read_dataset
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.reports import formatting, pages
from unprocess_gen.reports.dataset_page import dataset_page

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
    return dataset_page(made)


@pytest.fixture(scope="module")
def scenes_page(scenes: Path) -> str:
    return dataset_page(scenes)


def cells(folder: Path, column: str) -> list[Any]:
    return [row[column] for row in read_rows(folder / "manifest.csv") if row["status"] == "ok"]


@pytest.mark.parametrize("sign", ["\x1b", "\u202e", "\udcff"])
def test_invisible_characters_are_shown_as_escapes(sign: str) -> None:
    page = pages.render_page("base.html", title=f"a{sign}b")
    assert sign not in page
    assert f"<h1>a{sign.encode('unicode_escape').decode()}b</h1>" in page


# Contents -------------------------------------------------------------------------------------------------------------


class Reader(HTMLParser):
    """Collect the addresses and the text of a page."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.addresses, self.text = list[str](), ""
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href", "data", "poster", "action")]

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


def test_names_are_escaped_and_nothing_is_loaded(text: str) -> None:
    read = Reader(text)
    assert HOSTILE in read.text and "<b>&'\"{0} ds" in read.text
    assert read.addresses and all(address.startswith("data:image/") for address in read.addresses)
    assert not re.search(r"@import|url\(|https?://(?!www\.w3\.org)", text)


def test_failures_are_listed_with_reason_and_detail(made: Path, text: str) -> None:
    rows = re.findall(r"<tr><td>(\d{8})</td><td>(.*?)</td><td>(\w+)</td><td class=\"w\">(.*?)</td></tr>", text)
    failed = [row for row in read_rows(made / "manifest.csv") if row["status"] != "ok"]
    assert {row["source"] for row in failed} == {HOSTILE, "empty.png"}
    expected = [tuple(str(row[name]) for name in ("key", "source", "reason", "detail")) for row in failed]
    assert [tuple(map(html.unescape, row)) for row in rows] == expected


def test_numbers_agree_with_the_manifest(made: Path, text: str) -> None:
    for column in ("red_gain", "inverse_rgb_gain", "a_dn", "b_dn2"):
        values = cells(made, column)
        (row,) = re.findall(rf"<tr><td>{column}</td>(.*?)</tr>", text, re.DOTALL)
        shown = (formatting.short_number(number, 6) for number in (min(values), sum(values) / len(values), max(values)))
        assert re.findall(r'class="n">([^<]*)<', row) == list(shown)
    sites = sum(w * h for w, h in zip(cells(made, "width"), cells(made, "height"), strict=True))
    for column in ("saturated", "noisy_clipped_high"):
        count = sum(cells(made, column))
        assert f'<td>{column}</td><td class="n">{count:,}</td>\n<td class="n">{count / sites:.3%}</td>' in text


@pytest.mark.slow
def test_omitted_effects_are_listed_with_their_reason(make: Make, tmp_path: Path) -> None:
    camera = ["noise=oppo_reno10x", "noise.iso=[uniform,100,3200]", "effects.prnu=off"]
    make(None, tmp_path / "ds", "source.limit=2", *camera, "source.patch=[random,64,3]")
    text = dataset_page(tmp_path / "ds")
    assert '<tr><td>prnu</td><td class="w">switched off</td></tr>' in text
    assert '<tr><td>row</td><td class="w">noise=oppo_reno10x gives no row_std_dn</td></tr>' in text
    assert "<tr><td>read_std_dn</td>" in text
    assert "<dd>2, rows 6</dd>" in text


def test_versions_checksums_settings_and_commands_are_listed(made: Path, text: str) -> None:
    facts, read = read_dataset(made / "dataset.json"), Reader(text).text
    shards = [entry["sha256"] for entry in facts["shards"] if entry["sha256"]]
    assert len(shards) == 3
    for said in (*shards, facts["fingerprint"], facts["manifest_sha256"], facts["config_sha256"]):
        assert said in read
    assert facts["versions"]["numpy"] in read
    assert (made / "config.yaml").read_text(encoding="utf-8") in read
    assert re.search(r'<td>noise</td><td class="w">brooks2019</td>', text)
    assert "source.root=PHOTOGRAPHS out=again" in read
    assert facts["source"]["root"] in read


def test_noise_that_differs_from_the_manifest_is_reported(
    scenes: Path, scenes_page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "All agree with the manifest." in scenes_page
    monkeypatch.setattr("unprocess_gen.reports.noise_check.alarms.alarm_limit", lambda scores: 0.0)
    assert "The noise of 2 of them differs from the manifest: noise of 00000000: " in dataset_page(scenes)


def test_dataset_without_pairs_has_a_report(make: Make, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").touch()
    make(tmp_path / "photos", tmp_path / "ds", "source.max_failed=1")
    text = dataset_page(tmp_path / "ds")
    assert all(said in text for said in ("0 pairs", "failed rows: 1.", "there is no pair to show", "<p>empty: 1</p>"))


# Code that loads the data ---------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")  # of another library
@pytest.mark.parametrize("library", ["numpy", "torch", "webdataset"])
def test_code_of_the_page_loads_the_pairs(library: str, made: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(library)
    monkeypatch.chdir(made.parent)
    codes = map(html.unescape, re.findall(r'<pre class="code">(.*?)</pre>', text, re.DOTALL))
    names: dict[str, Any] = {}
    exec(next(code for code in codes if f"import {library}" in code or f"from {library}" in code), names)
    pairs = RawPairs(made)
    if library == "torch":
        assert sum(map(len, names["loader"])) == len(pairs)
        return
    if library == "webdataset":
        assert len(list(names["samples"])) == len(pairs)
        gc.collect()  # closes its files while warnings are ignored
    expected = pairs[0 if library == "numpy" else len(pairs) - 1]
    np.testing.assert_array_equal(names["clean"], expected.clean)
    np.testing.assert_array_equal(names["noisy"], expected.noisy)


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


@pytest.mark.parametrize(("content", "code"), [(None, 0), (b"\xff\xd8\xff a photograph", 2), (b"<!DOCTYPE html>", 0)])
def test_report_is_written_to_another_file_unless_it_is_no_page(
    content: bytes | None, code: int, copy: Path, run_main: RunMain, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "page").write_bytes(content)
    assert run_main("report", copy, "--to", "page").code == code
    assert (tmp_path / "page").read_bytes().startswith(content if code and content else b"<!doctype html>")
    assert not (copy / "report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("ds", "--to", "ds/manifest.csv"), "--to ds/manifest.csv: is inside the dataset "),
        (("ds", "--to", "ds/shards/report.html"), "--to ds/shards/report.html: is inside the dataset "),
        (("ds", "--to", "."), "--to .: is a folder; expected the name of a file"),
        (
            ("ds", "--to", "no/such.html"),
            "--to no/such.html: expected a file in a folder that exists; run mkdir -p no first",
        ),
        (("ds", "--to", "locked/page.html"), "--to locked/page.html: cannot be written (Permission denied)"),
    ],
)
def test_wrong_arguments_give_one_line(
    arguments: tuple[str, ...],
    sentence: str,
    made: Path,
    copy: Path,
    run_main: RunMain,
    tree_hash: TreeHash,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (copy.parent / "locked").mkdir()
    access = os.access  # root may write everywhere
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked" and access(path, mode))
    done = run_main("report", *arguments)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert done.err.startswith(f"gen-dataset: {sentence}")
    assert tree_hash(copy) == tree_hash(made) and not (copy / "report.html").exists()


@pytest.mark.parametrize("name", ["manifest.csv", "config.yaml", "dataset.json"])
@pytest.mark.parametrize("content", [None, b"[]"])
def test_changed_dataset_is_damage(name: str, content: bytes | None, copy: Path, run_main: RunMain) -> None:
    changed = (copy / name).read_bytes().replace(b"0", b"1", 1) if content is None else content
    (copy / name).write_bytes(changed)
    done = run_main("report", copy)
    assert (done.code, done.out, done.err.count("\n")) == (4, "", 1)
    assert name in done.err
    assert not (copy / "report.html").exists()


# In a browser ---------------------------------------------------------------------------------------------------------

MEASURE = """
const box = (one) => { const {x, y, width, height} = one.getBoundingClientRect(); return [x, y, width, height]; };
const all = (what) => [...document.querySelectorAll(what)];
return {
  wide: [document.documentElement.scrollWidth, innerWidth], high: document.documentElement.scrollHeight,
  pictures: all("img").map((one) => [one.complete, one.naturalWidth, box(one)]),
  cut: all("body *").filter((one) => one.clientWidth && one.scrollWidth > one.clientWidth + 1
    && getComputedStyle(one).overflowX === "visible").map((one) => one.outerHTML.slice(0, 80)),
};"""


def colours_in(picture: np.ndarray, box: list[float]) -> int:
    """Return the number of colours in a part of a picture; ``box`` is left, top, width and height."""
    x, y, width, height = (round(length) for length in box)
    part = picture[y : y + height, x : x + width].astype(np.uint32)
    assert part.size, f"{box} is outside the picture, {picture.shape}"
    return len(np.unique(part[..., 0] << 16 | part[..., 1] << 8 | part[..., 2]))


@pytest.mark.parametrize("width", [1200, 360])
def test_browser_shows_every_picture_without_overflow(
    width: int, scenes_page: str, browser: Any, tmp_path: Path, figure: Figure
) -> None:
    (tmp_path / "page.html").write_text(scenes_page, encoding="utf-8")
    size = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get((tmp_path / "page.html").as_uri())
    measured = browser.execute_script(MEASURE)
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size | {"height": measured["high"]})
    shot = np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"))
    assert measured["wide"] == [width, width]
    assert shot.shape[:2] == (measured["high"], width)
    assert measured["cut"] == []
    assert len(measured["pictures"]) == scenes_page.count("<img ") == 2 * 6 + 1
    for complete, natural_width, box in measured["pictures"]:
        assert complete and natural_width > 0
        assert box[2] >= 120 and box[3] >= 40
        assert colours_in(shot, [box[0], box[1], min(box[2], width - box[0]), box[3]]) > 20
    figure("report", f"{width} pixels: page {measured['wide'][0]} wide, {len(measured['pictures'])} pictures shown")
