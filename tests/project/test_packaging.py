"""The wheel built from the sdist contains conf/ and manifests/, and runs without a source tree."""

from __future__ import annotations

import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from helpers.commands import run_process

ROOT = Path(__file__).parents[2]
CURVES = "unprocess_gen/simulation/data/curves_16bit.npz"
PROJECT_FILES = (
    *("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "uv.lock", ".pre-commit-config.yaml"),
    *(".github/workflows/tests.yml", ".readme/denoiser.jpg", "docs/conf.py"),
)
"""Files outside the package that the tests read."""
OPTIONS = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "conf").rglob("*.yaml"))


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


def test_the_sdist_holds_options_tests_and_readme(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}

    assert {*OPTIONS, *PROJECT_FILES, "README.md", "pyproject.toml", "tests/project/test_packaging.py", CURVES} <= names


def test_the_wheel_holds_every_option_inside_the_package(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()

    assert {f"unprocess_gen/{option}" for option in OPTIONS} <= set(names)
    assert CURVES in names
    assert not any(name.startswith(("conf/", "tests/")) for name in names)
    assert "unprocess_gen/py.typed" in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_the_installed_command_reads_its_own_files(installed: Path, tmp_path: Path) -> None:
    code = "import unprocess_gen; print(unprocess_gen.__file__)"
    where = run_process(installed / "python", "-c", code, cwd=tmp_path, PYTHONPATH="")
    done = run_process(installed / "gen-dataset", "--cfg", "job", "camera=choice", cwd=tmp_path, PYTHONPATH="")

    assert Path(where.stdout.strip()).is_relative_to(installed.parent)
    assert (done.returncode, "law: choice" in done.stdout) == (0, True), done.stderr


@pytest.mark.slow
def test_the_installed_command_compiles_its_kernels(installed: Path, tmp_path: Path) -> None:
    done = run_process(installed / "gen-dataset", "out=ds", "source.limit=1", cwd=tmp_path, PYTHONPATH="")

    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ds"]
