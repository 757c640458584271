"""Types of the fixtures that compose configs and make datasets."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable
from pathlib import Path

from unprocess_gen.config.schema import Config
from unprocess_gen.pipeline import generate as runner


def text_rows(out: Path, name: str = "manifest.csv") -> list[dict[str, str]]:
    """Return the rows of a manifest, or of another table, as Python's csv module reads them."""
    with (out / name).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream, strict=True))


sweep_rows = functools.partial(text_rows, name="sweep.csv")
"""Return the rows of the table of a sweep."""

Settings = Callable[..., Config]
"""Type of the fixture `settings`."""

Make = Callable[..., runner.Summary]
"""Type of the fixture `make`."""

TreeHash = Callable[[Path], str]
"""Type of the fixture `tree_hash`."""

MadeHash = Callable[..., str]
"""Type of the fixture `made_hash`."""
