"""Render the HTML pages of reports from the Jinja2 templates in ``templates/``, and check where they are written.

A page is one file without scripts that opens offline. Autoescaping is on, so a file name cannot become markup, and
characters that are invisible or reverse the text around them are shown as escapes.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import DATASET_ENTRIES, check_output_file, check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.pipeline.folder import REPORT

if TYPE_CHECKING:
    from jinja2 import Environment, Template

INVISIBLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)
"""Control characters, changes of text direction, and lone surrogates."""


class PageTable(NamedTuple):
    """A table of a page: ``numeric`` columns are aligned right, and each line in ``groups`` begins a new group."""

    headings: Sequence[str]
    lines: Sequence[Sequence[str]]
    numeric: Collection[int] = ()
    groups: Collection[int] = ()


def render_page(template: str, **values: Any) -> str:
    """Render a template of ``templates/``; a missing value raises `jinja2.UndefinedError`."""
    return page_template(template).render(values)


def page_template(name: str) -> Template:
    """Find a template of ``templates/``."""
    return _environment().get_template(name)


def render_macro(name: str, content: Any) -> str:
    """Render a part of a page by a macro of ``macros.html``."""
    return str(getattr(page_template("macros.html").module, name)(content))


def data_uri(content: bytes, kind: str = "png") -> str:
    """Address of an encoded image that makes it part of the page."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def visible(value: Any) -> Any:
    """Write invisible characters of a text as escapes; markup and other types are unchanged."""
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    return INVISIBLE.sub(lambda match: match[0].encode("unicode_escape").decode(), value)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # optional library, extra "figures"

    return Environment(
        loader=PackageLoader("unprocess_gen.reports"),
        autoescape=True,
        finalize=visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


# --------------------------------------------------------------------------------------------------------------- files


def require_libraries(verb: str) -> None:
    """Raise ConfigError if an optional library of a verb that writes a page is missing; it names the extra."""
    for name in ("matplotlib", "jinja2"):
        require(name, f"{verb}: pages need {name}", "figures")


def check_report_folder(out: Path, verb: str) -> None:
    """Check, before any work, that a report can be written to a folder, which need not exist, outside of datasets."""
    require_libraries(verb)
    if name := next((name for name in DATASET_ENTRIES if (out / name).exists()), None):
        raise ConfigError(f"out={out}: contains a dataset ({name}); expected a folder without one; choose another out")
    check_output_folder(out, f"out={out}")


def page_file(folder: AnyPath, to: Path | None = None) -> Path:
    """The file for a page: ``report.html`` in the folder, or ``to``; ConfigError if it cannot be written."""
    require_libraries("report")
    if to is not None:
        if not (isinstance(folder, Path) and to.resolve() == (folder / REPORT).resolve()):
            check_output_file(to, f"--to {to}", "an HTML page", b"<!doctype html", b"<html")
        return to
    if not isinstance(folder, Path):
        raise ConfigError(f"report: {folder} is in an object store; expected a local file; give --to FILE")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"report: {folder} is read-only; expected a file that can be written; give --to FILE")
    return folder / REPORT
