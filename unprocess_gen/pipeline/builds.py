"""Make the benchmark builds of ``manifests/``, and compare every byte with what is recorded there.

NAME.yaml      config.yaml of the dataset
NAME.csv       its manifest, which pins the sources by their SHA-256
NAME.sha256    SHA-256 of config, manifest and shards, as sha256sum prints them
NAME.md        card: the purpose in its third line, and scores
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path

from unprocess_gen.config.option_files import manifests_dir
from unprocess_gen.config.schema import replaced
from unprocess_gen.config.serialization import differences, read_dataset_yaml
from unprocess_gen.core.errors import SourceChangedError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.libraries import require
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.types import Row
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.dataset.shards import check_members, shard_name
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.pipeline.verify import Damage, expected_samples, shard_rows
from unprocess_gen.sources.reading import source_file

FOLDER = "folder"
"""Kind of source of builds from the photographs that scikit-image contains."""


def purpose(name: str) -> str:
    """Return the sentence of a card that says what a build is for."""
    return (manifests_dir() / f"{name}.md").read_text(encoding="utf-8").splitlines()[2]


def photographs() -> Path:
    """Return the folder of the photographs that scikit-image contains; ConfigError without the package."""
    require("skimage", "build: scikit-image is missing", "photos")
    found = find_spec("skimage")
    assert found is not None and found.origin is not None
    return Path(found.origin).parent / "data"


def make_build(name: str, to: str, n_jobs: int = -1) -> list[Damage]:
    """Generate a build, or resume it, and return its differences from what is recorded.

    Parameters
    ----------
    name : str
        One of `option_files.build_names`.
    to : str
        Folder of the dataset, as ``out``.
    n_jobs : int
        Number of worker processes; -1: all cores.

    Raises
    ------
    ConfigError
        As `generate`, and if scikit-image is missing.
    SourceChangedError
        If a photograph is missing or has other bytes than the recorded ones.
    """
    config, kind = read_dataset_yaml(manifests_dir() / f"{name}.yaml")
    root = photographs() if kind == FOLDER else None
    if root is not None:
        _check_sources(name, root)
    generate(replaced(config, {"out": to, "n_jobs": n_jobs, "source.root": None if root is None else str(root)}))
    return [*compare(name, Path(to))]


def _check_sources(name: str, root: Path) -> None:
    recorded = {str(row["source"]): row["source_sha256"] for row in read_rows(manifests_dir() / f"{name}.csv")}
    for source, sha256 in recorded.items():
        path = source_file(str(root), source)
        if not path.exists() or file_sha256(path) != sha256:
            raise SourceChangedError(
                f"build {name}: {path} is missing or has other bytes; expected the SHA-256 {sha256}; install the "
                "version of scikit-image that manifests/README.md names"
            )


def compare(name: str, folder: Path) -> Iterator[Damage]:
    """Yield the differences of a dataset from a build: by key of settings, by cell, and by member of a shard."""
    place = manifests_dir()
    lines = (place / f"{name}.sha256").read_text(encoding="ascii").splitlines()
    expected = {file: digest for digest, file in (line.split("  ") for line in lines)}
    found = {f"shards/{path.name}" for path in (folder / "shards").iterdir()}
    yield from (Damage(file, "is no part of the build") for file in sorted(found - expected.keys()))
    rows = dict(shard_rows(any_path(place / f"{name}.csv")))
    for file, digest in expected.items():
        if not (folder / file).is_file():
            yield Damage(file, "is missing")
        elif (sha256 := file_sha256(folder / file)) != digest:
            yield Damage(file, f"its SHA-256 is {sha256}, the build has {digest}")
            if file == "config.yaml":
                old, new = (path.read_text(encoding="utf-8") for path in (place / f"{name}.yaml", folder / file))
                yield from (Damage(file, what) for what in differences(new, old))
            elif file == "manifest.csv":
                yield from _cells(place / f"{name}.csv", folder / file)
            else:
                number = next(number for number in rows if file == f"shards/{shard_name(number)}")
                members = check_members(folder / file, expected_samples(rows[number]))
                yield from (Damage(file, what, key, member) for key, member, what in members)


def _cells(old: Path, new: Path) -> Iterator[Damage]:
    """Yield the cells of a manifest that differ; of a row that is missing, its key."""
    none: Row = {}
    for row, other in zip_longest(read_rows(any_path(old)), read_rows(any_path(new)), fillvalue=none):
        key = str((row or other)["key"])
        for column in row.keys() | other.keys():
            if row.get(column) != other.get(column):
                yield Damage(
                    "manifest.csv", f"{column} is {other.get(column)!r}, the build has {row.get(column)!r}", key
                )
