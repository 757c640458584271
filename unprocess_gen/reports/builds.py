"""Read the benchmark builds of ``manifests/``, and compare datasets with them byte by byte.

recipes/NAME.yaml   title, purpose, photographs, and the settings of the command that makes the build
NAME.sha256         SHA-256 of every file except dataset.json and sweep.csv, as sha256sum prints it
NAME.csv            the rows of all manifests, in the order of NAME.sha256
"""

from __future__ import annotations

import posixpath
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import msgspec

from unprocess_gen.config.option_files import group_options, shipped_folder
from unprocess_gen.config.yaml_files import read_yaml_mapping
from unprocess_gen.core.errors import ConfigError, SourceChangedError
from unprocess_gen.core.files import file_sha256
from unprocess_gen.core.libraries import require
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.records import check_record
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.folder import REPORT
from unprocess_gen.pipeline.verify import Damage, verify

MANIFEST = "manifest.csv"

BESIDE = ("dataset.json", ".work", REPORT, "sweep.csv", "sweep.csv.lock")
"""Files in the folder of a build whose bytes are not compared."""

PHOTOGRAPHS_FROM = "scikit-image 0.24.0, 0.25.2 and 0.26.0"
"""Versions whose photographs have the recorded bytes."""


def manifests_dir() -> Path:
    """Folder of the benchmark builds."""
    return shipped_folder("manifests", "README.md")


def build_names() -> list[str]:
    """Names of the benchmark builds."""
    return group_options("recipes", manifests_dir())


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """File of a build: for people, a title and a purpose; settings, of which ``sweep`` has several values.

    ``photographs`` are files that scikit-image contains; without them the sources are synthetic pictures.
    """

    title: str
    purpose: str
    overrides: tuple[str, ...]
    sweep: tuple[str, ...] = ()
    photographs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Build:
    """A build: its name, its recipe, and the SHA-256 of its files by their paths below the folder of the build."""

    name: str
    recipe: Recipe
    digests: dict[str, str]

    @property
    def datasets(self) -> list[str]:
        """Folders of the datasets, in the order of the rows; an empty name if the build is one dataset."""
        return [posixpath.dirname(file) for file in self.digests if posixpath.basename(file) == MANIFEST]

    @property
    def rows_file(self) -> Path:
        """The file with the rows of all manifests."""
        return manifests_dir() / f"{self.name}.csv"

    def rows(self) -> list[Row]:
        """Read the rows of all manifests."""
        return list(read_rows(self.rows_file))

    def photographs_folder(self) -> Path | None:
        """Find scikit-image's folder of photographs; None if the build needs none.

        ConfigError if scikit-image is missing, SourceChangedError if a photograph has other bytes than recorded.
        """
        if not self.recipe.photographs:
            return None
        require("skimage", f"build {self.name}: the photographs need scikit-image", "photos")
        folder = Path(str(files("skimage") / "data"))
        for name, digest in {str(row["source"]): row["source_sha256"] for row in self.rows()}.items():
            actual = _digest_text(folder / name)
            if actual != digest:
                raise SourceChangedError(
                    f"build {self.name}: {folder / name}: its SHA-256 is {actual}; expected {digest}, as in "
                    f"{PHOTOGRAPHS_FROM}; install one of them"
                )
        return folder

    def check_folder(self, folder: Path, option: str) -> None:
        """Raise ConfigError if a folder cannot be written, or contains files that are no part of the build."""
        names = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
        own = {*BESIDE, *(file.partition("/")[0] for file in self.digests)}
        if foreign := [name for name in names if name not in own]:
            raise ConfigError(
                f"{option}: contains {foreign[0]}, which is no part of the build {self.name}; expected an empty "
                "folder, or one in which this build began; choose another folder"
            )
        if not names:
            check_output_folder(folder, option)

    def overrides(self, folder: Path, photographs: Path | None) -> list[str]:
        """Settings that make the build in a folder; settings of a sweep have several values."""
        source = []
        if photographs is not None:
            names = ",".join(self.recipe.photographs)
            source = [f"source.root={photographs}", f"source.include=[{names}]", "source.recursive=false"]
        return [*source, *self.recipe.overrides, *self.recipe.sweep, f"out={folder}"]

    def differences(self, folder: Path) -> Iterator[Damage]:
        """Yield each difference of finished datasets from the build: file, and in manifests key and column."""
        damaged = set()
        for dataset in self.datasets:
            for damage in verify(folder / dataset):
                damaged.add(posixpath.join(dataset, damage.file))
                yield replace(damage, file=posixpath.join(dataset, damage.file))
        if damaged:  # the files contradict each other
            return
        for file, digest in self.digests.items():
            actual = _digest_text(folder / file)
            if actual != digest and posixpath.basename(file) != MANIFEST:
                yield Damage(file, f"its SHA-256 is {actual}, that of the build is {digest}")
        yield from self._differing_cells(folder)

    def _differing_cells(self, folder: Path) -> Iterator[Damage]:
        rows = iter(self.rows())
        for dataset in self.datasets:
            file = posixpath.join(dataset, MANIFEST)
            for row in read_rows(folder / file):
                recorded, key = next(rows, {}), str(row["key"])
                if not recorded:
                    yield Damage(file, "is a row that the build lacks", key)
                    continue
                for column in (name for name in row if row[name] != recorded[name]):
                    yield Damage(file, f"is {row[column]}, that of the build is {recorded[column]}", key, column)
        for row in rows:
            yield Damage(self.rows_file.name, "is a row that the manifests lack", str(row["key"]))


def read_build(name: str) -> Build:
    """Read a build of ``manifests/``; ConfigError if it has none of this name."""
    names = build_names()
    if name not in names:
        raise ConfigError(
            f"build: {name}: no such build; expected one of {', '.join(names)}{did_you_mean(name, names)}"
        )
    path = manifests_dir() / "recipes" / f"{name}.yaml"
    try:
        recipe = check_record(read_yaml_mapping(path), Recipe)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    digests = manifests_dir() / f"{name}.sha256"
    lines = digests.read_text(encoding="utf-8").splitlines() if digests.exists() else []  # measure.py writes it
    return Build(name, recipe, {file: digest for digest, file in (line.split("  ", 1) for line in lines)})


def _digest_text(file: Path) -> str:
    """SHA-256 of a file, or that it is missing."""
    return file_sha256(file) if file.is_file() else "none, the file is missing"
