"""Complete command lines in bash and zsh: verbs, flags, settings and options.

``gen-dataset completion bash`` prints a script. Its function calls ``gen-dataset completion query LINE`` with the line
up to the cursor. The query prints the kind of completion (``words``, ``folders``, ``files``) and the candidates.

Design: ``docs/design/command_line.md``.
"""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterable
from pathlib import Path

from unprocess_gen.cli.arguments import Call
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.limits import BOOLEAN, Choice
from unprocess_gen.config.option_files import build_names, conf_dir, group_options
from unprocess_gen.config.schema import GROUPS, Config, all_settings, group_settings
from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

WORDS, FOLDERS, FILES = "words", "folders", "files"

SHELLS = ("bash", "zsh")
"""Shells, whose scripts are next to this module."""


def completion(call: Call) -> int:
    """Print the script of a shell, or the candidates for its query."""
    match call.words:
        case ["query", line]:
            kind, candidates = complete(line)
            print("\n".join([kind, *candidates]))
        case [shell] if shell in SHELLS:
            print(Path(__file__).with_suffix(f".{shell}").read_text(encoding="utf-8"), end="")
        case words:
            word = " ".join(words)
            raise ConfigError(f"completion: {word or 'no shell'}: expected bash or zsh{did_you_mean(word, SHELLS)}")
    return 0


def complete(line: str) -> tuple[str, list[str]]:
    """Complete the last word of a line: return the kind of completion, and for ``words`` the complete candidates.

    The shell completes names of ``folders`` and ``files`` by itself.
    """
    *before, current = _split(line)
    name = next(iter(before[1:2]), "")
    verb = VERBS.get(name, VERBS["generate"])
    last = before[-1] if len(before) > 1 else ""
    for argument in verb.accepted:
        if argument.metavar and last in argument.flags:
            return argument.completes or WORDS, _starting(current, argument.choices)
    if current.startswith("-"):
        flags = [flag for argument in verb.accepted for flag in argument.flags]
        return WORDS, _starting(current, [*flags, "-h", "--help", *(["--version"] if len(before) == 1 else [])])
    key, equals, _ = current.partition("=")
    if equals:
        if key in verb.settings:
            return verb.settings[key].completes or WORDS, []
        return _values(key, current, _option_folders(before)) if verb.composes else (WORDS, [])
    candidates = [f"{key}=" for key in verb.settings]
    candidates += VERBS if len(before) == 1 and re.fullmatch("[a-z]*", current) else ()
    candidates += _settings(current, _option_folders(before)) if verb.composes else ()
    candidates += build_names() if verb.name == "build" else ()
    words = _starting(current, [*candidates, *verb.words])
    return (verb.place.completes, []) if verb.place and not (words and current) else (WORDS, words)


def _split(line: str) -> list[str]:
    """Split a line into words, the last of them up to the cursor; an open quotation mark ends with the line."""
    for closing in ("", "'", '"'):
        try:
            words = shlex.split(line + closing)
        except ValueError:
            continue
        return [*words, ""] if not closing and line[-1:].isspace() else words or [""]
    return ["", ""]


def _starting(prefix: str, candidates: Iterable[str]) -> list[str]:
    return sorted({candidate for candidate in candidates if candidate.startswith(prefix)})


def _option_folders(words: list[str]) -> list[Path]:
    """Return the folders of options: the built-in folder, and the folders of ``--config-dir`` on the line."""
    named = [word.partition("=")[2] for word in words if re.match("(--config-dir|-cd)=", word)]
    named += [value for flag, value in itertools.pairwise(words) if flag in ("--config-dir", "-cd")]
    return [conf_dir(), *(Path(folder).expanduser() for folder in named)]


def _settings(current: str, folders: list[Path]) -> list[str]:
    """Return keys as far as they are typed: ``camera=``, ``camera.``, and the keys of ``camera.`` once it is typed."""
    group = current.partition(".")[0]
    if "." in current:
        return [f"{group}.{name}=" for name in group_settings(group)] if group in GROUPS else []
    added = {path.name for folder in folders for path in folder.glob("*/")} - set(GROUPS)
    chosen = [name for name in GROUPS if len(group_options(name, *folders)) > 1]
    keys = [f"{name}=" for name in (*settings_of(Config), *chosen)]
    return [*keys, *(f"{name}." for name in GROUPS), *(f"+{name}=" for name in added)]


def _values(key: str, current: str, folders: list[Path]) -> tuple[str, list[str]]:
    """Return the values of a key: options of a group, words, folders; also of the last item of a sweep's list."""
    if key in ("out", "source.root", "source.list"):
        return (FOLDERS if key == "out" else FILES), []
    limit = next((setting.limit for *path, setting in all_settings() if ".".join(filter(None, path)) == key), None)
    values: Iterable[str] = () if "." in key else group_options(key.lstrip("+"), *folders)
    if limit is BOOLEAN:
        values = ("true", "false")
    elif isinstance(limit, Choice):
        values = limit.words
    before, comma, _ = current.rpartition(",")  # of a sweep: camera=sony_a7r,nex
    listed = before.partition("=")[2].split(",")
    start = f"{before}," if comma else f"{key}="
    return WORDS, _starting(current, (f"{start}{value}" for value in values if value not in listed))
