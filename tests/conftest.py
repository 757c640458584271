"""What the tests share: a folder of photographs, a dataset made of it, and ways to the command line."""

from __future__ import annotations

import functools
import gc
import hashlib
import itertools
import os
import pickle
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import hydra
import hypothesis
import numpy as np
import pytest
from helpers import object_store as servers
from helpers.commands import COMMAND, Cli, Done, RunMain, run_process
from helpers.configs import composed
from helpers.datasets import Make, Settings
from helpers.photographs import pixels
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from PIL import Image

from unprocess_gen.cli import main as entry_point
from unprocess_gen.config.option_files import conf_dir
from unprocess_gen.config.schema import GROUPS, Config, replaced
from unprocess_gen.config.settings import settings_of
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core import object_store
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.pipeline import generate as runner
from unprocess_gen.sources import synthetic

_BUCKETS = itertools.count()

KEY = re.compile(rf"(({'|'.join(GROUPS)})(\.\w+)+|{'|'.join(settings_of(Config))})=")
"""Begin of an override that sets the value of a key."""

pytest_plugins = ["helpers.linux_only", "helpers.promise_report"]

# the same examples in every run, and none refused because the machine is busy; new examples with
# --hypothesis-profile=default
hypothesis.settings.register_profile(
    "tests", derandomize=True, deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("tests")

np.seterr(all="raise")  # in every test: no NaN, overflow, underflow or division by zero goes by unseen

# a shell's background job ignores SIGINT, and nohup ignores SIGHUP; the commands under test would ignore them too
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda number, frame: None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run benchmarks last: they use all kernels, which two processes would compile at the same time."""
    items.sort(key=lambda item: "benchmarks" in item.path.parts)


def pytest_collection_finish() -> None:
    """Exclude modules and collected tests from garbage collection, which takes a tenth of the time of compositions."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_sync() -> Iterator[None]:
    """Skip syncs to disk in this process: they take 5 ms each, 20 per dataset, and no test cuts the power.

    Runs in processes of their own do sync. `test_files_are_synced_before_their_rename` holds the order.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _pictures_drawn_once() -> Iterator[None]:
    """Draw each synthetic picture once in this process: it takes up to 0.5 s, and half of the datasets use one.

    Tests of the pictures import the function itself, before this fixture replaces it.
    """
    drawn = functools.cache(synthetic.picture)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "picture", lambda name: drawn(name).copy())
        yield


@pytest.fixture(scope="session", autouse=True)
def _composed_once() -> Iterator[None]:
    """Let Hydra compose equal choices of the package's options once, and set the values of keys in a copy.

    A composition takes 0.1 s. Those with other folders of options, and those that fail, are done each time.
    """
    compose, kept = hydra.compose, dict[tuple[str, ...], bytes]()

    def composed_once(name: str, overrides: list[str], **options: bool) -> Any:
        folders = [one.path for one in GlobalHydra.instance().config_loader().get_search_path().get_path()]
        added = any("searchpath" in one for one in overrides)
        if added or str(conf_dir()) not in folders or not options:
            return compose(name, overrides, **options)
        values = [one for one in overrides if KEY.match(one)]
        choices = [one for one in overrides if one not in values]
        key = (name, *folders, *choices)
        if key not in kept:
            kept[key] = pickle.dumps(compose(name, choices, return_hydra_config=True))
        node = pickle.loads(kept[key])
        try:
            parsed = OverridesParser.create().parse_overrides(values)
            assert not any(one.is_sweep_override() for one in parsed)
            ConfigLoaderImpl._apply_overrides_to_config(parsed, node)
        except (HydraException, AssertionError):
            return compose(name, overrides, **options)
        node.hydra.overrides.task = [one for one in overrides if not one.startswith("hydra")]
        node.hydra.runtime.cwd = str(Path.cwd())
        return node

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hydra, "compose", composed_once)
        yield


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of small photographs, `PHOTOS`, and a text file that no glob matches."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "sub").mkdir()
    image = Image.fromarray
    image(pixels(1, 9, 14)).save(folder / "=formula.png")
    image(pixels(2, 12, 12)).save(folder / "50%.png")
    image(pixels(3, 23, 37)).save(folder / "comma, and space.jpg", quality=95)
    cv2.imwrite(str(folder / "deep.png"), pixels(4, 11, 13, np.uint16))
    image(pixels(5, 21, 19)[..., 0]).save(folder / "gray.png")
    image(pixels(6, 1, 1)).save(folder / "one.png")
    image(pixels(7, 15, 25)).save(folder / "scan.tif", compression="tiff_lzw")
    image(pixels(8, 3, 40)).save(folder / "strip.bmp")
    image(pixels(9, 16, 16)).save(folder / "sub" / "inner one.jpg")
    image(pixels(10, 17, 18)).save(folder / "sub" / "été.png")
    exif = Image.Exif()
    exif[0x0112] = 6
    image(pixels(11, 16, 24)).save(folder / "turned.jpg", exif=exif)
    image(pixels(12, 20, 22)).save(folder / "web.webp", lossless=True)
    image(pixels(13, 17, 131)).save(folder / "wide.png")
    (folder / "notes.txt").write_text("not a photograph")
    return folder


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """Return the endpoint of an S3 server."""
    pytest.importorskip("obstore")
    with servers.serving(servers.s3_application()) as endpoint:
        yield endpoint


@pytest.fixture
def s3(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Let this process, and those that it starts, use the S3 server; return its endpoint."""
    servers.use(monkeypatch, s3_server)
    return s3_server


@pytest.fixture
def proxy(s3: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[servers.Proxy]:
    """Return a proxy in front of the S3 server, which this process and those that it starts use."""
    proxy = servers.Proxy(servers.s3_application(), s3)
    with servers.serving(proxy) as proxy.endpoint:
        servers.use(monkeypatch, proxy.endpoint)
        yield proxy
    object_store._store.cache_clear()


@pytest.fixture
def bucket(s3: str) -> ObjectPath:
    """Return the URL of an empty bucket."""
    return servers.create_bucket(s3, f"bucket-{next(_BUCKETS):04d}")


@pytest.fixture(scope="session")
def settings() -> Settings:
    """Return a function that builds a config from overrides, without validating it."""
    return composed


@pytest.fixture(scope="session")
def make(settings: Settings) -> Make:
    """Return a function that makes a dataset in this process: source folder (None: scenes), out, overrides."""

    def made(root: Path | None, out: Path, *overrides: str, n_jobs: int = 1) -> runner.Summary:
        config = settings(*overrides)
        config = replaced(
            config, {"source.root": None if root is None else str(root), "out": str(out), "n_jobs": n_jobs}
        )
        validate_config(config)
        return runner.generate(config)

    return made


@pytest.fixture(scope="session")
def dataset(photos: Path, make: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished dataset of `photos`: 13 pairs in three shards. Tests read it and leave it as it is."""
    out = tmp_path_factory.mktemp("made") / "ds"
    make(photos, out, "output.pairs_per_shard=5")
    return out


def _tree_hash(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted([folder / "manifest.csv", folder / "config.yaml", *(folder / "shards").rglob("*")]):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(folder)}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()


@pytest.fixture(scope="session")
def tree_hash() -> Callable[[Path], str]:
    """Return a function that hashes what a dataset's data are: names and bytes of shards, manifest and config."""
    return _tree_hash


@pytest.fixture
def cli(tmp_path: Path) -> Cli:
    """Return a function that runs ``gen-dataset`` in its own process, in ``tmp_path`` by default."""

    def called(*arguments: object, cwd: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
        return run_process(COMMAND, *arguments, cwd=cwd or tmp_path, **env)

    return called


@pytest.fixture
def run_main(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[RunMain]:
    """Return a function that calls the command line's `main` in this process, in ``tmp_path``: quicker than `cli`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def called(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["gen-dataset", *map(str, arguments)])
        capfd.readouterr()
        try:
            code = entry_point.main()
        except SystemExit as error:  # argparse, below Hydra
            code = int(error.code or 0)
        return Done(code, *capfd.readouterr())

    yield called
    for number, handler in before.items():
        signal.signal(number, handler)
