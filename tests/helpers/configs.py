"""Build configs from overrides."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

from unprocess_gen.config.composition import compose_node, typed_config
from unprocess_gen.config.schema import Config, replaced


@functools.cache
def composed(*overrides: str) -> Config:
    """Return the config of overrides, without validating it."""
    return typed_config(compose_node(overrides), overrides)


def with_branch(config: Config, **numbers: Any) -> Config:
    """Return a config with other numbers in the first branch of its noise profile."""
    first, *others = config.noise.branches
    return replaced(config, {"noise.branches": (replace(first, **numbers), *others)})
