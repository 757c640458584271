"""The site of the documentation: its links and pictures resolve, it loads nothing from servers, and its pages fit."""

from __future__ import annotations

import html
import json
import re
import shutil
import sys
from collections import defaultdict
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from helpers.browser import open_page
from helpers.commands import run_process
from helpers.promise_report import Figure

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
WIDTHS = (1200, 390)
"""Widths of a window on a desktop and on a phone, pixels."""


class Page(HTMLParser):
    """Collect the anchors of a page, and the addresses that it refers to as links or loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        is_link = tag == "a" or values.get("rel") in ("canonical", "author")
        (self.links if is_link else self.loaded).extend(
            values[name] for name in ("href", "src", "data", "poster") if name in values
        )

    def local_targets(self) -> Iterator[tuple[Path, str]]:
        """Yield path and fragment of each address without a server."""
        for address in self.links + self.loaded:
            if not has_server(address):
                parts = urlsplit(address)
                path = (self.path.parent / unquote(parts.path)).resolve() if parts.path else self.path
                yield path, unquote(parts.fragment)


def has_server(address: str) -> bool:
    return bool(urlsplit(address).scheme or urlsplit(address).netloc)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the site, built as in CI."""
    pytest.importorskip("myst_parser", reason="needs the extra docs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", folder / "doctrees"]
    done = run_process(*command, ROOT / "docs", folder / "html", PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    paths = [path for path in sorted(site.resolve().rglob("*.html")) if "_static" not in path.parts]
    found = {path: Page(path) for path in paths}
    assert len(found) > len(list((ROOT / "docs").rglob("*.md")))
    return found


def test_links_anchors_and_pictures_resolve(pages: dict[Path, Page], figure: Figure) -> None:
    links = [(page, *target) for page in pages.values() for target in page.local_targets()]
    broken = [
        f"{page.path.name}: {target.name}#{fragment}"
        for page, target, fragment in links
        if not target.exists() or (fragment and target in pages and fragment not in pages[target].anchors)
    ]
    assert broken == []
    figure("site", f"{len(links) - len(broken)} of {len(links)} links of {len(pages)} pages resolve")


def test_pages_load_nothing_from_servers(site: Path, pages: dict[Path, Page]) -> None:
    loaded = {address for page in pages.values() for address in page.loaded if not address.startswith("data:")}
    assert [address for address in loaded if has_server(address)] == []
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", style.read_text(encoding="utf-8")), style.name


MEASURE = """<script>addEventListener("load", () => parent.postMessage({
  width: document.documentElement.scrollWidth,
  missing: [...document.images].filter((one) => !one.complete || !one.naturalWidth).map((one) => one.src),
}, "*"));</script>"""
TOUR = """<!doctype html><body style="margin: 0"><script>
const visits = %s, measured = {};
let frame;
function next() {
  if (frame) frame.remove();
  if (!visits.length) { document.body.dataset.measured = JSON.stringify(measured); return; }
  frame = document.createElement("iframe");
  frame.style = `border: 0; height: 1000px; width: ${visits[0][1]}px`;
  frame.src = visits[0][0];
  document.body.append(frame);
}
addEventListener("message", (message) => { measured[visits.shift().join(" ")] = message.data; next(); });
next();
</script></body>"""
"""Page that opens other pages one after another in a frame; a window of headless Chromium has at least 500 pixels."""


def test_pages_fit_their_window_and_show_their_pictures(
    site: Path, pages: dict[Path, Page], tmp_path: Path, figure: Figure
) -> None:
    tour = tmp_path / "site"
    shutil.copytree(site, tour)
    (tour / "control.html").write_text('<body><p style="width: 2000px">wide</p><img src="no.png" alt=""></body>')
    names = [path.relative_to(site.resolve()).as_posix() for path in pages] + ["control.html"]
    for name in names:
        text = (tour / name).read_text(encoding="utf-8")
        (tour / name).write_text(text.replace("</body>", MEASURE + "</body>"), encoding="utf-8")
    visits = [[name, width] for name in names for width in WIDTHS]
    (tour / "tour.html").write_text(TOUR % json.dumps(visits), encoding="utf-8")
    flags = ("--virtual-time-budget=600000", "--dump-dom")
    dom = open_page(tour / "tour.html", (1200, 1000), tmp_path / "profile", *flags, timeout=300)
    (found,) = re.findall(r'data-measured="([^"]*)"', dom)
    measured: dict[str, dict[str, Any]] = json.loads(html.unescape(found))
    assert len(measured) == len(visits)
    faults = defaultdict(list)
    for visit, page in measured.items():
        name, _, width = visit.partition(" ")
        if page["width"] > int(width):
            faults[name].append(f"is {page['width']} pixels wide in a window of {width}")
        faults[name] += [f"does not show {picture}" for picture in page["missing"]]
    assert len(faults.pop("control.html")) == 4, "too wide pages or missing pictures are not detected"
    assert [fault for fault in faults.items() if fault[1]] == []
    figure("site", f"{len(measured) - len(WIDTHS)} views of pages at {' and '.join(map(str, WIDTHS))} pixels fit")
