"""Licence, citation, changelog, workflows and lock file agree with the package."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.linux_only import MODULES, TESTS
from packaging.requirements import Requirement

import unprocess_gen

ROOT = Path(__file__).parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_licence_is_mit_everywhere() -> None:
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert text.startswith("MIT License\n\nCopyright (c) 2026 the unprocess_gen authors\n")
    assert (PROJECT["license"], PROJECT["license-files"]) == ("MIT", ["LICENSE"])
    assert read_yaml("CITATION.cff")["license"] == "MIT"


def test_citation_has_the_version_and_both_references() -> None:
    """The file was validated with cffconvert 2.0.0; this checks required keys and the values of this project."""
    citation = read_yaml("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["version"] == PROJECT["version"] == unprocess_gen.__version__
    assert [reference["title"] for reference in citation["references"]] == [
        "Image Unprocessing: A Pipeline to Recover Raw Data from sRGB Images",
        "Unprocessing Images for Learned Raw Denoising",
    ]
    assert all({"type", "authors"} <= reference.keys() for reference in citation["references"])


def test_changelog_names_the_version_and_what_is_unreleased() -> None:
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert headings[1] == unprocess_gen.__version__


def test_workflows_follow_the_schema_of_github() -> None:
    assert {path.stem for path in WORKFLOWS} == {"tests", "wheel", "docs"}
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.github-workflows", *WORKFLOWS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("command", ["pytest", "ruff", "mypy", "lint-imports"])
def test_hooks_and_workflows_run_tools_of_the_test_extra(command: str) -> None:
    hooks = [
        hook["entry"].split()[0] for repo in read_yaml(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]
    ]
    extra = {Requirement(text).name for text in PROJECT["optional-dependencies"]["test"]}
    assert command in hooks
    assert re.search(rf"\b{command}\b", (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))
    assert {"lint-imports": "import-linter"}.get(command, command) in extra


def test_lock_file_follows_from_the_dependencies_and_names_public_hosts() -> None:
    text = (ROOT / "uv.lock").read_text(encoding="utf-8")
    assert set(re.findall(r"https?://([^/\"]+)", text)) == {"pypi.org", "files.pythonhosted.org"}
    lock = tomllib.loads(text)
    (own,) = (package for package in lock["package"] if package["name"] == "unprocess-gen")
    groups = {"": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}
    names = {extra: [Requirement(text).name for text in texts] for extra, texts in groups.items()}
    wanted = {(name.lower().replace("_", "-"), extra) for extra in names for name in names[extra]}
    recorded = {
        (one["name"], (re.findall(r"extra == '(\w+)'", one.get("marker", "")) or [""])[0])
        for one in own["metadata"]["requires-dist"]
    }
    assert recorded == wanted, "uv.lock is out of date: run uv lock"


def test_modules_that_need_linux_exist() -> None:
    assert [name for name in MODULES if not (TESTS / name).is_file()] == []
