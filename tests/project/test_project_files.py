"""Licence, citation, changelog, workflows and lock file agree with the package."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import yaml
from helpers.linux_only import MODULES, TESTS
from packaging.requirements import Requirement

import unprocess_gen

ROOT = Path(__file__).parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_licence_and_version_are_the_same_everywhere() -> None:
    """The citation was validated with cffconvert 2.0.0; this checks required keys and the values of this project."""
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License\n\nCopyright (c) ")
    citation = read_yaml("CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["license"] == PROJECT["license"] == "MIT"
    assert citation["version"] == unprocess_gen.__version__
    assert all({"type", "authors", "title"} <= reference.keys() for reference in citation["references"])
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings[:2] == ["Unreleased", unprocess_gen.__version__]


def test_workflows_follow_the_schema_of_github() -> None:
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.github-workflows", *WORKFLOWS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_hooks_and_workflows_run_tools_of_the_test_extra() -> None:
    repos = read_yaml(".pre-commit-config.yaml")["repos"]
    hooks = {hook["entry"].split()[0] for repo in repos for hook in repo["hooks"]}
    extra = {Requirement(text).name for text in PROJECT["optional-dependencies"]["test"]}
    text = (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8")
    for command in ("pytest", "ruff", "mypy", "lint-imports"):
        assert {"lint-imports": "import-linter"}.get(command, command) in extra
        assert command in hooks and re.search(rf"\b{command}\b", text), command


def test_lock_file_follows_from_the_dependencies_and_names_public_hosts() -> None:
    text = (ROOT / "uv.lock").read_text(encoding="utf-8")
    assert set(re.findall(r"https?://([^/\"]+)", text)) == {"pypi.org", "files.pythonhosted.org"}
    lock = tomllib.loads(text)
    (own,) = (package for package in lock["package"] if package["name"] == "unprocess-gen")
    groups = {"": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}

    def libraries(extra: str) -> set[str]:
        needed = [*map(Requirement, groups[extra])]
        own_extras = {inner for one in needed if one.name == "unprocess_gen" for inner in one.extras}
        others = {one.name.lower().replace("_", "-") for one in needed if one.name != "unprocess_gen"}
        return others.union(*map(libraries, own_extras))

    wanted = {(name, extra) for extra in groups for name in libraries(extra)}
    recorded = {
        (one["name"], (re.findall(r"extra == '(\w+)'", one.get("marker", "")) or [""])[0])
        for one in own["metadata"]["requires-dist"]
    }
    assert recorded == wanted, "uv.lock is out of date: run uv lock"


def test_modules_that_need_linux_exist() -> None:
    assert [name for name in MODULES if not (TESTS / name).is_file()] == []
