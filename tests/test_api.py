"""The Python API: pairs from arrays, datasets, errors, lazy imports, and use inside a Hydra application."""

from __future__ import annotations

import dataclasses
import pickle
import signal
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.commands import run_process
from helpers.datasets import Make
from helpers.photographs import fill, pixels
from PIL import Image

import unprocess_gen as ug
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.row import COLUMN_NAMES, plan_from_row
from unprocess_gen.simulation.pair import make_pair as make_inner_pair
from unprocess_gen.sources.loader import downscaled

ROOT = Path(__file__).parents[1]
SRGB = pixels(3, 40, 50)


@pytest.fixture(scope="module")
def config() -> ug.Config:
    return ug.load_config(["camera=sony_a7r", "noise=imx385_iso3200"])


# Exports --------------------------------------------------------------------------------------------------------------


def test_exported_names_exist_and_are_those_of_dir() -> None:
    assert dir(ug) == sorted(ug.__all__)
    assert all(getattr(ug, name) is not None for name in ug.__all__)


def test_overrides_instead_of_a_config_are_a_type_error() -> None:
    for call in (ug.generate, lambda overrides: ug.make_pair(SRGB, overrides)):
        with pytest.raises(TypeError, match=r"^config=\['seed=1'\]: is of type list; expected a Config; make it with "):
            call(["seed=1"])


def test_raw_pairs_needs_no_library_of_generation(dataset: Path, tmp_path: Path) -> None:
    code = f"""
        import sys
        for name in ("fcntl", "numba", "llvmlite", "hydra", "omegaconf", "cv2", "yaml", "joblib", "tqdm"):
            sys.modules[name] = None
        from unprocess_gen import RawPairs
        pairs = RawPairs({str(dataset)!r})
        print(len(pairs), pairs[0].clean.dtype, pairs[1:3][1].row["key"])
    """
    done = run_process(sys.executable, "-c", textwrap.dedent(code), cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert (done.stdout, done.stderr) == ("13 uint16 00000002\n", "")


# Pairs from arrays ----------------------------------------------------------------------------------------------------


def test_pair_of_an_array_is_the_pair_of_its_plan(config: ug.Config) -> None:
    pair = ug.make_pair(SRGB, config)
    expected = make_inner_pair(SRGB, ug.plan_image(SRGB, config))
    assert (pair.clean.dtype, pair.clean.shape) == (np.dtype(np.uint16), (40, 50))
    assert np.array_equal(pair.clean, expected.clean)
    assert np.array_equal(pair.noisy, expected.noisy)
    assert pair.counts == expected.counts
    assert pair.plan == ug.plan_image(SRGB, config)


def test_row_is_a_manifest_row_of_the_pair(config: ug.Config) -> None:
    pair = ug.make_pair(SRGB, config)
    assert list(pair.row) == list(COLUMN_NAMES)
    assert pair.row is pair.row
    assert plan_from_row(pair.row) == pair.plan
    assert (pair.row["clean_xxh3"], pair.row["noisy_xxh3"]) == (array_xxh3(pair.clean), array_xxh3(pair.noisy))
    assert (pair.row["height"], pair.row["width"], pair.row["status"]) == (40, 50, "ok")


def test_layout_and_byte_order_in_memory_do_not_matter(config: ug.Config) -> None:
    deep = SRGB.astype(np.uint16) * 257
    for array, other in ((SRGB, np.asfortranarray(SRGB.copy())), (deep, deep.astype(">u2"))):
        first, second = ug.make_pair(array, config), ug.make_pair(other, config)
        assert np.array_equal(first.noisy, second.noisy)
        assert first.row == second.row


def test_other_pixels_shape_dtype_seed_or_key_give_other_streams(config: ug.Config) -> None:
    changed = SRGB.copy()
    changed[0, 0, 0] ^= 1
    plans = [
        ug.plan_image(SRGB, config),
        ug.plan_image(changed, config),
        ug.plan_image(SRGB.reshape(50, 40, 3), config),
        ug.plan_image(SRGB.astype(np.uint16), config),
        ug.plan_image(SRGB, config, seed=1),
        ug.plan_image(SRGB, config, key="another"),
        ug.plan_image(SRGB, config, key=5),
    ]
    assert len({plan.stream_key for plan in plans}) == len(plans)


def test_digest_of_a_source_as_key_gives_its_pair(make: Make, tmp_path: Path) -> None:
    make(fill(tmp_path / "p", 2), tmp_path / "ds", "noise=sony_a7s2", "seed=5")
    config = ug.load_config(["noise=sony_a7s2", "seed=5"])
    for sample in ug.RawPairs(tmp_path / "ds"):
        srgb = np.asarray(Image.open(tmp_path / "p" / sample.row["source"]))
        pair = ug.make_pair(srgb, config, key=sample.row["source_sha256"])
        assert np.array_equal(pair.noisy, sample.noisy)
        assert pair.row["source_sha256"] == sample.row["source_sha256"]


def test_downscale_is_applied_for_configs_and_plans() -> None:
    config = ug.load_config(["source.downscale=3"])
    plan = ug.plan_image(SRGB, config)
    expected = make_inner_pair(downscaled(SRGB, 3), plan)
    for pair in (ug.make_pair(SRGB, config), ug.make_pair(SRGB, plan)):
        assert np.array_equal(pair.noisy, expected.noisy)
        assert (pair.row["downscale"], pair.row["height"], pair.row["width"]) == (3, 13, 16)


def test_root_limit_and_clips_are_ignored(config: ug.Config, tmp_path: Path) -> None:
    source = dataclasses.replace(config.source, root=str(tmp_path / "nowhere"), limit=1, clips=True)
    other = dataclasses.replace(config, source=source)
    assert np.array_equal(ug.make_pair(SRGB, other).noisy, ug.make_pair(SRGB, config).noisy)


def test_packed_frames_leave_out_the_last_odd_row_and_column() -> None:
    config = ug.load_config(["output.layout=packed", "output.dtype=float32"])
    pair = ug.make_pair(SRGB[:39, :49], config)
    assert (pair.clean.shape, pair.clean.dtype) == ((4, 19, 24), np.dtype(np.float32))
    assert (pair.row["height"], pair.row["width"]) == (38, 48)
    assert ug.develop(pair.clean, pair.row).shape == (38, 48, 3)


# Refused --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("srgb", [SRGB / 255, SRGB[..., 0], SRGB.astype(np.int16), SRGB[:0]])
def test_other_arrays_are_value_errors(srgb: Any, config: ug.Config) -> None:
    with pytest.raises(ValueError, match=r"srgb is .*expected"):
        ug.make_pair(srgb, config)


@pytest.mark.parametrize(
    ("overrides", "problem"),
    [
        (["source.patch=32"], r"source\.patch=32: .*expected null"),
        (["source.downscale=60"], r"srgb is \[.*expected at least"),
        (["output.layout=packed", "source.downscale=40"], r"srgb is \[.*expected at least"),
        (["noise=imx385", "noise.levels=[1600,6400]"], r"noise\.levels=.*: 2 pairs of an image; expected one; call"),
        (["noise.draws=2"], r"noise\.draws=.*: 2 pairs of an image; expected one; call make_pair once"),
    ],
)
def test_configs_that_do_not_give_one_pair_are_refused(overrides: list[str], problem: str) -> None:
    for function in (ug.make_pair, ug.plan_image):
        with pytest.raises(ug.ConfigError, match=problem):
            function(SRGB, ug.load_config(overrides))


@pytest.mark.parametrize("call", [lambda config: ug.plan_image(SRGB, config), ug.generate])
def test_incomplete_config_is_refused_with_advice(call: Callable[[ug.Config], object]) -> None:
    with pytest.raises(ug.ConfigError, match=r"noise\.units=null: .*unprocess_gen\.load_config"):
        call(ug.Config())


@pytest.mark.parametrize("option", [{"seed": 1}, {"key": "x"}])
def test_seed_and_key_are_refused_with_a_plan(option: dict[str, Any], config: ug.Config) -> None:
    with pytest.raises(ug.ConfigError, match="a plan has its own seed and key"):
        ug.make_pair(SRGB, ug.plan_image(SRGB, config), **option)


# Develop --------------------------------------------------------------------------------------------------------------


def test_developed_clean_frame_resembles_the_photograph() -> None:
    config = ug.load_config(["noise=none", "gains=unity", "camera=identity"])
    y, x = np.mgrid[0:60, 0:80]
    srgb = np.stack([40 + x, 200 - y, 60 + (x + y) // 2], axis=-1).astype(np.uint8)
    pair = ug.make_pair(srgb, config)
    for row in (pair.row, pair.plan):
        developed = ug.develop(pair.clean, row)
        assert (developed.dtype, developed.shape) == (np.dtype(np.uint8), (60, 80, 3))
        assert np.abs(developed.astype(int) - srgb)[2:-2, 2:-2].max() <= 3


LIGHT = r"raw is float32; expected uint16, .* np\.rint\(light \* \(white - black\)"


@pytest.mark.parametrize(
    ("call", "error", "problem"),
    [
        (lambda pair: ug.develop(pair.noisy, {"key": "00000000"}), ug.DamageError, "not a plan"),
        (lambda pair: ug.develop(SRGB, pair.row), ValueError, "raw has 3 dimensions, expected 2 for layout=mosaic"),
        (lambda pair: ug.develop(ug.to_light(pair.noisy, pair.row), pair.row), ValueError, LIGHT),
        (lambda pair: ug.develop(pair.row, pair.noisy), TypeError, r"row is ndarray; .*: develop\(raw, row\)"),
    ],
    ids=["no row of a pair", "another layout", "light", "swapped"],
)
def test_wrong_frames_and_rows_are_refused(
    call: Callable[[ug.RawPair], object], error: type[Exception], problem: str, config: ug.Config
) -> None:
    with pytest.raises(error, match=problem):
        call(ug.make_pair(SRGB, config))


# Datasets -------------------------------------------------------------------------------------------------------------


def test_generate_verify_and_replay(tmp_path: Path) -> None:
    photos, out = fill(tmp_path / "p", 3), tmp_path / "ds"
    config = ug.load_config([f"source.root={photos}", f"out={out}", "n_jobs=1", "output.pairs_per_shard=2"])
    summary = ug.generate(config)
    assert (summary.pairs, summary.failed, summary.shards) == (3, {}, 2)
    assert ug.verify(out) == []
    assert [one.key for one in ug.replay(out, keys=[2, "0-1"])] == ["00000000", "00000001", "00000002"]
    (one,) = ug.replay(str(out / "manifest.csv"), keys="1", to=tmp_path / "to")
    assert (one.source, one.complaint) == ("001.png", "")
    assert np.array_equal(np.load(tmp_path / "to" / "00000001.noisy.npy"), ug.RawPairs(out)[1].noisy)

    shard = out / "shards" / "shard-00000.tar"
    shard.write_bytes(shard.read_bytes()[:-1024] + b"x" * 1024)
    assert [damage.file for damage in ug.verify(out)] == ["shards/shard-00000.tar"]


@pytest.mark.linux_only("names signals that Windows lacks")
@pytest.mark.parametrize("n_jobs", [1, 2])
def test_functions_leave_signals_threads_and_streams_alone(
    n_jobs: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def state() -> list[object]:
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE)
        return [cv2.getNumThreads(), *(signal.getsignal(number) for number in numbers)]

    threads = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        before = state()
        settings = ["source.limit=2", "output.pairs_per_shard=1", f"out={tmp_path / 'ds'}", f"n_jobs={n_jobs}"]
        ug.generate(ug.load_config(settings))
        ug.verify(tmp_path / "ds")
        ug.replay(tmp_path / "ds")
        ug.make_pair(SRGB, ug.load_config())
        assert state() == before
    finally:
        cv2.setNumThreads(threads)
    assert capfd.readouterr() == ("", "")


def test_errors_survive_pickling() -> None:
    error = pickle.loads(pickle.dumps(ug.ConfigError("seed=-1: expected 0 or more")))
    assert (str(error), error.exit_code) == ("seed=-1: expected 0 or more", 2)


APPLICATION = """
    import hydra
    import numpy as np
    import unprocess_gen as ug
    from hydra.core.hydra_config import HydraConfig

    @hydra.main(version_base="1.3", config_path="conf", config_name="own")
    def application(own):
        config = ug.load_config(["camera=sony_a7r", f"seed={own.number}"])
        pair = ug.make_pair(np.full((4, 4, 3), 99, np.uint8), config)
        summary = ug.generate(ug.load_config(["source.limit=1", "n_jobs=1", "out=ds"]))
        print(pair.row["camera"], pair.row["seed"], summary.pairs, HydraConfig.get().job.config_name)

    application()
"""


def test_everything_works_inside_a_hydra_application(tmp_path: Path) -> None:
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "own.yaml").write_text("number: 6\nhydra:\n  run:\n    dir: .\n  output_subdir: null\n")
    script = tmp_path / "application.py"
    script.write_text(textwrap.dedent(APPLICATION))
    done = run_process(sys.executable, script, cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert done.stdout.splitlines()[-1:] == ["sony_a7r 6 1 own"], done.stderr
    assert [row["status"] for row in read_rows(tmp_path / "ds" / "manifest.csv")] == ["ok"]
