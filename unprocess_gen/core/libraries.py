"""Require optional libraries when they are used; one message names the extra that installs them."""

from __future__ import annotations

from importlib.util import find_spec

from unprocess_gen.core.errors import ConfigError


def require(module: str, use: str, extra: str, alternative: str = "") -> None:
    """Raise ConfigError if a library is missing; ``use`` begins the sentence, an ``alternative`` ends it."""
    if find_spec(module) is None:
        raise ConfigError(f"{use}; run: pip install 'unprocess_gen[{extra}]'{alternative}")
