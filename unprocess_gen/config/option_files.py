"""Locate the YAML option files of ``conf/``, without importing Hydra."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen.core.errors import ConfigError


def conf_dir() -> Path:
    """Return the folder of the built-in option files.

    An installed package contains it as ``unprocess_gen/conf``; in a source tree it is next to the package.

    Returns
    -------
    Path
        Absolute path of the folder that contains ``config.yaml``.

    Raises
    ------
    ConfigError
        If the installation lacks the folder.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise ConfigError(f"conf/config.yaml: not found in or next to {package}; reinstall unprocess_gen")


def group_options(group: str, *folders: Path) -> list[str]:
    """Return the names of the options of a config group.

    Parameters
    ----------
    group : str
        A folder of option files, such as ``camera``.
    *folders : Path
        Roots to search; `conf_dir` if none is given.

    Returns
    -------
    list of str
        File names without ``.yaml``, sorted; empty if no root has the group.
    """
    return sorted({path.stem for folder in folders or (conf_dir(),) for path in (folder / group).glob("*.yaml")})
