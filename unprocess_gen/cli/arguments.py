"""Describe the arguments of verbs as data, and parse a command line into a `Call`.

Each verb has its own `argparse` parser, built from its `Argument` list. argparse parses only flags. This module
assigns words, for two reasons that argparse cannot express: a dataset's folder may be called ``camera=sony_a7r``, and
settings may be mixed with flags in any order.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import AnyPath, any_path
from unprocess_gen.core.suggestions import did_you_mean

ANY_VALUE = ("…",)
HYDRA_FLAGS: dict[tuple[str, ...], tuple[tuple[str, ...], str]] = {
    ("-m", "--multirun"): ((), "sweep over comma-separated values"),
    ("-c", "--cfg"): (("job", "hydra", "all"), "print the settings and stop"),
    ("-cd", "--config-dir"): (ANY_VALUE, "add a folder of your own options"),
    ("-cn", "--config-name"): (ANY_VALUE, "use another primary config"),
    ("-cp", "--config-path"): (ANY_VALUE, "use another folder for the primary config"),
    ("-p", "--package"): (ANY_VALUE, "with --cfg: print only this part of the settings"),
    ("--resolve",): ((), "with --cfg: resolve interpolations"),
    ("-i", "--info"): (
        ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath"),
        "print information about Hydra and stop",
    ),
    ("-r", "--run"): ((), "run once; the default"),
    ("-sc", "--shell-completion"): (ANY_VALUE, "Hydra's completion of settings; see gen-dataset completion"),
    ("--hydra-help",): ((), "print Hydra's help and stop"),
}
"""Flags that are passed on to Hydra, in each of their spellings: the values they take (none, any or these), help."""


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of a verb.

    Attributes
    ----------
    names : tuple of str
        Its spellings: ``--flag`` is followed by its value; ``key`` means ``key=value``.
    help : str
        One phrase for ``--help``.
    metavar : str
        Name of the value; empty for a switch.
    read : callable
        Converts the text of the value; raises ValueError.
    expected : str
        What ``read`` accepts, for error messages.
    completes : str
        ``folders`` or ``files`` if shells complete the value as such.
    required : bool
        Whether the verb needs it; shown by ``--help``, checked by the verb.
    """

    names: tuple[str, ...]
    help: str
    metavar: str = ""
    read: Callable[[str], Any] = str
    expected: str = "text"
    completes: str = ""
    required: bool = False

    @property
    def key(self) -> str:
        """Name in `Call.values`: the first long spelling, without hyphens."""
        longest = next((name for name in self.names if not re.match("-[^-]", name)), self.names[0])
        return longest.lstrip("-").rpartition(".")[2].replace("-", "_")

    @property
    def flags(self) -> tuple[str, ...]:
        """Spellings that begin with a hyphen."""
        return tuple(name for name in self.names if name.startswith("-"))

    @property
    def settings(self) -> tuple[str, ...]:
        """Spellings of the form ``key=value``."""
        return tuple(name for name in self.names if not name.startswith("-"))


@dataclass(frozen=True, slots=True)
class Place:
    """The file or folder that a verb works on.

    Attributes
    ----------
    metavar : str
        Its name in ``--help``.
    expected : str
        What it must be, for ``--help`` and error messages.
    completes : str
        ``folders`` or ``files``.
    """

    metavar: str
    expected: str
    completes: str = "folders"


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of the command line.

    Attributes
    ----------
    name : str
        First word of the command line.
    summary : str
        One sentence for the list of verbs.
    run : callable
        Does the work; takes a `Call`, returns the exit code.
    arguments : tuple of Argument
        Flags and settings of this verb.
    place : Place or None
        The file or folder that it works on.
    composes : bool
        Whether it takes config overrides and Hydra's flags.
    words : tuple of str
        Words that are accepted instead of a place.
    extra : Argument or None
        A word that may follow the place.
    resumes : bool
        Whether a rerun continues interrupted work.
    """

    name: str
    summary: str
    run: Callable[[Call], int]
    arguments: tuple[Argument, ...] = ()
    place: Place | None = None
    composes: bool = False
    words: tuple[str, ...] = ()
    extra: Argument | None = None
    resumes: bool = False


@dataclass(frozen=True, slots=True)
class Call:
    """A parsed command line.

    Attributes
    ----------
    values : mapping
        Values by `Argument.key`; arguments that were not given are absent.
    path : Path, ObjectPath or None
        The verb's place.
    overrides : list of str
        Config overrides and Hydra's flags, in the order given.
    words : list of str
        Other words.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    path: AnyPath | None = None
    overrides: list[str] = field(default_factory=list)
    words: list[str] = field(default_factory=list)


STANDARD = (
    Argument(("-q", "--quiet"), "show only warnings and errors on stderr; results still go to stdout"),
    Argument(("-v", "--verbose"), "show details on stderr"),
    Argument(("--log-file",), "append all messages to FILE, with the time of each", "FILE", completes="files"),
)
"""Flags of every verb."""

SOURCE = Argument(
    ("--source", "source.root"),
    "folder of the photographs; by default the one recorded in dataset.json",
    "ROOT",
    completes="folders",
)


class _Parser(argparse.ArgumentParser):
    """A parser that raises ConfigError instead of ending the process."""

    def error(self, message: str) -> NoReturn:
        verb = self.prog.rpartition(" ")[2]
        raise ConfigError(f"{verb}: {message.removeprefix('argument ')}; see {self.prog} --help")


SWITCHES = frozenset(
    (
        *(flag for argument in STANDARD if not argument.metavar for flag in argument.flags),
        *(flag for spellings, (values, _) in HYDRA_FLAGS.items() if not values for flag in spellings),
    )
)
"""Flags without a value that verbs share."""


def path_hint(word: str) -> str:
    """Return what to write instead of the bare name of a file or folder, for an error message.

    Parameters
    ----------
    word : str
        A word of the command line.

    Returns
    -------
    str
        Begins with a semicolon; empty if there is no file or folder of that name.
    """
    path = Path(word)
    if not word or not os.path.lexists(word):
        return ""
    if any((path / name).is_file() for name in ("dataset.json", "manifest.csv", "sweep.csv")):
        return f"; {word} is a dataset: write gen-dataset verify {word}, or another verb"
    return f"; {word} is a file or folder: write source.root={word}"


def flag_parser(verb: Verb) -> argparse.ArgumentParser:
    """Return the parser of a verb's flags; it knows no words."""
    parser = _Parser(prog=f"gen-dataset {verb.name}", add_help=False, allow_abbrev=False, argument_default=None)
    for argument in (*verb.arguments, *STANDARD):
        if argument.flags and argument.metavar:
            parser.add_argument(*argument.flags, dest=argument.key, metavar=argument.metavar)
        elif argument.flags:
            parser.add_argument(*argument.flags, dest=argument.key, action="store_true", default=None)
    return parser


def parse(verb: Verb, arguments: Sequence[str]) -> Call:
    """Parse the arguments of a verb.

    Everything after ``--`` is a word, even with a leading hyphen.

    Parameters
    ----------
    verb : Verb
        The verb.
    arguments : sequence of str
        What follows it on the command line.

    Returns
    -------
    Call
        The parsed arguments.

    Raises
    ------
    ConfigError
        If an argument is unknown, is given twice in different spellings, or has a value that cannot be read.
    """
    before = list(arguments)
    after: list[str] = []
    if "--" in before:
        cut = before.index("--")
        before, after = before[:cut], before[cut + 1 :]
    parsed, rest = flag_parser(verb).parse_known_args(before)
    given = {key: text for key, text in vars(parsed).items() if text is not None}
    known = {argument.key: argument for argument in (*verb.arguments, *STANDARD)}
    values = {key: _read(known[key], f"{verb.name}: {known[key].flags[-1]} ", text) for key, text in given.items()}
    if verb.composes:
        words = _take_settings(verb, [*rest, *after], values)
        return Call(values, overrides=_overrides(verb, words, values))
    for word in rest:
        is_number = verb.extra is not None and word[1:].isdecimal()
        if word.startswith("-") and word != "-" and not is_number:
            raise ConfigError(f"{verb.name}: {word}: no such flag; {_expected(verb, word)}")
    return _assign_words(verb, [*rest, *after], values)


def _read(argument: Argument, spelling: str, text: Any) -> Any:
    if not argument.metavar:
        return True
    if text == "":
        raise ConfigError(f"{spelling.rstrip()}: a value is missing; expected {argument.metavar}")
    try:
        return argument.read(os.path.expanduser(text))
    except ValueError:
        raise ConfigError(f"{spelling}{text}: expected {argument.expected}") from None


def _take_settings(verb: Verb, words: list[str], values: dict[str, Any]) -> list[str]:
    """Move the settings of the verb itself, which no config has, from words to values; return the other words."""
    own = {name: argument for argument in verb.arguments for name in argument.settings}
    others: list[str] = []
    for word in words:
        key, equals, text = word.partition("=")
        if not equals or key not in own:
            others.append(word)
        elif own[key].key in values:
            raise ConfigError(f"{verb.name}: {word}: given twice; expected one value")
        else:
            values[own[key].key] = _read(own[key], f"{verb.name}: {key}=", text)
    return others


def _overrides(verb: Verb, words: list[str], values: dict[str, Any]) -> list[str]:
    """Return what is passed on to Hydra; ``--source ROOT`` becomes ``source.root=ROOT``."""
    flags, others = _flags_and_words(words)
    for word in others:
        if "=" not in word and (hint := path_hint(word)):
            raise ConfigError(f"{verb.name}: {word}: expected a setting key=value{hint}")
    for flag in flags:
        if not any(flag.partition("=")[0] in spellings for spellings in HYDRA_FLAGS):
            raise ConfigError(f"{flag}: no such flag; {_expected(verb, flag)}")
    root = values.get("source")
    if root is None:
        return words
    if other := next((word for word in words if word.startswith("source.root=")), None):
        raise ConfigError(f"--source {root}: the source is also given by {other}; expected one of them")
    return [*words, f"source.root={root}"]


def _flags_and_words(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the words that are flags, and those that are neither flags nor values of Hydra's flags."""
    flags, others = [], []
    waiting = iter(words)
    for word in waiting:
        if not word.startswith("-"):
            others.append(word)
            continue
        flags.append(word)
        if any(word in spellings and values for spellings, (values, _) in HYDRA_FLAGS.items()):
            next(waiting, None)
    return flags, others


def _assign_words(verb: Verb, words: list[str], values: dict[str, Any]) -> Call:
    """Assign words to the verb's place and to its settings.

    The place is the first word that exists as a file or folder; without one, the first that is no setting of the verb.
    """
    known = {name: argument for argument in verb.arguments for name in argument.settings}
    path = None
    if verb.place is not None:
        existing = None if verb.extra else next((word for word in words if os.path.lexists(word)), None)
        path = existing or next((word for word in words if word and word.partition("=")[0] not in known), None)
        if path is None:
            raise ConfigError(f"{verb.name}: expected {verb.place.expected}")
        words = words.copy()
        words.remove(path)
    if verb.extra is not None and words and "=" not in words[0]:
        values[verb.extra.key] = _read(verb.extra, f"{verb.name}: ", words[0])
        words = words[1:]
    others = []
    for word in words:
        key, equals, text = word.partition("=")
        if verb.words:
            others.append(word)
        elif not equals or key not in known:
            raise ConfigError(f"{verb.name}: {word}: unknown argument; {_expected(verb, key)}")
        elif known[key].key in values:
            raise ConfigError(f"{verb.name}: {word}: given twice, also as {known[key].names[0]}; expected one of them")
        else:
            values[known[key].key] = _read(known[key], f"{verb.name}: {key}=", text)
    return Call(values, None if path is None else any_path(path), words=others)


def _expected(verb: Verb, word: str) -> str:
    """Return what a verb accepts, for an error message, and what ``word`` may have meant."""
    hydra = [spellings[-1] for spellings in HYDRA_FLAGS] if verb.composes else []
    options = [name for argument in (*verb.arguments, *STANDARD) for name in argument.names]
    spelled_out = [name for name in (*options, *hydra) if not re.match("-[^-]", name)]
    return f"expected {', '.join(spelled_out)}{did_you_mean(word.partition('=')[0], spelled_out)}"
