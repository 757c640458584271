"""Format the help of ``gen-dataset`` and of each verb; import nothing slow."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

from unprocess_gen.cli.arguments import HYDRA_FLAGS, STANDARD, Verb
from unprocess_gen.cli.exit_codes import EXIT_CODES
from unprocess_gen.config.option_files import ADDED_GROUPS, group_options, option_summary
from unprocess_gen.config.values import value_text

WIDTH = 100
INDENT = 11
COLUMN = 34

INTRODUCTION = """\
gen-dataset: pairs of clean and noisy raw images from ordinary photographs

  gen-dataset camera=convex noise=imx385_iso3200 source.root=photos out=ds     one dataset
  gen-dataset                          a dataset of the built-in scenes, in ds
  gen-dataset -m camera=sony_a7r,nexus_6p noise=imx385_iso1600,imx385_iso3200 out=sweep
                                       a sweep: one dataset folder each, and sweep/sweep.csv
  gen-dataset VERB --help              the arguments of a verb

Verbs:
"""

SETTINGS_HELP = """
Settings are key=value, in any order. group=option selects an option, group.key=value changes one
value. gen-dataset --help GROUP explains the options and keys of a group:
"""

SHOWN_HYDRA_FLAGS = ("multirun", "cfg", "config_dir")
"""Flags of Hydra that the help of the program names; the help of a verb names all."""


def global_help(verbs: Mapping[str, Verb], conf: Path) -> str:
    """Return the help of ``gen-dataset``."""
    lines = [f"  gen-dataset {verb.name:<11} {verb.summary}" for verb in verbs.values()]
    groups = [_hanging(f"  {group:<{INDENT}}", text) for group, text in group_lines(conf)]
    keys = key_help("", conf)
    blocks = [INTRODUCTION + "\n".join(lines), SETTINGS_HELP + "\n".join(groups), "\nKeys at the top level:", *keys]
    shown = [*(flag for flag in HYDRA_FLAGS if flag.key in SHOWN_HYDRA_FLAGS), *STANDARD]
    flags = [
        *((argument.spelled, argument.help) for argument in shown),
        ("-h, --help [VERB or GROUP]", "show this help, or that of a verb or group"),
        ("--version", "show the version"),
        ("--", "everything after it is a file or folder, even with a leading hyphen"),
    ]
    blocks += ["\nFlags:", *(_two_columns(*flag) for flag in flags)]
    return "\n".join(blocks) + "\n\n" + exit_code_lines() + "\n"


def key_help(name: str, conf: Path) -> list[str]:
    """Return the help of the key at the top level with this name, or of all without a name.

    The comments of ``config.yaml`` explain them; `config.schema` imports NumPy, which is too slow for ``--help``.
    """
    lines = re.findall(r"^(\w+): (\S+) +# (.*)", (conf / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE)
    return [_hanging(f"  {f'{key}={value}':<{INDENT + 6}}", text) for key, value, text in lines if name in ("", key)]


def group_lines(conf: Path) -> list[tuple[str, str]]:
    """Return each group with its options, in the order of the defaults list; without any, with what its keys are."""
    lines = []
    for group in re.findall(r"^  - (\w+): ", (conf / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE):
        options = [name for name in group_options(group, conf) if name != "default"]
        lines.append((group, " ".join(options) or option_summary(group, "default", conf)))
    for group, contents in ADDED_GROUPS.items():
        options = group_options(group, conf)
        if options:
            lines.append((group, f"{' '.join(options)} ({contents}; added with a plus: +{group}={options[0]})"))
    return lines


def exit_code_lines() -> str:
    """Return the exit codes with their meaning."""
    return "\n".join(["Exit codes:", *(_hanging(f"  {code:<{INDENT + 3}}", text) for code, text in EXIT_CODES.items())])


def group_help(group: str, conf: Path) -> str:
    """Return the help of one group of settings: its options and its keys."""
    from unprocess_gen.config.schema import GROUPS, group_settings

    parts = []
    options = [option for option in group_options(group, conf) if option != "default"]
    if options:
        plus = "+" if group in ADDED_GROUPS else ""
        lines = [_two_columns(option, option_summary(group, option, conf)) for option in options]
        parts.append("\n".join([f"Options of {group} ({plus}{group}=OPTION):", *lines]))
    if group in GROUPS:
        from unprocess_gen.config.defaults import default_options, default_values

        settings = group_settings(group)
        nested = {name.rpartition(".")[0] for name in settings if "." in name}
        inside = {f"{key}.{name}": value for key in nested for name, value in default_values(f"{group}.{key}").items()}
        values, option = default_values(group) | inside, default_options().get(group) or "default"
        chosen = f" with {group}={option}" if option != "default" else ""
        title = f"Keys of {group} ({group}.KEY=VALUE), and their defaults{chosen}:"
        lines = [
            _two_columns(f"{name}={value_text(values[name])}"[: WIDTH - 2], setting.description)
            for name, setting in settings.items()
        ]
        parts.append("\n".join([title, *lines]))
    return "\n\n".join(parts) + "\n"


def _hanging(start: str, text: str) -> str:
    """Return text that begins with ``start`` and continues below the text."""
    lines = textwrap.wrap(text, WIDTH - len(start), break_long_words=False, break_on_hyphens=False)
    return start + f"\n{' ' * len(start)}".join(lines)


def verb_help(verb: Verb) -> str:
    """Return the help of one verb."""
    sections = {
        "Arguments": [
            *([(verb.place.metavar, verb.place.expected)] if verb.place else []),
            *([(verb.extra.metavar, verb.extra.help)] if verb.extra else []),
        ],
        "Flags and settings": [
            (argument.spelled, argument.help + (" (required)" if argument.required else ""))
            for argument in (*verb.arguments, *STANDARD)
        ]
        + [("-h, --help", "show this help")],
        "Hydra's flags": [(flag.spelled, flag.help) for flag in HYDRA_FLAGS if verb.composes],
    }
    parts = [f"usage: {synopsis(verb)}", textwrap.fill(_sentence(verb), WIDTH)]
    for title, lines in sections.items():
        if lines:
            parts.append("\n".join([f"{title}:", *(_two_columns(*line) for line in lines)]))
    if verb.composes:
        parts.append("Settings are listed by gen-dataset --help, and explained by gen-dataset --help GROUP.")
    return "\n\n".join(parts) + "\n"


def synopsis(verb: Verb) -> str:
    """Return the command line of a verb with its required arguments."""
    words = [f"[{verb.place.metavar}]" if verb.place.optional else verb.place.metavar] if verb.place else []
    words += [f"[{verb.extra.metavar}]"] if verb.extra else []
    words += [argument.spelled for argument in verb.arguments if argument.required]
    words += ["[key=value ...]"] if verb.composes else []
    return " ".join(["gen-dataset", verb.name, *words, "[flags]"])


def _sentence(verb: Verb) -> str:
    return f"{verb.summary[0].upper()}{verb.summary[1:]}."


def _two_columns(left: str, right: str) -> str:
    if len(left) + 4 > COLUMN:
        return f"  {left}\n{_hanging(' ' * COLUMN, right)}"
    return _hanging(f"  {left}".ljust(COLUMN), right)
