"""README and docs explain everything that a user can set or read, and agree with the code."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import update_reference

from unprocess_gen.cli.help import global_help
from unprocess_gen.cli.verbs import VERBS
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import PHYSICAL_NUMBERS, BranchConfig, Config
from unprocess_gen.core.errors import REASONS
from unprocess_gen.planning.noise_profile import FORMS

HELP = global_help(VERBS, conf_dir())
ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
README = PAGES[0].read_text(encoding="utf-8")
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
OPTIONS = sorted((path.parent.name, path.stem) for path in (ROOT / "conf").glob("*/*.yaml"))


@pytest.mark.parametrize("name", update_reference.GENERATED)
def test_generated_parts_follow_from_the_code(name: str) -> None:
    page, before, after = update_reference.updated(name)
    assert before == after, f"{page.name} is out of date: run python docs/update_reference.py"


@pytest.mark.parametrize("name", update_reference.GENERATED_FILES)
def test_generated_files_follow_from_the_code(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8") == update_reference.GENERATED_FILES[name]()


def test_readme_is_short() -> None:
    assert len(README.splitlines()) <= 200


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


@pytest.mark.parametrize("group", [field.name for field in dataclasses.fields(Config)])
def test_every_group_and_top_level_key_is_in_the_docs_and_the_help(group: str) -> None:
    assert f"`{group}`" in TEXT
    assert re.search(rf"\b{group}\b", HELP)


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_is_in_the_docs(group: str, option: str) -> None:
    assert option == "default" or f"`{option}`" in TEXT


KEYS = [
    (group.name, field.name)
    for group in dataclasses.fields(Config)
    if group.name in ("source", "gains", "isp", "sensor", "scene", "effects", "clean")
    for field in dataclasses.fields(getattr(Config(), group.name))
    if (group.name, field.name) != ("scene", "name")
]
KEYS += [("noise", key) for key in PHYSICAL_NUMBERS] + [
    ("noise", field.name) for field in dataclasses.fields(BranchConfig) if field.name != "iso"
]


@pytest.mark.parametrize(("group", "key"), KEYS)
def test_every_key_of_a_group_is_in_the_docs(group: str, key: str) -> None:
    assert f"`{key}`" in TEXT


@pytest.mark.parametrize("form", [*FORMS, "by_log_iso"])
def test_every_form_of_a_physical_profile_is_in_the_docs(form: str) -> None:
    assert f"[{form}, " in TEXT


@pytest.mark.parametrize("reason", REASONS)
def test_every_reason_is_in_the_docs(reason: str) -> None:
    assert f"`{reason}`" in TEXT


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_in_the_docs_and_the_help(verb: str) -> None:
    assert f"gen-dataset {verb}" in TEXT
    assert f"gen-dataset {verb}" in HELP


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(?:python )?((?:tests|\.readme)/[\w./]+\.py)", TEXT))))
def test_files_that_the_docs_name_exist(path: str) -> None:
    assert (ROOT / path).is_file()


def test_docs_name_no_verb_that_does_not_exist() -> None:
    assert set(re.findall(r"gen-dataset ([a-z]+) ", TEXT)) <= set(VERBS)
