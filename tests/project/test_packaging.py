"""The wheel built from the sdist contains conf/ and manifests/, and runs without a source tree."""

from __future__ import annotations

import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from helpers.commands import run_process

import unprocess_gen

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
INCLUDED: list[str] = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
"""Files and folders of the sdist, with a leading slash."""


def files_below(folder: str) -> set[str]:
    """Return the files of a folder of the repository, or the file of this name."""
    paths = [ROOT / folder, *(ROOT / folder).rglob("*")]
    return {path.relative_to(ROOT).as_posix() for path in paths if path.is_file() and "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the sdist and the wheel built from it."""
    folder = tmp_path_factory.mktemp("dist")
    done = run_process(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the bin folder of a new environment with the dependencies of this one but without its package."""
    pytest.importorskip("pip", reason="uv installs no pip")
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    (wheel,) = built.glob("*.whl")
    installing = run_process(
        *(sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python),
        *("install", "--no-deps", "--no-index", wheel),
        cwd=folder,
    )
    assert installing.returncode == 0, installing.stderr
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    (folder / "lib" / version / "site-packages" / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "bin"


def test_the_sdist_is_what_the_project_includes(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as sdist:
        names = {member.name.partition("/")[2] for member in sdist.getmembers() if member.isfile()}

    added = {"PKG-INFO", "pyproject.toml", ".gitignore"}
    assert names == added.union(*(files_below(name[1:]) for name in INCLUDED))


def test_the_wheel_is_the_package_with_options_and_manifests(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    assert wheel.name.startswith(f"unprocess_gen-{unprocess_gen.__version__}-")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}

    options = {f"unprocess_gen/{name}" for folder in ("conf", "manifests") for name in files_below(folder)}
    assert names == files_below("unprocess_gen") | options
    assert {"unprocess_gen/py.typed", "unprocess_gen/conf/config.yaml"} <= names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in zipfile.ZipFile(wheel).namelist())


def test_the_installed_command_reads_its_own_files(installed: Path, tmp_path: Path) -> None:
    code = "import unprocess_gen; print(unprocess_gen.__file__)"
    where = run_process(installed / "python", "-c", code, cwd=tmp_path, PYTHONPATH="")
    done = run_process(installed / "gen-dataset", "--cfg", "job", "camera=choice", cwd=tmp_path, PYTHONPATH="")

    assert Path(where.stdout.strip()).is_relative_to(installed.parent)
    assert (done.returncode, "law: choice" in done.stdout) == (0, True), done.stderr


@pytest.mark.slow
def test_the_installed_command_works_without_a_source_tree(installed: Path, tmp_path: Path) -> None:
    code = "import unprocess_gen as ug; print(len(ug.RawPairs('ds')), [getattr(ug, name) for name in ug.__all__][:0])"
    for command in ("out=ds source.limit=1", "verify ds", "replay ds", "build --list", "preview ds --to sheets"):
        done = run_process(installed / "gen-dataset", *command.split(), cwd=tmp_path, PYTHONPATH="")
        assert done.returncode == 0, done.stderr
    done = run_process(installed / "python", "-W", "error", "-c", code, cwd=tmp_path, PYTHONPATH="")

    assert done.stdout == "1 []\n", done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ds", "sheets"]
