"""Types of the fixtures that compose configs and make datasets."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

from unprocess_gen.config.schema import Config
from unprocess_gen.pipeline import generate as runner


def text_rows(out: Path) -> list[dict[str, str]]:
    """Return the rows of a manifest as Python's csv module reads them."""
    with (out / "manifest.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream, strict=True))


Settings = Callable[..., Config]
"""Type of the fixture `settings`."""

Make = Callable[..., runner.Summary]
"""Type of the fixture `make`."""

TreeHash = Callable[[Path], str]
"""Type of the fixture `tree_hash`."""

MadeHash = Callable[..., str]
"""Type of the fixture `made_hash`."""
