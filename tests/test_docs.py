"""The README explains everything a user can set or read."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from unprocess_gen.cli.main import HELP, VERBS
from unprocess_gen.config.schema import BranchConfig, Config
from unprocess_gen.config.validation import RATES
from unprocess_gen.core.errors import REASONS
from unprocess_gen.dataset.columns import COLUMNS
from unprocess_gen.planning.noise_profile import FORMS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
OPTIONS = sorted((path.parent.name, path.stem) for path in (ROOT / "conf").glob("*/*.yaml"))


@pytest.mark.parametrize("column", [column for column in COLUMNS if not column.name.startswith("rgb2cam_")])
def test_every_manifest_column_has_its_meaning_in_the_readme(column: object) -> None:
    assert f"| `{column.name}` | {column.meaning} |" in README  # type: ignore[attr-defined]


def test_the_matrix_columns_are_explained_as_one() -> None:
    assert "| `rgb2cam_00` … `rgb2cam_22` |" in README


@pytest.mark.parametrize("group", [field.name for field in dataclasses.fields(Config)])
def test_every_group_and_top_level_key_is_in_the_readme_and_the_help(group: str) -> None:
    assert f"`{group}`" in README
    assert re.search(rf"\b{group}\b", HELP)


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_is_in_the_readme(group: str, option: str) -> None:
    assert option == "default" or f"`{option}`" in README


KEYS = [
    (group.name, field.name)
    for group in dataclasses.fields(Config)
    if group.name in ("source", "gains", "isp", "sensor", "scene", "effects", "clean")
    for field in dataclasses.fields(getattr(Config(), group.name))
    if (group.name, field.name) != ("scene", "name")
]
KEYS += [("noise", key) for key, _, _ in RATES] + [
    ("noise", field.name) for field in dataclasses.fields(BranchConfig) if field.name != "iso"
]


@pytest.mark.parametrize(("group", "key"), KEYS)
def test_every_key_of_a_group_is_in_the_readme(group: str, key: str) -> None:
    assert f"`{key}`" in README


@pytest.mark.parametrize("form", [*FORMS, "by_log_iso"])
def test_every_form_of_a_physical_profile_is_in_the_readme(form: str) -> None:
    assert f"[{form}, " in README


@pytest.mark.parametrize("reason", REASONS)
def test_every_reason_is_in_the_readme(reason: str) -> None:
    assert f"`{reason}`" in README


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_in_the_readme_and_the_help(verb: str) -> None:
    assert f"gen-dataset {verb}" in README
    assert f"gen-dataset {verb}" in HELP


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`(?:python )?((?:tests|\.readme)/[\w./]+\.py)", README))))
def test_every_file_the_readme_names_is_there(path: str) -> None:
    assert (ROOT / path).is_file()


def test_the_readme_names_no_tool_that_does_not_exist() -> None:
    assert set(re.findall(r"gen-dataset ([a-z]+) ", README)) <= set(VERBS)
