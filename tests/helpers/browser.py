"""Open pages in headless Chromium, without network."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from helpers.commands import run_process

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND",  # block network requests
)


def open_page(page: Path, size: tuple[int, int], profile: Path, *flags: str, timeout: float = 120) -> str:
    """Open a page in a window of a width and height; return what Chromium prints. Skip the test without Chromium."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    window = f"--window-size={size[0]},{size[1]}"
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", window, *flags, page.as_uri()]
    done = run_process(*command, timeout=timeout, cwd=page.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout
