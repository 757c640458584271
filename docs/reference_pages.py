"""Generate the pages of ``docs/reference`` from the tables in the code: settings, manifest columns, command line."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from effect_page import effects_page
from noise_profile_page import profiles_page
from scene_page import scenes_page

from unprocess_gen.cli.arguments import HYDRA_FLAGS, STANDARD, Flag, Verb
from unprocess_gen.cli.exit_codes import EXIT_CODES
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.defaults import default_options, default_values
from unprocess_gen.config.distributions import DISTRIBUTIONS
from unprocess_gen.config.distributions import spelled as spelled_form
from unprocess_gen.config.interpretation import needed_numbers
from unprocess_gen.config.iso_forms import ISO_FORMS
from unprocess_gen.config.option_files import ADDED_GROUPS, group_options, option_summary
from unprocess_gen.config.schema import GROUPS, BranchConfig, Config, ProvenanceConfig
from unprocess_gen.config.settings import Setting, all_settings, settings_of
from unprocess_gen.core.errors import REASONS
from unprocess_gen.core.fields import value_text
from unprocess_gen.dataset.columns import TYPE_NAMES
from unprocess_gen.dataset.row import COLUMNS
from unprocess_gen.simulation.effects import EFFECTS

GENERATED_NOTE = "<!-- from the code: python docs/update_reference.py -->"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table; cells are escaped."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def page(*blocks: str) -> str:
    """Return a page of blocks, with a note that it is generated."""
    return "\n\n".join([GENERATED_NOTE, *blocks]) + "\n"


def code(text: str) -> str:
    """Return text as inline code; an empty text stays empty."""
    return f"`{text}`" if text else ""


# ----------------------------------------------------------------------------------------------------------- settings

SETTINGS_INTRODUCTION = """\
# Settings

Settings are `key=value` arguments of `gen-dataset`, in any order. `group=option` selects an option, a file of `conf/`.
`group.key=value` changes one value. With `-m`, values separated by commas are swept. `gen-dataset --cfg job` prints all
settings of a run, and `gen-dataset --help GROUP` the options and keys of a group.
[Compose settings](../guides/configuration.md) has examples."""

DISTRIBUTIONS_INTRODUCTION = """\
## Distributions

A setting that is drawn for each image is a number, which is the same for all images, or a distribution, written as a
list: `gains.red=[uniform,1.9,2.4]`. The column "allowed" names the distributions that a setting accepts."""

PROVENANCE_INTRODUCTION = """\
### Keys of a statement of provenance

Each item of `noise.provenance` states where numbers come from. `plan` prints the statements for the ISOs that occur.
[Noise profiles](noise_profiles.md) has those of the built-in profiles."""

FORMS_INTRODUCTION = """\
### Numbers that depend on ISO

A number of a branch is constant, or one of these forms:"""

BRANCH_INTRODUCTION = """\
### Keys of a branch

Each item of `noise.branches` contains the numbers of a physical profile for one range of ISO. Two ranges may share an
end; the first branch is used there. An ISO outside of all branches is refused."""

EFFECTS_INTRODUCTION = """\
### Numbers that an effect needs

An effect is simulated only if the noise profile gives its numbers."""


def settings_page() -> str:
    """Return the page of all settings: options, keys, distributions and the numbers of noise profiles."""
    defaults = default_options()
    blocks = [SETTINGS_INTRODUCTION, "## Top level", _keys("", settings_of(Config))]
    for group, kind in GROUPS.items():
        blocks += [f"## `{group}`", _first_line(kind)]
        options = [option for option in group_options(group) if option != "default"]
        if options:
            blocks.append(_options(group, options, defaults[group]))
        settings = all_settings(kind)
        if options and len(options) > 1:
            chosen = f", with their values in `{group}={defaults[group]}`" if defaults[group] else ""
            blocks.append(f"Keys{chosen}:")
        for section in dict.fromkeys(setting.section for setting in settings.values()):
            if section:
                blocks.append(f"### {section}")
            blocks.append(_keys(group, {name: one for name, one in settings.items() if one.section == section}))
        if group == "noise":
            blocks += [
                BRANCH_INTRODUCTION,
                _keys(None, settings_of(BranchConfig)),
                FORMS_INTRODUCTION,
                _forms(ISO_FORMS),
                PROVENANCE_INTRODUCTION,
                _keys(None, settings_of(ProvenanceConfig)),
            ]
        if group == "effects":
            blocks += [EFFECTS_INTRODUCTION, _effect_numbers()]
    for group, contents in ADDED_GROUPS.items():
        text = f"Options for {contents}. They are added with a plus: `+{group}=OPTION`."
        blocks += [f"## `{group}`", text, _options(group, group_options(group), "")]
    blocks += [DISTRIBUTIONS_INTRODUCTION, _forms(DISTRIBUTIONS), _not_data()]
    return page(*blocks)


def _first_line(kind: type) -> str:
    return (kind.__doc__ or "").splitlines()[0].replace("``", "`")


def _options(group: str, options: Iterable[str], default: str) -> str:
    return table(
        ["option", "meaning"],
        [[f"`{name}`{' (default)' if name == default else ''}", option_summary(group, name)] for name in options],
    )


def _keys(group: str | None, settings: Mapping[str, Setting]) -> str:
    """Return the table of a group's keys; ``None`` stands for the branches, which have no defaults."""
    values = {} if group is None else default_values(group)
    head = ["key", "default", "unit", "allowed", "meaning"]
    rows = [
        [
            code(name),
            code(value_text(values[name])) if name in values else "",
            setting.unit,
            str(setting.limit),
            setting.meaning + (f"; null: {setting.null}" if setting.null else ""),
        ]
        for name, setting in settings.items()
    ]
    kept = [place for place in range(len(head)) if any(row[place] for row in rows)]
    return table([head[place] for place in kept], [[row[place] for place in kept] for row in rows])


def _forms(forms: Mapping[str, object]) -> str:
    rows = []
    for name, form in {**DISTRIBUTIONS, **ISO_FORMS}.items():
        if name in forms:
            written = "a number" if name == "constant" else spelled_form(name, form.numbers)
            rows.append([code(written), form.meaning])
    return table(["form", "meaning"], rows)


def _effect_numbers() -> str:
    keys = {effect.name: needed_numbers(effect.name) for effect in EFFECTS} | {"heteroscedastic": ("a", "b")}
    effects = [name for name in settings_of(GROUPS["effects"]) if keys.get(name)]
    return table(["effect", "keys of `noise`"], [[code(name), ", ".join(map(code, keys[name]))] for name in effects])


def _not_data() -> str:
    names = [f"`{name}`" for name, one in all_settings(Config).items() if not one.decides_data]
    return (
        "## Settings that do not decide the data\n\n"
        "The bytes of a dataset do not depend on these keys. `config.yaml` omits them, and a rerun may change them:\n"
        f"{', '.join(names[:-1])} and {names[-1]}."
    )


# ------------------------------------------------------------------------------------------------------------ columns

COLUMNS_INTRODUCTION = """\
# Manifest columns

`manifest.csv` has one row for each pair, and one for each source that failed. The columns are in this order. A manifest
lacks the columns that its settings cannot fill. `KEY.json` in the shards contains the same values, typed, without empty
ones.

An empty cell means that there is no value. Numbers are written so that they read back exactly."""

REASONS_INTRODUCTION = """\
## Reasons for failures

A source that cannot be used has a row with `status` failed. `reason` is one of these words; `detail` explains it in one
line."""


def columns_page() -> str:
    """Return the page of manifest columns and reasons for failures."""
    rows = [
        [
            code(column.name),
            column.meaning,
            TYPE_NAMES[column.type],
            column.unit,
            column.empty_if,
            column.needs.unless,
        ]
        for column in COLUMNS
    ]
    reasons = [[code(reason), meaning] for reason, meaning in REASONS.items()]
    return page(
        COLUMNS_INTRODUCTION,
        table(["column", "meaning", "type", "unit", "empty if", "left out if"], rows),
        REASONS_INTRODUCTION,
        table(["reason", "meaning"], reasons),
    )


# ------------------------------------------------------------------------------------------------------- command line

COMMAND_LINE_INTRODUCTION = """\
# Command line

    gen-dataset [key=value ...] [flags]    generate a dataset; the same command resumes it
    gen-dataset VERB ...                   one of the verbs below

The first word is a verb if it consists of lower-case letters only. [Settings](settings.md) and flags may be mixed in
any order. `gen-dataset VERB --help` prints the arguments of a verb, and `gen-dataset --help GROUP` the options and keys
of a group of settings. An argument that names an existing folder is a folder, whatever characters its name contains.
Everything after `--` is a file or folder, even with a leading hyphen."""

HYDRA_INTRODUCTION = """\
## Flags of Hydra

Verbs with `[key=value ...]` also take these flags of
[Hydra](https://hydra.cc/docs/1.3/intro/):"""


def command_line_page() -> str:
    """Return the page of verbs, flags and exit codes."""
    verbs = [[f"[`{verb.name}`](#{verb.name})", verb.summary] for verb in VERBS.values()]
    blocks = [COMMAND_LINE_INTRODUCTION, table(["verb", "effect"], verbs)]
    for verb in VERBS.values():
        blocks += [f"## {verb.name}", f"    {_synopsis(verb)}", _summary(verb)]
        arguments = [[code(verb.place.metavar), verb.place.expected]] if verb.place else []
        arguments += [_argument(flag) for flag in verb.flags]
        arguments += [[code(key), text] for key, text in verb.keys.items()]
        if arguments:
            blocks.append(table(["argument", "meaning"], arguments))
    flags = [_argument(flag) for flag in STANDARD]
    flags += [["`--version`", "print the version"]]
    hydra = [_argument(flag) for flag in HYDRA_FLAGS]
    codes = [[code, meaning] for code, meaning in EXIT_CODES.items()]
    blocks += ["## Flags of every verb", table(["flag", "meaning"], flags)]
    blocks += [HYDRA_INTRODUCTION, table(["flag", "meaning"], hydra)]
    blocks += ["## Exit codes", table(["code", "meaning"], codes)]
    blocks.append("The exit code of a sweep, and of `verify` for a sweep, is that of its worst job.")
    return page(*blocks)


def _summary(verb: Verb) -> str:
    return f"{verb.summary[0].upper()}{verb.summary[1:]}."


def _synopsis(verb: Verb) -> str:
    """Return the command line of a verb with its required arguments."""
    words = [f"[{verb.place.metavar}]" if verb.place.optional else verb.place.metavar] if verb.place else []
    words += [_spelled(flag) for flag in verb.flags if flag.options.get("required")]
    words += ["[key=value ...]"] if verb.composes else []
    return " ".join(["gen-dataset", verb.name, *words, "[flags]"])


def _spelled(flag: Flag) -> str:
    return f"{', '.join(flag.names)} {flag.options.get('metavar', '')}".rstrip()


def _argument(flag: Flag) -> list[str]:
    return [code(_spelled(flag)), flag.options["help"] + (" (required)" if flag.options.get("required") else "")]


PAGES = {
    "docs/reference/settings.md": settings_page,
    "docs/reference/columns.md": columns_page,
    "docs/reference/command_line.md": command_line_page,
    "docs/reference/noise_profiles.md": lambda: profiles_page(table, page),
    "docs/reference/scenes.md": lambda: scenes_page(table, page),
    "docs/reference/effects.md": lambda: effects_page(table, page),
}
"""The pages, and the functions that return their text."""
