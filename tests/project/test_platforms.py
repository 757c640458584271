"""Other systems, imitated on Linux: datasets of the same bytes without flock, mallopt, SIGHUP and folder handles."""

from __future__ import annotations

import json
import ntpath
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
from helpers.datasets import Make
from helpers.photographs import pixels

from unprocess_gen.core import files

SCRIPT = """
import json, sys
from helpers.other_systems import imitate

system, root, out = sys.argv[1:]
imitate(system)
from pathlib import Path
import numpy as np
import unprocess_gen as ug
from unprocess_gen.cli.main import main
from unprocess_gen.core.locks import LockFile

def gen_dataset(*arguments):
    sys.argv[1:] = arguments
    return main()

def flip(path):
    data = bytearray(path.read_bytes())
    data[2000] ^= 1
    path.write_bytes(data)

out = Path(out)
config = ug.load_config([f"source.root={root}", f"out={out}", "n_jobs=1", "output.pairs_per_shard=1"])
found = {"pairs": ug.generate(config).pairs, "damage": len(ug.verify(out)), "read": len(ug.RawPairs(out))}
found["mean"] = int(ug.make_pair(np.zeros((8, 8, 3), np.uint8), ug.load_config(["noise=none"])).noisy.mean())
flip(out / "shards" / "shard-00001.tar")
found["verify"] = gen_dataset("verify", str(out))
found["repair"] = gen_dataset("verify", str(out), "--repair")
found["after"] = len(ug.verify(out))
found["sweep"] = gen_dataset("-m", "seed=1,2", f"source.root={root}", f"out={out}-sweep", "n_jobs=1", "source.limit=1")
found["swept"] = len(ug.RawPairs(f"{out}-sweep"))
(out / ".work").mkdir()
lock = LockFile(out / ".work" / "lock")
lock.acquire(wait=False)
found["locked"] = gen_dataset(f"source.root={root}", f"out={out}", "n_jobs=1", "output.pairs_per_shard=1")
lock.release()
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def nested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three photographs, one of them two folders deep."""
    folder = tmp_path_factory.mktemp("nested")
    for number, name in enumerate(("a.png", "b/c.png", "b/d/e.png")):
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), pixels(number, 24, 32))
    return folder


@pytest.mark.parametrize("system", [pytest.param("darwin", marks=pytest.mark.slow), "win32"])
def test_imitated_system_gives_the_bytes_of_linux(
    system: str, nested: Path, make: Make, tree_hash: Callable[[Path], str], tmp_path: Path
) -> None:
    make(nested, tmp_path / "linux", "output.pairs_per_shard=1")
    command = [sys.executable, "-c", SCRIPT, system, str(nested), str(tmp_path / "other")]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "pairs": 3,
        "damage": 0,
        "read": 3,
        "mean": 240,
        "verify": 4,
        "repair": 0,
        "after": 0,
        "sweep": 0,
        "swept": 2,
        "locked": 11,
    }
    assert tree_hash(tmp_path / "other") == tree_hash(tmp_path / "linux")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["linux", "other", "other-sweep"]


@pytest.mark.slow
@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_types_are_correct_on_other_systems(system: str) -> None:
    """Mypy skips branches for other systems, and knows which modules, functions and constants a system lacks."""
    command = [sys.executable, "-m", "mypy", "--platform", system]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("path", ["/a", "../a", "a/../../b", "C:/a", "C:a", "..\\a", "\\a", "//server/share/a"])
def test_paths_that_lead_outside_on_windows_are_found(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "os", SimpleNamespace(path=ntpath, sep="\\"))
    assert files.leads_outside(path)
    assert not files.leads_outside("folder/..a/photo.png")


@pytest.mark.parametrize("path", ["C:/a", "..\\a", "\\a"])
def test_names_with_backslashes_and_colons_are_inside_on_linux(path: str) -> None:
    assert not files.leads_outside(path)
