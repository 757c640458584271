"""HTML pages for people: one file each, without a script, that opens offline, on a phone, in the light and in the dark.

Every text is escaped here, where it becomes HTML: what is `Html` already stays, all else is taken for text. So a
file's name cannot become markup, whatever room forgets about it.
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Collection, Iterable, Mapping, Sequence

UNSEEN = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
"""What has no place in HTML, or would turn round what stands beside it: controls, directions, half of a pair."""


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def escaped(text: str) -> Html:
    """Return text as HTML, what cannot be seen spelled as ``\\x1b`` and the like; HTML stays as it is."""
    if isinstance(text, Html):
        return text
    return Html(html.escape(UNSEEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)))


def element(tag: str, *content: str, **attributes: str) -> Html:
    """Return an element with its content and attributes (``class_`` stands for class)."""
    said = "".join(f' {name.rstrip("_")}="{escaped(value)}"' for name, value in attributes.items())
    return Html(f"<{tag}{said}>{joined(content)}</{tag}>")


def joined(parts: Iterable[str]) -> Html:
    """Return parts one after the other."""
    return Html("".join(map(escaped, parts)))


def image(content: bytes, alt: str, kind: str = "png") -> Html:
    """Return a picture that is part of the page; ``alt`` says what it shows, ``kind`` what ``content`` is."""
    return image_at(f"data:image/{kind};base64,{base64.b64encode(content).decode()}", alt)


def image_at(address: str, alt: str) -> Html:
    """Return a picture that lies elsewhere."""
    return Html(f'<img alt="{escaped(alt)}" src="{escaped(address)}">')


def facts(said: Mapping[str, str]) -> Html:
    """Return names and what is said of each as a list."""
    return element("dl", *(part for name, text in said.items() for part in (element("dt", name), element("dd", text))))


def table(
    headings: Sequence[str],
    lines: Iterable[Sequence[str]],
    right: Collection[int] = (),
    first: Collection[int] = (),
) -> Html:
    """Return a table, wide ones in a box of their own to scroll in.

    ``right`` are the columns of numbers, ``first`` the lines with which something new begins.
    """
    rows = [_line("th", headings, right)]
    rows += [_line("td", cells, right, at in first) for at, cells in enumerate(lines)]
    return element("div", element("table", *rows), class_="wide")


def _line(tag: str, cells: Sequence[str], right: Collection[int], is_first: bool = False) -> Html:
    made = (element(tag, cell, **({"class_": "n"} if at in right else {})) for at, cell in enumerate(cells))
    return element("tr", *made, **({"class_": "first"} if is_first else {}))


STYLE = Html("""
:root { color-scheme: light dark; --ink: #222; --page: #fff; --rule: #ddd; --soft: #f4f4f4; --bar: #0072b2; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #ddd; --page: #16181b; --rule: #3a3d42; --soft: #23262b; --bar: #56b4e9; }
}
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 1.5rem auto; padding: 0 1rem;
  color: var(--ink); background: var(--page); overflow-wrap: anywhere; }
h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--rule); }
img { max-width: 100%; height: auto; background: #fff; }
figure { margin: 1rem 0; } figcaption { margin-top: .3rem; }
pre, .wide { overflow-x: auto; margin: .8rem 0; }
pre { background: var(--soft); padding: .6rem .8rem; font-size: .85rem; overflow-wrap: normal; }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { padding: .2rem .6rem; text-align: left; border-bottom: 1px solid var(--rule); }
td.n, th.n { text-align: right; }
tr.first td { border-top: 2px solid #999; }
dt { font-weight: 600; } dd { margin: 0 0 .4rem; }
""")


def page(title: str, *body: str, style: str = "") -> str:
    """Return a whole page; ``style`` is CSS of its own beside what all pages have."""
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escaped(title)}</title><style>{STYLE}{style}</style>"
    )
    content = "\n".join(map(escaped, body))
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{content}\n</body></html>\n'
