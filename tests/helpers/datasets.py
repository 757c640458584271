"""Types of the fixtures that compose configs and make datasets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from unprocess_gen.config.schema import Config
from unprocess_gen.pipeline import generate as runner

Settings = Callable[..., Config]
"""Type of the fixture `settings`."""

Make = Callable[..., runner.Summary]
"""Type of the fixture `make`."""

TreeHash = Callable[[Path], str]
"""Type of the fixture `tree_hash`."""

MadeHash = Callable[..., str]
"""Type of the fixture `made_hash`."""
