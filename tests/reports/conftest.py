"""A dataset with noise that can be fitted, and a browser, for the tests of pages."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.browser import FLAGS
from helpers.datasets import Make


@pytest.fixture(scope="session")
def scenes(make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of two synthetic pictures, large enough that their noise can be fitted; no test changes it."""
    out = tmp_path_factory.mktemp("scenes") / "ds"
    make(None, out, "source.limit=2")
    return out


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    driver, chromium = shutil.which("chromedriver"), shutil.which("chromium")
    if driver is None or chromium is None:
        pytest.skip("chromium and chromedriver are not installed")
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS[:-1], f"--user-data-dir={tempfile.mkdtemp(dir=tmp_path)}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    chrome = Chrome(options, Service(driver))
    yield chrome
    chrome.quit()
