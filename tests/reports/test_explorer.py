"""Tests of the explorer: its pair is the one that its command generates, and its page works in a browser."""

from __future__ import annotations

import http.client
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

import unprocess_gen as ug
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.paths import any_path
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.reports.explorer.exploration import Exploration, open_place
from unprocess_gen.reports.explorer.overrides import override_word, overrides_of, split_overrides

pytest.importorskip("bokeh", reason="the explorer needs the extra explore")

from bokeh.document import Document

from unprocess_gen.reports.explorer import views
from unprocess_gen.reports.explorer.page import Page

ON_PAGE = (
    "key",
    "source_sha256",
    "stream_key",
    "w_sony_a7r",
    "red_gain",
    "a_dn",
    "effects",
    "clean_xxh3",
    "noisy_xxh3",
)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos with spaces"
    folder.mkdir()
    for number, name in enumerate(("a.png", "b.png", "twin.png")):
        picture = np.random.default_rng(min(number, 1)).integers(0, 256, (96, 128, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / name), cv2.blur(picture, (9, 9)))
    return folder


def explorations(place: Path | None, *overrides: str, keys: str | None = None) -> list[Exploration]:
    start, choices = open_place(None if place is None else any_path(place), keys, overrides, (), OptionFolders())
    return [choice(start) for choice in choices.values()]


def row_of_command(command: str, key: str, out: Path) -> dict[str, Any]:
    """Generate the dataset of a command in this process and return the row with a key."""
    words = [word for word in shlex.split(command)[1:] if not word.startswith("out=")]
    ug.generate(ug.load_config([*words, f"out={out}", "n_jobs=1"]))
    return next(dict(row) for row in read_rows(out / "manifest.csv") if row["key"] == key)


@pytest.mark.parametrize(
    ("is_folder", "number", "overrides"),
    [
        (False, 2, ["source.downscale=4", "gains.red=2.05", "camera.weights=[1,2,0,1]"]),
        (True, 1, ["body=sony_a7s2", "scene=night", "effects.prnu=on"]),
    ],
    ids=["scene", "photograph"],
)
def test_command_generates_the_pair_shown(
    is_folder: bool, number: int, overrides: list[str], photos: Path, tmp_path: Path
) -> None:
    state = explorations(photos if is_folder else None, *overrides)[number]
    shown = state.shown()
    row = row_of_command(state.command, str(shown.row["key"]), tmp_path / "out")
    assert {name: row[name] for name in ON_PAGE} == {name: shown.row[name] for name in ON_PAGE}


def test_row_of_a_dataset_opens_with_its_parameters(photos: Path, tmp_path: Path) -> None:
    """Twins, patches and levels too: the pair is that of the row, and its command generates it."""
    settings = ["source.patch=[grid,64]", "noise=nikon_d850", "noise.levels=[200,800]", "noise.draws=2"]
    ug.generate(ug.load_config([f"source.root={photos}", f"out={tmp_path / 'ds'}", "n_jobs=1", *settings]))
    for key in ("00000001-p0001-l01d01", "00000002-p0000-l00d01"):
        (state,) = explorations(tmp_path / "ds", keys=key)
        shown = state.shown()
        recorded = next(row for row in read_rows(tmp_path / "ds" / "manifest.csv") if row["key"] == key)
        assert shown.row["noisy_xxh3"] == recorded["noisy_xxh3"], key
        again = row_of_command(state.command, str(shown.row["key"]), tmp_path / key)
        assert again["noisy_xxh3"] == shown.row["noisy_xxh3"]


def test_overrides_of_a_config_compose_it_again() -> None:
    given = ["body=sony_a7s2", "gains.blue=[uniform, 1, 2]", "split={a: 0.5, b: 0.5}", "scene.iso=800"]
    composed = ug.load_config(given)
    texts = [f"{key}={text}" for key, text in overrides_of(composed).items()]
    assert overrides_of(ug.load_config(texts)) == overrides_of(composed)


def test_raw_frames_are_refused_with_the_steps_that_show_them(tmp_path: Path) -> None:
    (tmp_path / "a.DNG").touch()
    for place in (tmp_path, tmp_path / "a.DNG"):
        with pytest.raises(ConfigError, match=r"raw frames.*photographs.*gen-dataset source.kind=raw"):
            explorations(place)


# ----------------------------------------------------------------------------------------------- the field of a page


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("  seed=7   n_jobs=1 ", ("seed=7", "n_jobs=1")),
        ("camera.xyz2cam=[1, 0, 0] split={a: 0.5, b: 0.5}", ("camera.xyz2cam=[1, 0, 0]", "split={a: 0.5, b: 0.5}")),
        ("source.exclude=['a ]b', \"c d\"] seed=1", ("source.exclude=['a ]b', \"c d\"]", "seed=1")),
        ("'gains.red=[uniform, 1.9, 2.4]' seed=1", ("gains.red=[uniform, 1.9, 2.4]", "seed=1")),
        ("a=[1, 2 seed=1", ("a=[1, 2 seed=1",)),
        ("a='b seed=1", ("a='b seed=1",)),
    ],
)
def test_text_is_split_at_blanks_outside_of_quotes_and_brackets(text: str, words: tuple[str, ...]) -> None:
    assert split_overrides(text) == words


@pytest.mark.parametrize("text", ["x", "a b", "it's", "[1, 2]", 'say "x"', "\\", "[a", "]"])
def test_word_of_a_setting_stays_in_one_piece(text: str) -> None:
    word = override_word("out", text)
    assert split_overrides(f"seed=1 {word} seed=2") == ("seed=1", word, "seed=2")


class Driven:
    """A page without a browser: controls are set, and the tasks that wait are run."""

    def __init__(self, place: Path | None, *overrides: str) -> None:
        self._document = Document()
        Page(*open_place(place and any_path(place), None, overrides, (), OptionFolders()), self._document).fill()

    def __getitem__(self, name: str) -> Any:
        return self._document.get_model_by_name(name)

    def set(self, name: str, value: Any) -> None:
        self[name].value = value
        while tasks := self._document.session_callbacks:
            self._document.remove_timeout_callback(tasks[0])
            tasks[0].callback()

    @property
    def settings(self) -> list[str]:
        """What the command sets, without the place of the photograph and the output."""
        words = shlex.split(self["command"].text)[1:]
        return [word for word in words if not word.startswith(("source.root=", "source.limit=", "out="))]

    @property
    def refused(self) -> list[str]:
        """Controls that are outlined."""
        return [model.name for model in self._document.roots if "refused" in model.css_classes]


def test_text_of_the_field_is_the_list_of_other_settings() -> None:
    page = Driven(None, "source.downscale=4", "seed=1")
    assert page["other"].value == "source.downscale=4"
    page.set("other", "source.downscale=4 output.dtype=float32 seed=7")
    assert page["seed"].value == "7"
    page.set("other", "gains.red=[uniform, 1, 2]  source.patch=[grid, 64, 32]")
    assert page.settings == ["gains.red=[uniform, 1, 2]", "source.patch=[grid, 64, 32]", "seed=1"]
    page.set("gains.red", 2.5)  # a control takes its key back
    assert page["other"].value == "source.patch=[grid, 64, 32]"
    page.set("other", "")
    assert page.settings == ["seed=1", "gains.red=2.5"]


def test_refused_text_blocks_nothing_and_the_next_one_replaces_it() -> None:
    page = Driven(None)
    page.set("other", "source.downscale=4 noize=x")
    assert page.refused == ["other"]
    assert "noize=x" in page["refusal"].text
    page.set("scene", "night")
    assert (page.refused, page.settings, page["other"].value) == (
        ["other"],
        ["scene=night"],
        "source.downscale=4 noize=x",
    )
    page.set("other", "source.downscale=4")
    assert (page.refused, page["message"].text, page["refusal"].text) == ([], "", "")
    assert page.settings == ["source.downscale=4", "scene=night"]


@pytest.mark.parametrize("first", ["body=sony_a7s2", "noise=imx385_iso3200"])
def test_value_of_a_wrong_type_is_outlined_and_has_no_effect(first: str) -> None:
    page = Driven(None, first)
    for name in ("scene.iso", "scene.exposure_s", "noise.a", "sensor.bits"):
        page.set(name, "banana")
        assert f"{name}=banana" in page["message"].text
    assert page.settings == [first]
    assert set(page.refused) == {"scene.iso", "scene.exposure_s", "noise.a", "sensor.bits"}
    for name in page.refused:
        page.set(name, "")
    assert (page.refused, page.settings) == ([], [first])


def test_refused_value_is_retried_with_the_next_change() -> None:
    page = Driven(None)
    page.set("sensor.white_level_dn", "16383")
    assert page.refused == ["sensor.white_level_dn"]
    page.set("sensor.bits", "14")
    assert (page.refused, page.settings) == ([], ["sensor.white_level_dn=16383", "sensor.bits=14"])


def test_settings_stay_when_another_photograph_is_opened(photos: Path) -> None:
    page = Driven(photos)
    page.set("scene", "night")
    page.set("open", page["open"].options[1])
    assert page.settings == ["scene=night"]
    assert "b.png" in page["command"].text
    page.set("open", page["open"].options[2])
    assert page["part"].value == "00000002"
    assert page.settings == ["scene=night"]


def test_weights_are_shown_for_a_mix_of_cameras_only() -> None:
    page = Driven(None)
    assert page["camera.weights"].visible
    page.set("body", "sony_a7s2")
    assert not page["camera.weights"].visible


@pytest.mark.parametrize("shape", [(512, 768), (8, 900), (900, 9), (4, 4)])
def test_buttons_show_the_detail_or_the_frame(shape: tuple[int, int]) -> None:
    (shown,) = [state.shown() for state in explorations(None, "source.limit=1")]
    shown = shown._replace(clean=np.zeros(shape, np.uint16), srgb=shown.srgb[: shape[0], : shape[1]])
    detail, frame = (views.window_of(label, shown) for label in views.WINDOWS)
    assert frame.tolist() == [[0, shape[0]], [0, shape[1]]]
    assert (detail[:, 0] >= 0).all() and (detail[:, 1] <= shape).all()
    rows, columns = np.ptp(detail, axis=1)
    assert min(rows, columns) >= min(views.SMALLEST_PX, *shape) - 1e-9
    assert rows / columns == pytest.approx(shape[0] / shape[1])
    assert columns <= max(views.DETAIL_PX, views.SMALLEST_PX * shape[1] / shape[0]) + 1e-9


# ------------------------------------------------------------------------------------------------------------ browser


@contextmanager
def served(place: Path, stderr: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "unprocess_gen", "explore", str(place), "--no-browser", "noise=imx385_iso12800"]
    with (
        stderr.open("w") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        assert process.stdout is not None
        yield process.stdout.readline().split()[0]
        process.terminate()
        assert process.wait(30) == 143


@pytest.fixture
def address(photos: Path, tmp_path: Path) -> Iterator[str]:
    with served(photos, tmp_path / "stderr") as place:
        yield place


def answer_to(address: str, origin: str, host: str = "localhost") -> int:
    """Status with which the server answers a page of an origin that opens the socket of a host."""
    place = urlsplit(address)
    headers = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Origin": origin,
        "Host": host,
    }
    connection = http.client.HTTPConnection(place.netloc, timeout=30)
    connection.request("GET", "/ws", headers=headers | {"Sec-WebSocket-Key": "MDEyMzQ1Njc4OWFiY2RlZg=="})
    status = connection.getresponse().status
    connection.close()
    return status


def test_page_of_a_tunnel_works_and_other_names_do_not(address: str) -> None:
    for name in ("127.0.0.1", "localhost"):
        assert answer_to(address, f"http://{name}:9000") == 101
    for name in ("evil.example:9000", "localhost.evil.example", "192.168.0.1:9000"):
        assert answer_to(address, f"http://{name}") == 403
        assert answer_to(address, f"http://{name}", host=name) == 403  # a name that was made to lead to this machine


def model(browser: Any, name: str, code: str) -> Any:
    """Run JavaScript on the model with a name, ``it``."""
    return browser.execute_script(f"const it = Bokeh.documents[0].get_model_by_name({name!r}); {code}")


def wait(browser: Any, name: str, code: str, timeout_s: float = 60) -> Any:
    """Wait until a script on a model returns something."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        try:
            if found := model(browser, name, code):
                return found
        except Exception as error:  # the page is still loading
            last = error
        time.sleep(0.1)
    raise AssertionError(f"{name}: {code}: {locals().get('last')}")


def open_page(browser: Any, address: str, width: int, height: int) -> None:
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 800}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(address)
    wait(browser, "command", "return it.text")


BUTTON = """
const search = root => {
  for (const one of root.querySelectorAll("*")) {
    if (arguments[0] === (one.tagName === "BUTTON" ? one.textContent.trim() : one.title)) return one;
    const found = one.shadowRoot && search(one.shadowRoot);
    if (found) return found;
  }
};
return search(document);
"""


def press(browser: Any, label: str, key: str = "") -> None:
    """Press a button by the mouse, or with a key after focusing it."""
    button = browser.execute_script(BUTTON, label)
    if key:
        browser.execute_script("arguments[0].focus()", button)
        browser.switch_to.active_element.send_keys(key)
    else:
        button.click()


TOOLTIP = """
const texts = [];
const search = root => root.querySelectorAll("*").forEach(one => {
  if (one.classList.contains("bk-tooltip-row-value")) texts.push(one.textContent);
  if (one.shadowRoot) search(one.shadowRoot);
});
search(document);
return texts;
"""


def tooltip(browser: Any, name: str) -> list[str]:
    """Move the pointer over a picture; return what it shows of the site and of both frames."""
    place = "const place = Bokeh.index.find_one(it).el.getBoundingClientRect(); return [place.x, place.y];"
    model(browser, name, "Bokeh.index.find_one(it).el.scrollIntoView({block: 'center'})")
    texts, end = [], time.monotonic() + 60
    while not texts and time.monotonic() < end:
        x, y = model(browser, name, place)
        for step in range(2):
            move = {"type": "mouseMoved", "x": x + 40 + step, "y": y + 30}
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", move)
        time.sleep(0.2)
        texts = browser.execute_script(TOOLTIP)
    return [texts[0], *texts[2:4]]


@pytest.mark.slow
@pytest.mark.parametrize("width", [1200, 390])
def test_page_works_in_a_browser_without_network(width: int, address: str, browser: Any, tmp_path: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    grants = {"origin": address.rstrip("/"), "permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    browser.execute_cdp_cmd("Browser.grantPermissions", grants)
    open_page(browser, address, width, 900)
    assert "iso12800" in model(browser, "command", "return it.text")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width

    model(browser, "camera", "it.value = 'sony_a7r'")
    model(browser, "gains.red", "it.value = 2.05")
    command = wait(browser, "command", "return it.text.includes('gains.red=2.05') && it.text")
    assert "camera=sony_a7r" in command
    facts = model(browser, "facts", "return it.text")
    row = row_of_command(command, "00000000", tmp_path / "made")
    assert row["noisy_xxh3"] in facts and row["clean_xxh3"] in facts

    model(browser, "sensor.bits", "it.value = 'many'")
    sentence = wait(browser, "message", "return it.text")
    assert "sensor.bits=many: expected 1 to 16" in sentence

    model(browser, "sensor.bits", "it.value = '12'")
    wait(browser, "message", "return it.text === ''")
    for label in views.WINDOWS:
        model(browser, "clean", "it.x_range.end = 40")
        press(browser, label, Keys.ENTER)
        wait(browser, "clean", "return it.x_range.end - it.x_range.start === 128")
    press(browser, "Copy the command")
    assert browser.execute_async_script("navigator.clipboard.readText().then(arguments[0])") == model(
        browser, "command", "return it.text"
    )
    column, line, clean_dn, noisy_dn = map(int, re.findall(r"\d+", " ".join(tooltip(browser, "clean"))))
    pair = ug.RawPairs(tmp_path / "made")[0]
    assert (clean_dn, noisy_dn) == (pair.clean[line, column], pair.noisy[line, column])
    requests = [entry["message"] for entry in browser.get_log("performance") if "requestWillBeSent" in entry["message"]]
    urls = {url for text in requests for url in re.findall(r'"url":"(https?://[^"]+)"', text)}
    assert urls and all(url.startswith(address) for url in urls), urls


VIEW = "const place = Bokeh.index.find_one(it).el.getBoundingClientRect(); return [place.top, place.bottom];"


@pytest.mark.slow
def test_pictures_and_errors_stay_in_view_while_controls_scroll(address: str, browser: Any) -> None:
    open_page(browser, address, 1280, 900)
    browser.execute_script("document.querySelector('.controls').scrollTop = 10000")
    model(browser, "other", "it.value = 'noize=x'")
    wait(browser, "refusal", "return it.text")
    wait(browser, "other", "return getComputedStyle(Bokeh.index.find_one(it).el).outlineStyle === 'solid'")
    for name in ("message", "refusal", "other", "noisy_developed"):
        top, bottom = wait(browser, name, VIEW)
        assert 0 <= top < bottom <= 900, name
    model(browser, "other", "it.value = 'source.exclude=[" + "long_name," * 40 + "x]'")
    wait(browser, "command", "return it.text.includes('long_name')")
    assert model(browser, "command", "const {el} = Bokeh.index.find_one(it); return el.scrollWidth <= el.clientWidth")


@pytest.mark.slow
def test_one_picture_stays_on_top_on_a_phone(address: str, browser: Any) -> None:
    open_page(browser, address, 390, 844)
    for name in ("scene.iso", "other", "transfer"):
        model(browser, name, "Bokeh.index.find_one(it).el.scrollIntoView({block: 'center'})")
        top, bottom = wait(browser, "noisy_developed", VIEW)
        assert 0 <= top < bottom <= 844 / 2, name
        assert wait(browser, name, VIEW)[0] >= bottom


@pytest.mark.slow
@pytest.mark.parametrize("body", ["", "nikon_d850"], ids=["loading", "computing"])
def test_closing_a_page_writes_nothing_to_the_terminal(body: str, photos: Path, tmp_path: Path, browser: Any) -> None:
    with served(photos, tmp_path / "stderr") as address:
        for _ in range(3):
            browser.get(address)
            if body:
                wait(browser, "command", "return it.text")
                model(browser, "body", f"it.value = {body!r}")
            browser.get("about:blank")
            time.sleep(3)
    assert (tmp_path / "stderr").read_text() == "gen-dataset: ended by SIGTERM\n"
