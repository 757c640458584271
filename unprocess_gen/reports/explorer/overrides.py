"""Write a config as the overrides from which it is composed again."""

from __future__ import annotations

import itertools
import operator
import os
import re
from typing import Any

from unprocess_gen.config.composition import compose_node, load_config, typed_config
from unprocess_gen.config.defaults import default_options
from unprocess_gen.config.limits import OVERRIDDEN
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.overrides import override_text, quoted
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import recorded
from unprocess_gen.config.settings import all_settings
from unprocess_gen.core.errors import ConfigError

QUOTED = re.compile(r"""'(?:\\.|[^'\\])*(?:'|$)|"(?:\\.|[^"\\])*(?:"|$)""")
"""A text in quotes, or from a quote to the end."""
NAMED_GROUPS = ("camera", "noise", "scene")
"""Groups whose config contains the name of its option."""


def overrides_of(config: Config) -> dict[str, str]:
    """Overrides by key that compose the config of a dataset again, without the place of its sources, or ConfigError."""
    names = {group: getattr(config, group).name.removesuffix(OVERRIDDEN) for group in NAMED_GROUPS}
    wanted = _deciding_values(config)
    given = {group: name for group, name in names.items() if (conf_dir() / group / f"{name}.yaml").is_file()}
    options = [f"{key}={text}" for key, text in given.items()]
    base = _deciding_values(typed_config(compose_node(options), options))
    given |= {key: override_text(value) for key, value in wanted.items() if value != base[key]}
    if names["noise"] == base["noise.name"]:  # composing appends the mark of an overridden number
        given.pop("noise.name", None)
    given = {key: text for key, text in given.items() if default_options().get(key) != text}
    composed = _deciding_values(load_config([f"{key}={text}" for key, text in given.items()]))
    if left := [key for key, value in wanted.items() if value != composed[key]]:
        raise ConfigError(f"{', '.join(left)}: recorded settings that overrides cannot express; use gen-dataset again")
    return given


def _deciding_values(config: Config) -> dict[str, Any]:
    """Values of the keys that decide data, as ``config.yaml`` has them."""
    deciding = (key for key, setting in all_settings(Config).items() if setting.decides_data)
    return {key: recorded(operator.attrgetter(key)(config)) for key in deciding}


def key_of(override: str) -> str:
    """The key or group that an override sets."""
    return override.lstrip("+").partition("=")[0]


def override_word(key: str, text: str) -> str:
    """An override that `split_overrides` keeps in one piece, whatever follows."""
    word = f"{key}={text}"
    return word if split_overrides(f"{word} +") == (word, "+") else f"{key}={quoted(os.path.expanduser(text))}"


def split_overrides(text: str) -> tuple[str, ...]:
    """Split a line at blanks outside of quotes and brackets; a word that is in quotes, as in a shell, loses them."""
    masked = QUOTED.sub(lambda match: "_" * len(match[0]), text)
    depths = itertools.accumulate((mark in "[{(") - (mark in "]})") for mark in masked)
    marks = zip(text, masked, depths, strict=True)
    ends = "".join("\n" if mark.isspace() and depth <= 0 else character for character, mark, depth in marks)
    return tuple(
        word[1:-1] if QUOTED.fullmatch(word) and word[0] == word[-1] else word for word in ends.split("\n") if word
    )
