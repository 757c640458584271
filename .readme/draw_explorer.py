"""Draw explorer.jpg for the documentation: python .readme/draw_explorer.py. Requires Chromium and its driver."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service

SETTINGS = ("source.limit=6", "noise=imx385_iso12800", "gains=fig6_top", "camera=sony_a7r")
SIZE = {"width": 1200, "height": 1100, "deviceScaleFactor": 1, "mobile": False}
READY = "return Bokeh.documents[0].get_model_by_name('command').text"


def screenshot(address: str) -> np.ndarray:
    """Return the page as BGR codes."""
    options = ChromeOptions()
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--disable-background-networking")
    for flag in (*flags, f"--user-data-dir={tempfile.mkdtemp()}"):
        options.add_argument(flag)
    browser = Chrome(options, Service(shutil.which("chromedriver")))
    try:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", SIZE)
        browser.get(address)
        time.sleep(5)
        scenes = "const open = Bokeh.documents[0].get_model_by_name('open'); open.value = open.options.at(-1)"
        browser.execute_script(scenes)
        time.sleep(5)
        assert browser.execute_script(READY)
        return cv2.imdecode(np.frombuffer(browser.get_screenshot_as_png(), np.uint8), cv2.IMREAD_COLOR)
    finally:
        browser.quit()


def main() -> None:
    """Serve the page, and write its picture."""
    command = [sys.executable, "-m", "unprocess_gen", "explore", "--no-browser", *SETTINGS]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            picture = screenshot(server.stdout.readline().split()[0])
        finally:
            server.terminate()
    small = cv2.resize(picture, None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    to = Path(__file__).with_name("explorer.jpg")
    cv2.imwrite(str(to), small, [cv2.IMWRITE_JPEG_QUALITY, 82])
    print(f"{to}: {to.stat().st_size} bytes")


if __name__ == "__main__":
    main()
