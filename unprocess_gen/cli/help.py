"""Format the help of ``gen-dataset`` and of each verb; import nothing slow."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

from unprocess_gen.cli.arguments import ANY_VALUE, HYDRA_FLAGS, STANDARD, Argument, Verb
from unprocess_gen.config.option_files import group_options

WIDTH = 100
INDENT = 11
COLUMN = 34

INTRODUCTION = """\
gen-dataset: pairs of clean and noisy raw images from ordinary photographs

  gen-dataset camera=convex noise=imx385_iso3200 source.root=photos out=ds     one dataset
  gen-dataset                          the same from the built-in scenes, into ds
  gen-dataset -m camera=sony_a7r,nexus_6p noise=imx385_iso1600,imx385_iso3200 out=sweep
                                       a sweep: one dataset folder each, and sweep/sweep.csv
  gen-dataset VERB --help              the arguments of a verb

Verbs:
"""

SETTINGS = """
Settings are key=value, in any order. group=option chooses an option, group.key=value changes one
value. Groups, their options (and keys):
"""

GROUP_KEYS: Mapping[str, str] = {
    "source": "root, include, recursive, limit, max_pixels, max_failed, icc, clips, video, downscale, dequantize, "
    "patch",
    "camera": "",
    "gains": "",
    "isp": "",
    "sensor": "",
    "noise": "levels, draws: several frames of one clean frame; iso: overrides the ISO of the scene",
    "scene": "",
    "effects": "all (auto, on, off), tolerance, and each effect by name",
    "clean": "includes_fixed_pattern",
    "accuracy": "clean_dn, clean_changed_share, normal_error, law_distance, readable",
    "output": "dtype (uint16, float32), layout (mosaic, packed), pairs_per_shard",
}
"""Groups of settings in the order of the config, and the keys that the help mentions."""

ADDED_GROUPS = {"experiment": "settings of published work", "sweep": "prepared sweeps"}
"""Groups that do not belong to the settings; their options are added with a plus: ``+experiment=ipol_demo``."""

ENDING = """\
and at the top: seed (0), out (ds), n_jobs (-1: all cores), self_test (stop; go_on),
check_disk (true).

Flags:
  --cfg job           print the settings and stop
  --config-dir DIR    add a folder of your own options
  -m, --multirun      sweep over comma-separated values
  -q, --quiet         show only warnings and errors; -v, --verbose: details; --log-file FILE
  --version, --help, --hydra-help
  --                  everything after it is a file or folder, even with a leading hyphen

Tab completion: eval "$(gen-dataset completion bash)", or zsh.

Exit codes: 0 done · 1 a bug · 2 usage or settings · 3 more failed sources than max_failed
            4 damage found · 5 system error (disk full, source changed)
            11 output locked by another run · 129, 130, 143 ended by SIGHUP, SIGINT, SIGTERM
"""


def global_help(verbs: Mapping[str, Verb], conf: Path) -> str:
    """Return the help of ``gen-dataset``.

    Parameters
    ----------
    verbs : mapping of str to Verb
        The verbs by name.
    conf : Path
        Folder of the options; they are listed from it.

    Returns
    -------
    str
        At most 100 columns wide.
    """
    lines = [f"  gen-dataset {verb.name:<11} {verb.summary}" for verb in verbs.values()]
    groups = [_paragraph(*group) for group in group_lines(conf)]
    return INTRODUCTION + "\n".join(lines) + "\n" + SETTINGS + "\n".join(groups) + "\n" + ENDING


def group_lines(conf: Path) -> list[tuple[str, str]]:
    """Return each group of settings with its options and keys, in the order of the config."""
    lines = []
    for group, keys in GROUP_KEYS.items():
        options = [name for name in group_options(group, conf) if name != "default"]
        lines.append((group, " ".join([*options, *([f"({keys})"] if keys else [])])))
    for group, contents in ADDED_GROUPS.items():
        options = group_options(group, conf)
        if options:
            lines.append((group, f"{' '.join(options)} ({contents}; added with a plus: +{group}={options[0]})"))
    return lines


def _paragraph(group: str, text: str) -> str:
    lines = textwrap.wrap(text, WIDTH - INDENT - 2, break_long_words=False, break_on_hyphens=False)
    return textwrap.indent("\n".join(lines), " " * (INDENT + 2)).replace(" " * (INDENT + 2), f"  {group:<{INDENT}}", 1)


def verb_help(verb: Verb) -> str:
    """Return the help of one verb.

    Parameters
    ----------
    verb : Verb
        The verb.

    Returns
    -------
    str
        Usage, arguments and flags.
    """
    words = [verb.place.metavar] if verb.place else []
    words += ["{" + ",".join(verb.words) + "}"] if verb.words else []
    words += [_spelled(argument) for argument in verb.arguments if argument.required]
    words += ["[key=value ...]"] if verb.composes or any(one.settings for one in verb.arguments) else []
    sections = {
        "Arguments": [(verb.place.metavar, verb.place.expected)] if verb.place else [],
        "Flags and settings": [
            (_spelled(argument), argument.help + (" (required)" if argument.required else ""))
            for argument in (*verb.arguments, *STANDARD)
        ]
        + [("-h, --help", "show this help")],
        "Hydra's flags": [
            (", ".join(spellings) + (f" {_choices(values)}" if values else ""), text)
            for spellings, (values, text) in HYDRA_FLAGS.items()
            if verb.composes
        ],
    }
    parts = [" ".join(["usage: gen-dataset", verb.name, *words, "[flags]"]), textwrap.fill(_sentence(verb), WIDTH)]
    for title, lines in sections.items():
        if lines:
            parts.append("\n".join([f"{title}:", *(_two_columns(*line) for line in lines)]))
    if verb.composes:
        parts.append("Settings are listed by gen-dataset --help.")
    return "\n\n".join(parts) + "\n"


def _sentence(verb: Verb) -> str:
    return f"{verb.summary[0].upper()}{verb.summary[1:]}."


def _choices(values: tuple[str, ...]) -> str:
    return "VALUE" if values == ANY_VALUE else "{" + ",".join(values) + "}"


def _spelled(argument: Argument) -> str:
    flags = [", ".join(argument.flags) + (f" {argument.metavar}" if argument.metavar else "")] if argument.flags else []
    return ", ".join([*flags, *(f"{key}={argument.metavar}" for key in argument.settings)])


def _two_columns(left: str, right: str) -> str:
    text = textwrap.wrap(right, WIDTH - COLUMN)
    if len(left) + 4 > COLUMN:
        return "\n".join([f"  {left}", *(" " * COLUMN + line for line in text)])
    return "\n".join([f"  {left}".ljust(COLUMN) + text[0], *(" " * COLUMN + line for line in text[1:])])
