"""README and docs explain everything that a user can set or read, and agree with the code."""

from __future__ import annotations

import dataclasses
import operator
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import update_reference
from helpers.datasets import Settings

from unprocess_gen.cli.arguments import HYDRA_FLAGS, STANDARD
from unprocess_gen.cli.help import global_help
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.defaults import default_values
from unprocess_gen.config.distributions import DISTRIBUTIONS
from unprocess_gen.config.iso_forms import ISO_FORMS
from unprocess_gen.config.option_files import ADDED_GROUPS, group_options, option_summary
from unprocess_gen.config.schema import GROUPS, BranchConfig, Config, ProvenanceConfig, RawConfig
from unprocess_gen.config.settings import all_settings, groups_in, settings_of
from unprocess_gen.core.errors import REASONS
from unprocess_gen.dataset.row import COLUMNS

HELP = global_help(VERBS)
ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


@pytest.mark.parametrize("name", update_reference.GENERATED)
def test_generated_parts_follow_from_the_code(name: str) -> None:
    page, before, after = update_reference.updated(name)
    assert before == after, f"{page.name} is out of date: run python docs/update_reference.py"


@pytest.mark.parametrize("name", update_reference.GENERATED_FILES)
def test_generated_files_follow_from_the_code(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8") == update_reference.GENERATED_FILES[name]()


def linked_files(page: Path) -> list[Path]:
    targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    return [(page.parent / target).resolve() for target in targets]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_of_a_page_lead_to_files(page: Path) -> None:
    assert [str(path) for path in linked_files(page) if not path.exists()] == []


def test_every_page_is_reached_by_links_without_the_site() -> None:
    reached: set[Path] = set()
    found = {ROOT / "docs" / "index.md"}
    while found:
        reached |= found
        found = {path for page in found for path in linked_files(page) if path.suffix == ".md"} - reached
    missing = [str(page.relative_to(ROOT)) for page in PAGES[1:] if page not in reached]
    assert missing == [], "link these pages from docs/index.md or from the index page of their folder"


# Explanations in the code, which --help and the reference show -------------------------------------------------------


UNITS = {"_dn": "DN", "_dn2": "DN²", "_e": "electrons", "_e_per_s": "electrons per second", "_s": "seconds"}
UNITS |= {"_c": "degrees Celsius", "_per_e": "DN per electron"}
"""First words of the unit that a name's suffix promises."""


def promised_unit(name: str) -> str:
    """Return what the unit of a key or column must begin with."""
    name = re.sub(r"_\d\d$", "", name)
    return next((UNITS[suffix] for suffix in sorted(UNITS, key=len, reverse=True) if name.endswith(suffix)), "")


def test_every_setting_and_column_is_explained() -> None:
    """Generated pages list them, like the declarations below (`test_generated_files_follow_from_the_code`)."""
    kinds = (BranchConfig, ProvenanceConfig)
    items = [(name, setting) for kind in kinds for name, setting in settings_of(kind).items()]
    items += [(key.rpartition(".")[2], setting) for key, setting in all_settings(Config).items()]
    for name, declared in [*items, *((column.name, column) for column in COLUMNS)]:
        assert declared.meaning and not declared.meaning.endswith("."), name
        assert str(declared.limit), name
        assert declared.unit.startswith(promised_unit(name)), name


def test_settings_declare_all_keys_of_the_schema() -> None:
    for kind in (*GROUPS.values(), RawConfig, BranchConfig, ProvenanceConfig, Config):
        assert {field.name for field in dataclasses.fields(kind)} == {*settings_of(kind), *groups_in(kind)}


def test_null_is_explained_if_it_is_a_default() -> None:
    for group in ("", *GROUPS):
        for name, setting in (all_settings(GROUPS[group]) if group else settings_of(Config)).items():
            assert setting.null or default_values(group)[name] is not None, f"{group}.{name}"


def test_default_values_are_those_of_a_composed_config(settings: Settings) -> None:
    config = settings()
    for group in ("", *GROUPS):
        composed = getattr(config, group) if group else config
        for name, written in default_values(group).items():
            value = operator.attrgetter(name)(composed)
            assert (tuple(written) if isinstance(written, list) else written) == value, f"{group}.{name}"


def test_every_option_form_reason_verb_and_flag_is_explained() -> None:
    for group in (*GROUPS, *ADDED_GROUPS):
        for option in group_options(group):
            assert re.fullmatch(r"[A-Z].*\.", option_summary(group, option)), f"{group}={option}"
    assert all(form.meaning and form.numbers for form in [*DISTRIBUTIONS.values(), *ISO_FORMS.values()])
    assert all(REASONS.values())
    for verb in VERBS.values():
        summaries = [
            verb.summary,
            *(flag.options["help"] for flag in (*verb.flags, *STANDARD, *HYDRA_FLAGS)),
            *verb.keys.values(),
        ]
        assert all(summaries) and f"  {verb.name} " in HELP, verb.name


# Pages ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(?:python )?((?:tests|\.readme)/[\w./]+\.py)", TEXT))))
def test_files_that_the_docs_name_exist(path: str) -> None:
    assert (ROOT / path).is_file()


def test_docs_name_no_verb_that_does_not_exist() -> None:
    assert set(re.findall(r"gen-dataset ([a-z]+) ", TEXT)) <= set(VERBS)
