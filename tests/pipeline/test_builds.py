"""`gen-dataset build` makes the benchmark builds of manifests/, and says where a copy differs."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import text_rows

from unprocess_gen.config.option_files import build_names, manifests_dir
from unprocess_gen.core import libraries
from unprocess_gen.pipeline import builds

QUICK = ("scenes_patches",)


@pytest.mark.parametrize("name", slow_except(QUICK, build_names()))
def test_a_build_has_the_recorded_bytes(name: str, run_main: RunMain, tmp_path: Path) -> None:
    done = run_main("build", name, "--to", "built", "n_jobs=1")
    assert (done.code, done.out.startswith(f"built is the build {name}, bit for bit")) == (0, True), done
    assert run_main("build", name, "--to", "built").code == 0
    assert text_rows(tmp_path / "built")


def test_every_build_has_its_files_and_a_card() -> None:
    names = build_names()
    assert len(names) >= 10 and sum(name.startswith("photos_") for name in names) >= 2
    for name in names:
        assert {path.suffix for path in manifests_dir().glob(f"{name}.*")} == {".yaml", ".csv", ".sha256", ".md"}
        assert "| denoised |" in (manifests_dir() / f"{name}.md").read_text(encoding="utf-8")
        assert f"[{name}]({name}.md)" in (manifests_dir() / "README.md").read_text(encoding="utf-8")
    assert sum(path.stat().st_size for path in manifests_dir().iterdir()) < 250_000


def test_a_difference_is_named_with_exit_code_4(run_main: RunMain, tmp_path: Path) -> None:
    name = QUICK[0]
    run_main("build", name, "--to", "built", "n_jobs=1")
    shard, manifest = tmp_path / "built/shards/shard-00000.tar", tmp_path / "built/manifest.csv"
    content = bytearray(shard.read_bytes())
    content[1000] ^= 1
    shard.write_bytes(content)
    manifest.write_text(manifest.read_text().replace("RGGB", "BGGR", 1))
    found = [str(one) for one in builds.compare(name, tmp_path / "built")]
    assert any(text.startswith("manifest.csv: 00000000-p0000-l00d00: pattern is 'BGGR'") for text in found)
    assert any(text.startswith("shards/shard-00000.tar: 00000000-p0000.clean.npy: ") for text in found)
    manifest.write_text(manifest.read_text().replace("BGGR", "RGGB", 1))
    done = run_main("build", name, "--to", "built", "n_jobs=1")
    assert done.code == 4 and "differs from the build" in done.err


def test_wrong_calls_of_build_get_one_line(run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    listed = run_main("build", "--list")
    assert (listed.code, len(listed.out.splitlines())) == (0, len(build_names()))
    for call, problem in (
        (("build", "nope", "--to", "x"), "nope"),
        (("build", QUICK[0]), "--to FOLDER"),
        (("build", "--list", QUICK[0]), "takes neither"),
    ):
        done = run_main(*call)
        assert (done.code, done.err.count("\n"), problem in done.err) == (2, 1, True), done
    other = tmp_path / "data"
    other.mkdir()
    shutil.copy(builds.photographs() / "coffee.png", other / "astronaut.png")
    monkeypatch.setattr(builds, "photographs", lambda: other)
    done = run_main("build", "photos_imx385_iso3200", "--to", "x")
    assert (done.code, "other bytes" in done.err) == (5, True)
    monkeypatch.undo()
    monkeypatch.setattr(libraries, "find_spec", lambda name: None)
    done = run_main("build", "photos_imx385_iso3200", "--to", "x")
    assert (done.code, "pip install '.[photos]'" in done.err) == (2, True)
    assert not (tmp_path / "x").exists()
