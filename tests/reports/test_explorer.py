"""Tests of the explorer: its pair is the one that its command generates, and its page works in a browser."""

from __future__ import annotations

import http.client
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

import unprocess_gen as ug
from unprocess_gen.config.option_files import OptionFolders
from unprocess_gen.core.paths import any_path
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.reports.explorer.exploration import Exploration, open_place
from unprocess_gen.reports.explorer.overrides import overrides_of

pytest.importorskip("bokeh", reason="the explorer needs the extra explore")

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
    choices = open_place(None if place is None else any_path(place), keys, overrides, (), OptionFolders())
    return [choice() for choice in choices.values()]


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


# ------------------------------------------------------------------------------------------------------------ browser


@pytest.fixture
def address(photos: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "unprocess_gen", "explore", str(photos), "--no-browser", "noise=imx385_iso12800"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().split()[0]
        process.terminate()
        assert process.wait(30) == 143


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
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 800}
    from selenium.webdriver.common.keys import Keys

    grants = {"origin": address.rstrip("/"), "permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    browser.execute_cdp_cmd("Browser.grantPermissions", grants)
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get(address)
    wait(browser, "command", "return it.value.includes('iso12800')")
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width

    model(browser, "camera", "it.value = 'sony_a7r'")
    model(browser, "gains.red", "it.value = 2.05")
    command = wait(browser, "command", "return it.value.includes('gains.red=2.05') && it.value")
    assert "camera=sony_a7r" in command
    facts = model(browser, "facts", "return it.text")
    row = row_of_command(command, "00000000", tmp_path / "made")
    assert row["noisy_xxh3"] in facts and row["clean_xxh3"] in facts

    model(browser, "sensor.bits", "it.value = 'many'")
    sentence = wait(browser, "message", "return it.text")
    assert "sensor.bits=many: expected 1 to 16" in sentence

    model(browser, "sensor.bits", "it.value = '12'")
    wait(browser, "message", "return it.text === ''")
    press(browser, "Zoom In", Keys.ENTER)
    wait(browser, "clean", "return it.x_range.end - it.x_range.start < 127")
    press(browser, "Copy the command")
    assert browser.execute_async_script("navigator.clipboard.readText().then(arguments[0])") == model(
        browser, "command", "return it.value"
    )
    column, line, clean_dn, noisy_dn = map(int, re.findall(r"\d+", " ".join(tooltip(browser, "clean"))))
    pair = ug.RawPairs(tmp_path / "made")[0]
    assert (clean_dn, noisy_dn) == (pair.clean[line, column], pair.noisy[line, column])
    requests = [entry["message"] for entry in browser.get_log("performance") if "requestWillBeSent" in entry["message"]]
    urls = {url for text in requests for url in re.findall(r'"url":"(https?://[^"]+)"', text)}
    assert urls and all(url.startswith(address) for url in urls), urls
