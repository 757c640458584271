"""Describe the arguments of verbs as data, and parse a command line into a `Call`.

argparse parses flags; words are assigned here, because a dataset's folder may be called ``camera=sony_a7r``.
"""

from __future__ import annotations

import argparse
import functools
import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

if TYPE_CHECKING:
    from unprocess_gen.core.object_store import ObjectPath
    from unprocess_gen.core.paths import LocalPath


HELP_WIDTH = 100


def text(value: str) -> str:
    """Read a value that must not be empty."""
    if not value:
        raise argparse.ArgumentTypeError("a value is missing")
    return value


def count(value: str) -> int:
    """Read an integer of 0 or more."""
    if not value.isdecimal():
        raise argparse.ArgumentTypeError(f"{value}: expected an integer of 0 or more")
    return int(value)


def local(value: str) -> Path:
    """Read the path of a local file or folder."""
    if "://" in text(value):  # it would become a folder named after the scheme
        raise argparse.ArgumentTypeError(f"{value}: expected a local path")
    return Path(os.path.expanduser(value))


class Flag(NamedTuple):
    """The spellings of a flag, and the options with which argparse adds it."""

    names: list[str]
    options: dict[str, Any]


def flag(names: str, metavar: str, summary: str, read: Callable[[str], Any] = text, **options: Any) -> Flag:
    """Describe a flag with a value; ``options`` are others of argparse."""
    return Flag(names.split(), {"metavar": metavar, "help": summary, "type": read, **options})


def switch(names: str, summary: str) -> Flag:
    """Describe a flag without a value."""
    return Flag(names.split(), {"action": "store_true", "help": summary})


STANDARD = (
    switch("-q --quiet", "show only warnings and errors on stderr; results still go to stdout"),
    switch("-h --help", "show this help"),
)
"""Flags of every verb."""

HYDRA_FLAGS = (
    switch("-m --multirun", "sweep over comma-separated values"),
    flag("-c --cfg", "{job,hydra,all}", "print the settings and stop", choices=("job", "hydra", "all")),
    switch("--resolve", "with --cfg: resolve interpolations"),
    flag("-cd --config-dir", "FOLDER", "add a folder of your own options", local),
    flag("-cn --config-name", "NAME", "use another primary config"),
    flag("-cp --config-path", "FOLDER", "use another folder for the primary config", local),
)
"""Flags of Hydra, for the verbs that take settings."""


class Operand(NamedTuple):
    """The file or folder that a verb works on: its name in ``--help``, and what it must be."""

    metavar: str
    expected: str
    optional: bool = False


class Verb(NamedTuple):
    """A verb; ``run`` returns the exit code, ``keys`` are settings of its own, such as ``source.root=ROOT``, with help.

    ``composes`` verbs take the settings of a run and Hydra's flags.
    """

    name: str
    summary: str
    run: Callable[[Call], int]
    place: Operand | None = None
    flags: tuple[Flag, ...] = ()
    keys: Mapping[str, str] = MappingProxyType({})
    composes: bool = False

    @property
    def all_flags(self) -> tuple[Flag, ...]:
        """Flags of the verb, of every verb, and of Hydra."""
        return (*self.flags, *STANDARD, *(HYDRA_FLAGS if self.composes else ()))

    @property
    def parser(self) -> argparse.ArgumentParser:
        """Parser of the flags, which knows no words."""
        form = functools.partial(argparse.HelpFormatter, width=HELP_WIDTH, max_help_position=34)
        parser = _Parser(f"gen-dataset {self.name}", formatter_class=form, add_help=False, allow_abbrev=False)
        for names, options in self.all_flags:
            parser.add_argument(*names, **options)
        return parser

    @property
    def own_keys(self) -> list[str]:
        """Settings of the verb itself, without the names of their values."""
        return [key.partition("=")[0] for key in self.keys]


class Call(argparse.Namespace):
    """A parsed command line: flags are attributes, None or False if they are not given.

    ``settings`` are those of the verb itself by key, ``overrides`` those of a config, ``words`` all behind the verb.
    """

    verb: Verb
    words: list[str]
    place: LocalPath | ObjectPath | None
    settings: dict[str, str]
    overrides: list[str]

    def local_place(self, kind: str) -> Path:
        """The place of a verb that needs a local file or folder (``kind``); ConfigError for a URL."""
        from unprocess_gen.core.paths import local_path

        assert self.place is not None
        return local_path(self.place, f"{self.verb.name}: {self.place} is in an object store; expected a local {kind}")


def verb(
    *arguments: Operand | Flag, keys: Mapping[str, str] = MappingProxyType({}), composes: bool = False
) -> Callable[[Callable[[Call], int]], Verb]:
    """Make a verb of the function that runs it, whose docstring is its summary; ``arguments`` are a place and flags."""

    def declare(run: Callable[[Call], int]) -> Verb:
        summary = (run.__doc__ or "").rstrip(".")  # python -OO removes docstrings
        place = next((argument for argument in arguments if isinstance(argument, Operand)), None)
        flags = tuple(argument for argument in arguments if isinstance(argument, Flag))
        return Verb(run.__name__, summary[:1].lower() + summary[1:], run, place, flags, keys, composes)

    return declare


DATASET = Operand("DIR", "the folder of a dataset")
ANY_DATASET = Operand("DIR", "the folder of a dataset or of a sweep")
BEGUN = Operand("OUT", "the folder of a run in parts")
N_JOBS = {"n_jobs=N": "number of worker processes; -1: all cores"}
SOURCE = {"source.root=ROOT": "folder of the photographs; by default the one recorded in dataset.json"}
INPUTS = SOURCE | {"noise.dark_frames=FOLDER": "folder of the dark frames, if it is not the recorded one"}
"""Where the files are that pairs are regenerated from."""

ROWS = "rows by source index, range or key, such as 3,7-9,00000012-p0007"
KEYS = flag("--keys", "KEYS", ROWS)


class _Parser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        verb = self.prog.rpartition(" ")[2]
        raise ConfigError(f"{verb}: {message.removeprefix('argument ')}; see {self.prog} --help")


def parse(verb: Verb, arguments: Sequence[str]) -> Call:
    """Parse what follows a verb; everything after ``--`` is a word, even with a leading hyphen."""
    from unprocess_gen.config.option_files import group_options
    from unprocess_gen.core.paths import any_path  # --help needs no paths

    name = arguments[0] if arguments else ""
    if name in group_options(verb.name) and not os.path.lexists(name):
        remedy = f"for the option of this name, write gen-dataset {verb.name}={name}"
        raise ConfigError(f"{verb.name}: {name}: no such file; {remedy}")
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    call, rest = verb.parser.parse_known_args(arguments[:cut], Call(verb=verb, words=list(arguments)))
    for word in rest:
        if word.startswith("-") and word != "-":
            raise ConfigError(f"{verb.name}: {word}: no such flag; {_expected(verb, word)}{_setting_hint(verb, word)}")
    words = [*rest, *arguments[cut + 1 :]]
    place = _take_place(verb, words)
    call.place = None if place is None else any_path(os.path.expanduser(place))
    call.settings, call.overrides = {}, []
    for word in words:
        key, equals, value = word.partition("=")
        if equals and key in verb.own_keys:
            if key in call.settings or not value:
                raise ConfigError(f"{verb.name}: {word}: {f'{key} is given twice' if value else 'a value is missing'}")
            call.settings[key] = os.path.expanduser(value)
        elif verb.composes and (equals or word.startswith("~")):
            call.overrides.append(word)
        elif verb.composes:
            hint = _quotes_hint(call.words, word) or path_hint(word)
            raise ConfigError(f"{verb.name}: {word}: expected a setting key=value{hint}")
        else:
            raise ConfigError(f"{verb.name}: {word}: unknown argument; {_expected(verb, key)}")
    _refuse_expanded_braces(call.overrides)
    return call


def _take_place(verb: Verb, words: list[str]) -> str | None:
    """Remove the verb's place from words: the first that exists, without one the first that is no setting."""
    if verb.place is None:
        return None
    others = (word for word in words if word and word.partition("=")[0] not in verb.own_keys)
    if verb.composes:
        others = (word for word in others if "=" not in word and word[0] != "~")
    place = next((word for word in words if os.path.lexists(word)), None) or next(others, None)
    if place is not None:
        words.remove(place)
    elif not verb.place.optional:
        raise ConfigError(f"{verb.name}: expected {verb.place.metavar}, {verb.place.expected}")
    return place


# ------------------------------------------------------------------------------------------------------------- hints


def path_hint(word: str) -> str:
    """Remedy for the bare name of a file or folder; empty if there is none of that name."""
    path = Path(word)
    if not word or not os.path.lexists(word):
        return ""
    if any((path / name).is_file() for name in ("dataset.json", "manifest.csv", "sweep.csv")):
        return f"; {word} is a dataset: write gen-dataset verify {word}, or another verb"
    return f"; {word} is a file or folder: write source.root={word}"


SPLIT_LIST = re.compile(r"\S+?=(?:[\[{][^=]*[\]}]|(?:[^\s=]+, )+\S+)")
"""A setting whose list the shell splits at blanks."""

EXPANDED = re.compile(r"(\S+?=\[*)[\w-]+:[^{}\[\]:\s]+(\]*)(?: \1[\w-]+:[^{}\[\]:\s]+\2(?!\S))+")
"""Settings to which the shell expands a mapping: ``split={a:1,b:2}`` becomes ``split=a:1 split=b:2``."""


def _quotes_hint(words: Sequence[str], word: str) -> str:
    """Remedy for a part of a list that the shell split at blanks; empty for other words."""
    lists = SPLIT_LIST.findall(" ".join(words))
    setting = next((text for text in lists if word in text.split()), "")
    return f"; write {shlex.quote(setting)} in quotes" if setting else ""


def _refuse_expanded_braces(overrides: Sequence[str]) -> None:
    """Refuse a mapping that the shell expanded to several overrides."""
    if found := EXPANDED.search(" ".join(overrides)):
        before, after = found.groups()
        pairs = found[0].removeprefix(before).removesuffix(after).replace(f"{after} {before}", ",")
        key, written = before.partition("=")[0], shlex.quote(f"{before}{{{pairs}}}{after}")
        raise ConfigError(f"{found[0].partition(' ')[0]}: {key} is given twice; write {written} in quotes")


def _setting_hint(verb: Verb, word: str) -> str:
    """Remedy for a setting with hyphens, such as ``--out``; empty for other flags."""
    from unprocess_gen.config.schema import GROUPS, Config  # imports NumPy, too slow for --help
    from unprocess_gen.config.settings import all_settings

    name, _, value = word.lstrip("-").partition("=")
    keys = {*GROUPS, *all_settings(Config)} if verb.composes else set()
    return f"; {name} is a setting: write {name}={value or '…'}" if name in {*verb.own_keys, *keys} else ""


def _expected(verb: Verb, word: str) -> str:
    """Arguments that a verb accepts, and the one that ``word`` may have meant."""
    names = [*verb.own_keys, *(names[-1] for names, _ in verb.all_flags)]
    return f"expected {', '.join(names)}{did_you_mean(word.partition('=')[0], names)}"
