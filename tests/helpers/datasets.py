"""Types of the fixtures that compose configs and make datasets."""

from __future__ import annotations

import csv
import functools
import json
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from unprocess_gen.config.schema import Config
from unprocess_gen.pipeline import generate as runner


def text_rows(out: Path, name: str = "manifest.csv") -> list[dict[str, str]]:
    """Return the rows of a manifest, or of another table, as Python's csv module reads them."""
    with (out / name).open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream, strict=True))


def samples_json(out: Path) -> dict[str, Any]:
    """Return the JSON of every sample in the shards by key."""
    samples: dict[str, Any] = {}
    for path in sorted((out / "shards").iterdir()):
        with tarfile.open(path) as shard:
            for member in shard:
                key, _, name = member.name.partition(".")
                if name == "json":
                    samples[key] = json.load(shard.extractfile(member))  # type: ignore[arg-type]
    return samples


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of each file in a folder."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def flip(path: Path, at: int, bit: int = 0) -> None:
    """Change one bit of a file."""
    with path.open("r+b") as stream:
        stream.seek(at)
        (byte,) = stream.read(1)
        stream.seek(at)
        stream.write(bytes([byte ^ 1 << bit]))


sweep_rows = functools.partial(text_rows, name="sweep.csv")
"""Return the rows of the table of a sweep."""

Settings = Callable[..., Config]
"""Type of the fixture `settings`."""

Make = Callable[..., runner.Summary]
"""Type of the fixture `make`."""

TreeHash = Callable[[Path], str]
"""Type of the fixture `tree_hash`."""
