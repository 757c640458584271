"""Datasets are identical on other processors, with other libraries, compilers and environments.

Each test makes one small dataset in a new process under settings that change the code path of a library, and compares
every byte with a plain run. The process reports whether the settings took effect (`everywhere`); a setting that a
library no longer knows proves nothing. Some settings compile the kernels with other options.

A change in the last place of a double changes one DN in 10^12 sites, so that bytes alone could miss it. Doubles before
rounding are therefore compared too, and the machine code of the kernels is inspected for x86-64 with AVX-512, Arm and
RISC-V. `tests/pipeline` covers order and time of creation, time zone, umask, working directory, hash seed, LC_ALL=C,
one and two workers. For emulated 64-bit Arm and an old x86-64, see `everywhere`.
"""

from __future__ import annotations

import hashlib
import io
import json
import platform
import re
import signal
import sys
import tomllib
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from helpers import everywhere
from helpers.commands import run_process
from helpers.datasets import contents
from helpers.photographs import pixels
from helpers.promise_report import Figure
from packaging.requirements import Requirement
from packaging.version import Version
from PIL import Image

from unprocess_gen.sources.image.decode import decode

ROOT = Path(__file__).parents[2]
SCRIPT = Path(everywhere.__file__)


class Made(NamedTuple):
    """A dataset, and the facts that its process reported."""

    facts: dict[str, Any]
    out: Path


Make = Callable[..., Made]


def damaged(form: str, **options: Any) -> bytes:
    """Return a photograph with damaged content, half of which its codec guesses with a warning."""
    stream = io.BytesIO()
    Image.fromarray(pixels(1, 64, 96)).save(stream, form, **options)
    data = bytearray(stream.getvalue())
    middle = len(data) // 2
    data[middle : middle + 60] = b"\xff\x00" * 30 if form == "JPEG" else b"\xff" * 60
    return bytes(data)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eleven small photographs: all JPEG colour samplings, 8 and 16 bits, lossy WebP, two damaged files."""
    folder = tmp_path_factory.mktemp("photographs")
    image = Image.fromarray
    image(pixels(1, 40, 61)).save(folder / "a 420.jpg", quality=90, subsampling="4:2:0")
    image(pixels(2, 33, 50)).save(folder / "été 422.jpg", quality=90, subsampling="4:2:2", progressive=True)
    image(pixels(3, 33, 50)).save(folder / "444.jpg", quality=90, subsampling="4:4:4")
    image(pixels(4, 33, 50)[..., 0]).save(folder / "gray.jpg", quality=90)
    cv2.imwrite(str(folder / "deep.png"), pixels(5, 21, 43, np.uint16))
    cv2.imwrite(str(folder / "deep.tif"), pixels(6, 9, 14, np.uint16))
    image(pixels(7, 5, 1100)).save(folder / "wide.png")
    image(pixels(8, 40, 40)).save(folder / "lossy.webp", quality=80)
    image(pixels(9, 15, 25)).save(folder / "scan.tif", compression="tiff_lzw")
    (folder / "torn.jpg").write_bytes(damaged("JPEG"))
    (folder / "torn.tif").write_bytes(damaged("TIFF", compression="tiff_lzw"))
    return folder


@pytest.fixture(scope="module")
def make(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Return a function that makes the dataset in a new process: Python and its flags, environment."""

    def made(*python: str | Path, **env: str) -> Made:
        folder = tmp_path_factory.mktemp("made")
        settings = ("output.pairs_per_shard=1", "noise=brooks2019", "source.max_failed=2", "n_jobs=1")
        command = [*(python or (sys.executable,)), SCRIPT, "facts.json", f"source.root={photographs}", "out=ds"]
        done = run_process(*command, *settings, cwd=folder, **env)
        if done.returncode == -signal.SIGILL:
            pytest.skip("this processor lacks instructions of another")
        assert done.returncode == 0, done.stdout + done.stderr
        facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
        return Made(facts, folder / "ds")

    return made


@pytest.fixture(scope="module")
def plain(make: Make) -> Made:
    """Return the plain dataset, made without any setting."""
    made = make()
    statuses = re.findall(",(ok|failed),(?:corrupt)?,", (made.out / "manifest.csv").read_text(encoding="utf-8"))
    assert sorted(statuses) == ["failed"] * 2 + ["ok"] * 9
    return made


@pytest.fixture(scope="module")
def compiled(make: Make, plain: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return the plain dataset made by freshly compiled kernels, which alone report their machine code."""
    made = make(NUMBA_CACHE_DIR=str(tmp_path_factory.mktemp("kernels")))
    assert made.facts["kernels"]["compiled"] and not made.facts["kernels"]["loaded"]
    assert_same(made, plain)
    return made


def assert_same(made: Made, plain: Made) -> None:
    mine, theirs = contents(made.out), contents(plain.out)
    assert {name for name in mine | theirs if mine.get(name) != theirs.get(name)} <= {"dataset.json"}
    assert made.facts["doubles"] == plain.facts["doubles"]


# Settings -------------------------------------------------------------------------------------------------------------

ENABLED = [
    name for name in np._core._multiarray_umath.__cpu_dispatch__ if np._core._multiarray_umath.__cpu_features__[name]
]
"""Instruction sets that NumPy uses on this machine, lowest first."""

WITHOUT_FMA = "glibc.cpu.hwcaps=" + ",".join(
    f"-{name}" for name in ("AVX2", "FMA", "FMA4", "AVX2_Usable", "FMA_Usable")
)

SURROUNDINGS = {"LC_ALL": "tr_TR.UTF-8", "MALLOC_PERTURB_": "165", "OPENCV_IO_MAX_IMAGE_PIXELS": "100"}

OLD_OPENCV = {"OPENCV_CPU_DISABLE": ",".join(everywhere.opencv_features()), "OPENCV_IPP": "disabled"}
"""Disable all optional vector code of OpenCV."""

LIBRARIES = OLD_OPENCV | {"NPY_DISABLE_CPU_FEATURES": " ".join(ENABLED), "GLIBC_TUNABLES": WITHOUT_FMA}


SETTINGS: list[tuple[str, dict[str, str]]] = [
    *((flag, SURROUNDINGS | LIBRARIES) for flag in ("", "-O", "-OO")),
    ("", {"NUMBA_DISABLE_JIT": "1"}),
    *(("", {name: value}) for name, value in SURROUNDINGS.items()),
    *(("", env) for env in (OLD_OPENCV, {"GLIBC_TUNABLES": WITHOUT_FMA})),
    *(("", {"NPY_DISABLE_CPU_FEATURES": " ".join(ENABLED[first:])}) for first in range(len(ENABLED))),
    *(("", {"OPENBLAS_CORETYPE": core}) for core in ("Prescott", "Nehalem", "Haswell", "Zen", "SkylakeX")),
]
"""Flags of Python and settings: the oldest code of all libraries at once, then one by one, to name what changes a byte.

``-O`` compiles all Python modules again, without assertions.
"""
CHANGED = {"OPENCV_CPU_DISABLE": "opencv", "GLIBC_TUNABLES": "libm", "NUMBA_DISABLE_JIT": "kernels"}
CHANGED |= {"NPY_DISABLE_CPU_FEATURES": "numpy", "OPENBLAS_CORETYPE": "product"}
"""The fact in which a setting shows."""


@pytest.mark.slow
@pytest.mark.parametrize(("flag", "env"), SETTINGS, ids=lambda value: " ".join(value))
def test_settings_change_no_byte(flag: str, env: dict[str, str], make: Make, plain: Made, figure: Figure) -> None:
    made = make(sys.executable, *filter(None, [flag]), **env)
    assert made.facts["optimize"] == flag.count("O")
    if env.keys() >= LIBRARIES.keys():
        assert (made.facts["numpy"], made.facts["opencv"], made.facts["ipp"]) == ([], [], False)
    shown = [CHANGED[name] for name in env if name in CHANGED]
    if shown and all(made.facts[name] == plain.facts[name] for name in shown):
        pytest.skip(f"{', '.join(env)} changes nothing on this machine")
    assert_same(made, plain)
    figure("machines", f"same bytes in {len(contents(plain.out))} files")


WITHOUT_VECTOR_CODE = """
import hashlib, sys
from PIL import Image
import numpy as np
print(*(hashlib.sha256(np.asarray(Image.open(path).convert("RGB"))).hexdigest() for path in sys.argv[1:]))
mapped = {line.split()[-1] for line in open("/proc/self/maps") if "jpeg" in line or "_imaging" in line}
print(any(b"JSIMD_FORCENONE" in open(path, "rb").read() for path in mapped))
"""


def test_jpegs_have_the_same_pixels_without_vector_code(photographs: Path) -> None:
    """OpenCV's libjpeg-turbo takes no orders from the environment, so Pillow's decodes without vector code."""
    jpegs = sorted(path for path in photographs.glob("*.jpg") if path.name != "torn.jpg")
    command = [sys.executable, "-c", WITHOUT_VECTOR_CODE, *jpegs]
    done = run_process(*command, JSIMD_FORCENONE="1")
    digests, obeyed = done.stdout.splitlines()
    if obeyed != "True":
        pytest.skip("this Pillow's libjpeg takes no orders from the environment either")

    decoded = [decode(path.read_bytes(), max_pixels=2**26, icc="ignore").srgb for path in jpegs]

    assert digests.split() == [hashlib.sha256(srgb.tobytes()).hexdigest() for srgb in decoded]


# Compilers ------------------------------------------------------------------------------------------------------------


GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_INTEL_SVML": "1"}
"""Compile for any processor of this architecture."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "env",
    [
        pytest.param(GENERIC, id="for any processor"),
        pytest.param({"NUMBA_OPT": "0"}, id="not optimised"),
        pytest.param({"NUMBA_OPT": "1"}, id="hardly optimised"),
        pytest.param({"NUMBA_LOOP_VECTORIZE": "0"}, id="not vectorised"),
        pytest.param({"NUMBA_BOUNDSCHECK": "1"}, id="within bounds"),
    ],
)
def test_other_compiler_options_change_no_byte(
    env: dict[str, str], make: Make, compiled: Made, tmp_path: Path, figure: Figure
) -> None:
    made = make(NUMBA_CACHE_DIR=str(tmp_path), **env)

    assert made.facts["kernels"]["compiled"] and not made.facts["kernels"]["loaded"]
    assert made.facts["kernels"]["code"] != compiled.facts["kernels"]["code"]
    assert env is not GENERIC or not made.facts["kernels"]["ymm"]
    assert_same(made, compiled)
    figure("machines", f"same bytes in {len(contents(compiled.out))} files")


@pytest.fixture(scope="module")
def code(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return facts about the kernels' machine code; on an x86-64 it is compiled for AVX-512."""
    folder = tmp_path_factory.mktemp("code")
    other = {"NUMBA_CPU_NAME": "znver4", "NUMBA_CPU_FEATURES": ""} if platform.machine() == "x86_64" else {}
    done = run_process(
        sys.executable, SCRIPT, "code.json", "--code", cwd=folder, timeout=600, NUMBA_CACHE_DIR=str(folder), **other
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads((folder / "code.json").read_text(encoding="utf-8")))


@pytest.mark.slow
@pytest.mark.parametrize("target", ["Numba's own", *everywhere.TARGETS])
def test_no_kernel_contains_a_fused_multiply_add(target: str, code: dict[str, Any], figure: Figure) -> None:
    kernels, free_to_fuse = code["instructions"][target]
    if kernels is None:
        pytest.skip("this LLVM was built without that target")
    assert code["not compiled"] == []
    assert free_to_fuse["fused"]
    assert kernels == {"fused": [], "guessed": []}
    figure("machines", f"{len(kernels['fused'])} fused multiply-adds in the kernels for {target}")


@pytest.mark.slow
def test_kernels_call_only_exact_functions_without_fast_math(code: dict[str, Any]) -> None:
    kernels, free = code["fast-math flags"]
    assert free
    assert kernels == []
    called = {re.sub(r"^llvm\.|\.v?\d*f(?:32|64)$", "", name) for name in code["called"]}
    assert "sqrt" in called
    loads = {name for name in called if re.match(r"masked\.(load|gather)\.v\d+f(32|64)\.", name)}
    read = {"PyFloat_AsDouble", "PyNumber_Float"}  # arguments
    assert called - loads - read <= {"sqrt", "floor", "fabs"}


# Versions -------------------------------------------------------------------------------------------------------------


def pip(*arguments: str | Path) -> str:
    done = run_process(sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments, timeout=900)
    if done.returncode:
        pytest.fail(f"pip {arguments[0]} failed; this test needs a package index:\n{done.stdout}{done.stderr}")
    return done.stdout


def oldest(requirement: Requirement) -> str:
    """Return the oldest version that ``requirement`` allows and that has a wheel for this Python."""
    listed = pip("index", "versions", "--only-binary", ":all:", requirement.name)
    versions = re.findall(r"^Available versions: (.*)$", listed, re.MULTILINE)[0].split(", ")
    return f"{requirement.name}=={min(Version(one) for one in versions if one in requirement.specifier)}"


@pytest.mark.slow
@pytest.mark.parametrize("which", ["oldest", "newest"])
def test_library_versions_change_no_byte(which: str, make: Make, plain: Made, tmp_path: Path, figure: Figure) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = [Requirement(one) for one in project["dependencies"]]
    venv.create(tmp_path, with_pip=False, symlinks=True)
    python = tmp_path / "bin" / "python"
    pinned = [oldest(one) for one in requirements] if which == "oldest" else []
    pip("--python", python, "install", "--upgrade", "--upgrade-strategy", "eager", ROOT, *pinned)

    made = make(python, PYTHONPATH="")
    plainest = make(
        python,
        PYTHONPATH="",
        NPY_DISABLE_CPU_FEATURES=" ".join(made.facts["numpy"]),
        OPENCV_CPU_DISABLE=",".join(made.facts["opencv"]),
        OPENCV_IPP="disabled",
    )

    assert Path(made.facts["package"]).is_relative_to(tmp_path)
    assert {f"{name}=={version}" for name, version in made.facts["versions"].items()} >= {
        one for one in pinned if one.split("==")[0] in made.facts["versions"]
    }
    assert (plainest.facts["numpy"], plainest.facts["opencv"]) == ([], [])
    assert_same(made, plain)
    assert_same(plainest, plain)
    figure("machines", f"same bytes in {len(contents(plain.out))} files")
