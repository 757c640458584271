"""Locate the YAML option files of ``conf/``, without importing Hydra."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from unprocess_gen.core.errors import ConfigError

MAX_KEY_CHARACTERS = 100
"""Longest key of an override; groups are looked up as folders, whose names have at most 255 bytes."""

MAX_BRACKETS = 1000
"""Most opening brackets of one override; Hydra's parser recurses once for each level of nesting."""

YAML_SUFFIXES = (".yaml", ".yml")

ADDED_GROUPS = {"experiment": "settings of published work", "sweep": "prepared sweeps"}
"""Groups without settings of their own, with what they contain: options are added with ``+``."""

OPTIONAL_GROUPS = ("body",)
"""Groups that may have no option: ``body=null``."""

PACKAGE_DIRECTIVE = "# @package"
"""Begin of the first line of an option file whose keys are at the top level."""


def conf_dir() -> Path:
    """Return the folder of the built-in option files."""
    return shipped_folder("conf", "config.yaml")


class OptionFolders(NamedTuple):
    """The user's folder, the name of the primary config (None: ``config``) and its folder (None: `conf_dir`)."""

    own: Path | None = None
    name: str | None = None
    given_main: Path | None = None

    @property
    def main(self) -> Path:
        """Folder of the primary config, which is searched first."""
        return self.given_main or conf_dir()


def shipped_folder(name: str, file: str) -> Path:
    """Return a folder by a file in it: an installed package contains it, in a source tree it is next to the package."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / name, package.parent / name):
        if (folder / file).is_file():
            return folder
    raise ConfigError(f"{name}/{file}: not found in or next to {package}; reinstall unprocess_gen")


def group_options(group: str, *folders: Path) -> list[str]:
    """Return the names of the options of a config group below some folders, `conf_dir` if none is given."""
    return sorted({path.stem for folder in folders or (conf_dir(),) for path in (folder / group).glob("*.yaml")})


def option_summary(group: str, option: str, folder: Path | None = None) -> str:
    """Return the first line of the comment at the head of an option's file; empty without one."""
    path = (folder or conf_dir()) / group / f"{option}.yaml"
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    head = [line for line in lines if not line.startswith(PACKAGE_DIRECTIVE)][:1]
    return head[0].lstrip("# ") if head and head[0].startswith("#") else ""


def check_override(override: str) -> None:
    """Refuse an override that Hydra would take for something else, or answer with several lines."""
    key, equals, value = override.lstrip("+").partition("=")
    if max(map(override.count, "[{(")) > MAX_BRACKETS:
        raise ConfigError(f"{override[:60]}…: nested too deeply; expected at most {MAX_BRACKETS} brackets")
    if override.startswith("~"):
        problem = "a setting cannot be removed; expected key=value; choose another value or option"
        raise ConfigError(f"{override}: {problem}")
    if not equals or len(key) > MAX_KEY_CHARACTERS:
        raise ConfigError(f"{override[:MAX_KEY_CHARACTERS]}: expected a setting key=value; see gen-dataset --help")
    if key.startswith("hydra") and key != "hydra.mode":
        raise ConfigError(f"{override}: Hydra's own settings are fixed; expected only hydra.mode")
    if key in ADDED_GROUPS and not override.startswith("+"):
        raise ConfigError(f"{override}: is added to the settings; write +{override}")
    options = group_options(key) if key.isalpha() else []
    is_name = re.match(r"(?!(null|true|false)$)[A-Za-z_]", value) and not (
        "/" in value and value.endswith(YAML_SUFFIXES)
    )
    if options and not is_name and not (key in OPTIONAL_GROUPS and value == "null"):
        raise ConfigError(f"{override}: expected the name of an option: {', '.join(options)}{file_hint(key, value)}")


def file_hint(group: str, name: str) -> str:
    """Remedy for the path of a user's YAML file as an option; empty if the name is no such path."""
    if "/" not in name and not name.endswith(YAML_SUFFIXES):
        return ""
    return f"; for a file of your own, put it in FOLDER/{group} and write --config-dir FOLDER {group}={Path(name).stem}"
