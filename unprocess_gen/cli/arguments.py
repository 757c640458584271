"""Describe the arguments of verbs as data, and parse a command line into a `Call`.

argparse parses the flags of a verb. Words are assigned here, because a dataset's folder may be called
``camera=sony_a7r``, and settings and flags may be mixed in any order.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from unprocess_gen.config.settings import settings_of
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

if TYPE_CHECKING:
    from unprocess_gen.core.paths import AnyPath


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of a verb: the spellings of a flag, or the key of a setting, which is written ``key=value``.

    A switch has no metavar. ``read`` converts the text of the value and raises ValueError unless it is as ``expected``
    says.
    """

    names: tuple[str, ...]
    help: str
    metavar: str = ""
    read: Callable[[str], Any] = str
    expected: str = "text"
    required: bool = False

    @property
    def key(self) -> str:
        """Name in `Call.values`: a setting's key, or the last spelling of a flag without leading hyphens."""
        return self.names[-1].lstrip("-").replace("-", "_")

    @property
    def is_flag(self) -> bool:
        """True for a flag, False for a setting."""
        return self.names[0].startswith("-")

    @property
    def spelled(self) -> str:
        """Spelling with the name of the value, such as ``--to FOLDER`` or ``source.root=ROOT``."""
        return f"{', '.join(self.names)} {self.metavar}".rstrip() if self.is_flag else f"{self.key}={self.metavar}"


STANDARD = (Argument(("-q", "--quiet"), "show only warnings and errors on stderr; results still go to stdout"),)
"""Flags of every verb."""


def choice(names: tuple[str, ...], text: str, *choices: str) -> Argument:
    """Return an argument whose value is one of some words."""

    def read(written: str) -> str:
        if written not in choices:
            raise ValueError
        return written

    return Argument(names, text, f"{{{','.join(choices)}}}", read, " or ".join(choices))


HYDRA_FLAGS = (
    Argument(("-m", "--multirun"), "sweep over comma-separated values"),
    choice(("-c", "--cfg"), "print the settings and stop", "job", "hydra", "all"),
    Argument(("--resolve",), "with --cfg: resolve interpolations"),
    Argument(("-cd", "--config-dir"), "add a folder of your own options", "FOLDER"),
    Argument(("-cn", "--config-name"), "use another primary config", "NAME"),
    Argument(("-cp", "--config-path"), "use another folder for the primary config", "FOLDER"),
)
"""Flags of Hydra, for the verbs that take settings."""


@dataclass(frozen=True, slots=True)
class PlaceArgument:
    """The file or folder that a verb works on: its name in ``--help``, and what it must be."""

    metavar: str
    expected: str
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of the command line.

    ``run`` names a module of this package and its function, which takes a `Call` and returns the exit code:
    ``checks.verify``. ``composes`` verbs take config overrides and Hydra's flags. An ``extra``
    word may follow the place. ``resumes``: a rerun continues interrupted work.
    """

    name: str
    summary: str
    run: str
    arguments: tuple[Argument, ...] = ()
    place: PlaceArgument | None = None
    composes: bool = False
    extra: Argument | None = None
    resumes: bool = False

    @property
    def accepted(self) -> tuple[Argument, ...]:
        """All arguments: those of the verb, of every verb, and of Hydra."""
        return (*self.arguments, *STANDARD, *(HYDRA_FLAGS if self.composes else ()))

    @property
    def settings(self) -> dict[str, Argument]:
        """Settings of the verb by key."""
        return {argument.key: argument for argument in self.arguments if not argument.is_flag}


@dataclass(frozen=True, slots=True)
class Call:
    """A parsed command line; arguments that were not given are absent.

    ``values`` are by `Argument.key`, ``hydra`` by the long spelling of Hydra's flags, overrides as the user wrote them.
    """

    verb: Verb
    values: Mapping[str, Any] = field(default_factory=dict)
    path: AnyPath | None = None
    overrides: list[str] = field(default_factory=list)
    hydra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def hydra_arguments(self) -> list[str]:
        """Hydra's flags and their values, as on a command line."""
        parts = ([flag] if value is True else [flag, value] for flag, value in self.hydra.items())
        return [word for part in parts for word in part]


class _Parser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        verb = self.prog.rpartition(" ")[2]
        raise ConfigError(f"{verb}: {message.removeprefix('argument ')}; see {self.prog} --help")


def flag_parser(verb: Verb) -> argparse.ArgumentParser:
    """Return the parser of a verb's flags; it knows no words."""
    parser = _Parser(prog=f"gen-dataset {verb.name}", add_help=False, allow_abbrev=False)
    for argument in verb.accepted:
        if argument.is_flag and argument.metavar:
            parser.add_argument(*argument.names, dest=argument.key, metavar=argument.metavar)
        elif argument.is_flag:
            parser.add_argument(*argument.names, dest=argument.key, action="store_true", default=None)
    return parser


def parse(verb: Verb, arguments: Sequence[str]) -> Call:
    """Parse what follows a verb; ConfigError for an argument that is unknown, given twice or cannot be read.

    Everything after ``--`` is a word, even with a leading hyphen.
    """
    from unprocess_gen.core.paths import any_path  # --help needs no paths

    cut = arguments.index("--") if "--" in arguments else len(arguments)
    parsed, rest = flag_parser(verb).parse_known_args(arguments[:cut])
    for word in rest:
        if word.startswith("-") and word != "-":
            raise ConfigError(f"{verb.name}: {word}: no such flag; {_expected(verb, word)}{_setting_hint(verb, word)}")
    flags = {argument.key: argument for argument in verb.accepted}
    values = {
        key: _read(flags[key], f"{verb.name}: {flags[key].names[-1]} ", text)
        for key, text in vars(parsed).items()
        if text is not None
    }
    words = [*rest, *arguments[cut + 1 :]]
    path = _take_place(verb, words)
    if verb.extra is not None and words and "=" not in words[0]:
        values[verb.extra.key] = _read(verb.extra, f"{verb.name}: ", words.pop(0))
    others = _take_settings(verb, words, values)
    for argument in verb.arguments:
        if argument.required and argument.key not in values:
            problem = f"{argument.names[-1]} is missing; give {argument.spelled}: {argument.help}"
            raise ConfigError(f"{verb.name}: {problem}")
    hydra = {flag.names[-1]: values.pop(flag.key) for flag in HYDRA_FLAGS if flag.key in values}
    return Call(verb, values, None if path is None else any_path(path), others, hydra)


def _read(argument: Argument, spelling: str, text: Any) -> Any:
    if not argument.metavar:
        return True
    if text == "":
        raise ConfigError(f"{spelling.rstrip()}: a value is missing; expected {argument.metavar}")
    try:
        return argument.read(os.path.expanduser(text))
    except ValueError:
        raise ConfigError(f"{spelling}{text}: expected {argument.expected}") from None


def _take_place(verb: Verb, words: list[str]) -> str | None:
    """Remove the verb's place from words: the first that exists, without one the first that is no setting."""
    if verb.place is None:
        return None
    existing = None if verb.extra else next((word for word in words if os.path.lexists(word)), None)
    own = (word for word in words if word and word.partition("=")[0] not in verb.settings)
    path = existing or next((word for word in own if not verb.composes or ("=" not in word and word[0] != "~")), None)
    if path is None and verb.place.optional:
        return None
    if path is None:
        raise ConfigError(f"{verb.name}: expected {verb.place.expected}")
    words.remove(path)
    return path


def _take_settings(verb: Verb, words: Iterable[str], values: dict[str, Any]) -> list[str]:
    """Read the settings of the verb itself into values; return the other words that it accepts."""
    others: list[str] = []
    for word in words:
        key, equals, text = word.partition("=")
        if equals and (argument := verb.settings.get(key)):
            if argument.key in values:
                raise ConfigError(f"{verb.name}: {word}: {key} is given twice; expected one value")
            values[argument.key] = _read(argument, f"{verb.name}: {key}=", text)
        elif verb.composes and (equals or word.startswith("~")):
            others.append(word)
        elif verb.composes:
            raise ConfigError(f"{verb.name}: {word}: expected a setting key=value{path_hint(word)}")
        else:
            raise ConfigError(f"{verb.name}: {word}: unknown argument; {_expected(verb, key)}")
    return others


# ------------------------------------------------------------------------------------------------------------- hints


def path_hint(word: str) -> str:
    """Remedy for the bare name of a file or folder; empty if there is none of that name."""
    path = Path(word)
    if not word or not os.path.lexists(word):
        return ""
    if any((path / name).is_file() for name in ("dataset.json", "manifest.csv", "sweep.csv")):
        return f"; {word} is a dataset: write gen-dataset verify {word}, or another verb"
    return f"; {word} is a file or folder: write source.root={word}"


def _setting_hint(verb: Verb, flag: str) -> str:
    """Remedy for a setting with hyphens, such as ``--out``; empty for other flags."""
    from unprocess_gen.config.schema import GROUPS, Config, group_settings  # imports NumPy, too slow for --help

    name, _, value = flag.lstrip("-").partition("=")
    group, _, key = name.partition(".")
    keys = group_settings(group) if group in GROUPS else settings_of(Config)
    if name in verb.settings or (verb.composes and (name in GROUPS or (key or name) in keys)):
        return f"; {name} is a setting: write {name}={value or '…'}"
    return ""


def _expected(verb: Verb, word: str) -> str:
    """Arguments that a verb accepts, and the one that ``word`` may have meant."""
    names = [name for argument in verb.accepted for name in argument.names]
    spelled_out = [name for name in names if not re.match("-[^-]", name)]
    return f"expected {', '.join(spelled_out)}{did_you_mean(word.partition('=')[0], spelled_out)}"
