"""Format the help of ``gen-dataset`` and of each verb; import nothing slow."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence

from unprocess_gen.cli.arguments import HELP_WIDTH, Verb
from unprocess_gen.cli.exit_codes import EXIT_CODES
from unprocess_gen.config.option_files import ADDED_GROUPS, conf_dir, group_options, option_summary
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.suggestions import did_you_mean

COLUMN = 34

INTRODUCTION = """\
gen-dataset: pairs of clean and noisy raw images from ordinary photographs

  gen-dataset camera=convex noise=imx385_iso3200 source.root=photos out=ds     one dataset
  gen-dataset                          a dataset of the synthetic pictures, in ds
  gen-dataset -m camera=sony_a7r,nexus_6p noise=imx385_iso1600,imx385_iso3200 out=sweep
                                       a sweep: one dataset folder each, and sweep/sweep.csv
  gen-dataset VERB --help              the arguments of a verb
"""

SETTINGS_HELP = """\
Settings are key=value, in any order. group=option selects an option, group.key=value changes one
value. gen-dataset --help GROUP explains the options and keys of a group:"""

FLAGS = (
    ("-h, --help [VERB or GROUP]", "show this help, or that of a verb or group"),
    ("--version", "show the version"),
    ("--", "everything after it is a file or folder, even with a leading hyphen"),
)


def asked_help(verbs: Mapping[str, Verb], verb: Verb | None, flags: Sequence[str]) -> str:
    """Help of a verb, else of the verb, group or setting (``noise.iso``) behind ``--help``, else of the program."""
    word = next((word for flag, word in itertools.pairwise(flags) if flag in ("-h", "--help")), "-")
    if verb is not None:
        return verb_help(verb)
    if word.startswith("-"):
        return global_help(verbs)
    from unprocess_gen.config.schema import GROUPS  # imports NumPy, too slow for the other kinds of help

    name = re.split("[.=]", word)[0]
    parts = [verb_help(verbs[name])] if name in verbs else []
    parts += [group_help(name)] if name in GROUPS or name in ADDED_GROUPS else []
    parts += key_help(name)
    if not parts:
        names = list(dict.fromkeys([*verbs, *GROUPS, *ADDED_GROUPS]))
        expected = f"expected one of {', '.join(names)}{did_you_mean(name, names)}"
        raise ConfigError(f"--help {word}: no such verb or group; {expected}")
    return "\n".join(parts)


def global_help(verbs: Mapping[str, Verb]) -> str:
    """Help of ``gen-dataset``: verbs, groups with their options, top-level keys, flags and exit codes."""
    blocks = [
        INTRODUCTION,
        _section("Verbs", ((verb.name, verb.summary) for verb in verbs.values()), 16),
        "\n".join([SETTINGS_HELP, *(_columns(*line, 16) for line in _group_lines())]) + "\n",
        "Keys at the top level:\n" + "".join(key_help("")),
        _section("Flags (gen-dataset VERB --help lists more)", FLAGS),
        _section("Exit codes", EXIT_CODES.items(), 16),
    ]
    return "\n".join(blocks)


def key_help(name: str) -> list[str]:
    """Help of the key at the top level with this name, or of all; comments explain them, to import no schema."""
    lines = re.findall(r"^(\w+): (\S+) +# (.*)", _primary_config(), re.MULTILINE)
    return [_columns(f"{key}={value}", summary, 20) + "\n" for key, value, summary in lines if name in ("", key)]


def _primary_config() -> str:
    return (conf_dir() / "config.yaml").read_text(encoding="utf-8")


def _group_lines() -> Iterable[tuple[str, str]]:
    """Each group with its options, in the order of the defaults list; without any, with what its keys are."""
    for group in re.findall(r"^  - (\w+): ", _primary_config(), re.MULTILINE):
        options = [name for name in group_options(group) if name != "default"]
        yield group, " ".join(options) or option_summary(group, "default")
    for group, contents in ADDED_GROUPS.items():
        options = group_options(group)
        yield group, f"{' '.join(options)} ({contents}; added with a plus: +{group}={options[0]})"


def group_help(group: str) -> str:
    """Help of one group of settings: its options and its keys."""
    from unprocess_gen.config.defaults import default_options, default_values
    from unprocess_gen.config.schema import GROUPS
    from unprocess_gen.config.settings import all_settings
    from unprocess_gen.core.fields import value_text

    parts = []
    if options := [option for option in group_options(group) if option != "default"]:
        plus = "+" if group in ADDED_GROUPS else ""
        lines = ((option, option_summary(group, option)) for option in options)
        parts.append(_section(f"Options of {group} ({plus}{group}=OPTION)", lines))
    if group in GROUPS:
        values, option = default_values(group), default_options().get(group) or "default"
        chosen = f" with {group}={option}" if option != "default" else ""
        spelled = (
            (f"{name}={value_text(values[name])}"[: HELP_WIDTH - 2], setting.description)
            for name, setting in all_settings(GROUPS[group]).items()
        )
        parts.append(_section(f"Keys of {group} ({group}.KEY=VALUE), and their defaults{chosen}", spelled))
    return "\n".join(parts)


def verb_help(verb: Verb) -> str:
    """Help of one verb, as argparse formats it."""
    parser = verb.parser
    parser.description = verb.run.__doc__
    if verb.place is not None:
        parser.add_argument(verb.place.metavar, help=verb.place.expected, nargs="?" if verb.place.optional else None)
    if verb.composes:
        settings = "settings: gen-dataset --help lists them, and gen-dataset --help GROUP explains them"
        parser.add_argument("key=value", nargs="*", help=settings)
    for spelled, summary in verb.keys.items():
        parser.add_argument(spelled, nargs="?", help=summary)
    return parser.format_help()


def _section(title: str, lines: Iterable[tuple[str, str]], column: int = COLUMN) -> str:
    """Lines of two columns below a title; empty without lines."""
    texts = [_columns(*line, column) for line in lines]
    return "\n".join([f"{title}:", *texts]) + "\n" if texts else ""


def _columns(left: str, right: str, column: int = COLUMN) -> str:
    """Two columns; the right one begins in a line of its own if the left one is long."""
    start = f"  {left}".ljust(column)
    indent, break_after = " " * column, len(left) + 4 > column
    lines = textwrap.fill(right, HELP_WIDTH, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
    return f"  {left}\n{lines}" if break_after else start + lines[column:]
