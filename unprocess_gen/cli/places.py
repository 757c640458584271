"""Find the datasets and folders that a command line names, and refuse others in one line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unprocess_gen.cli.arguments import Call
from unprocess_gen.core.errors import ConfigError

if TYPE_CHECKING:
    from unprocess_gen.core.paths import AnyPath
    from unprocess_gen.dataset.dataset_json import Places


def dataset_folder(call: Call, *, files: bool = False, sweeps: bool = False) -> AnyPath:
    """Check and return the verb's dataset; refuse anything else, and for a sweep name one of its datasets.

    ``files`` accepts the file of a manifest too, ``sweeps`` the folder of a sweep.
    """
    from unprocess_gen.core.output_paths import DATASET_ENTRIES

    verb, path, place = call.verb.name, call.place, call.verb.place
    assert path is not None and place is not None
    if not path.is_listed():
        kind = "file or folder" if files else "folder"
        raise ConfigError(f"{verb}: {path}: no such {kind}; expected {place.expected}")
    if not path.is_dir():
        if files:
            return path
        raise ConfigError(f"{verb}: {path}: is a file; expected {place.expected}")
    is_sweep = (path / "sweep.csv").is_file()
    if not is_sweep and not any((path / name).exists() for name in DATASET_ENTRIES):
        raise ConfigError(f"{verb}: {path}: not a dataset; expected {place.expected}")
    if is_sweep and not sweeps and not (path / "dataset.json").exists():
        datasets = sorted(str(path / name) for name in path.entries() if (path / name / "dataset.json").is_file())
        example = f", such as {datasets[0]}" if datasets else ""
        raise ConfigError(f"{verb}: {path}: is the folder of a sweep; expected one of its datasets{example}")
    return path


def given_root(call: Call) -> str | None:
    """Root that the user gives, None if none is given; ConfigError if it is no folder or photograph."""
    from unprocess_gen.sources.listing import single_file

    root = call.settings.get("source.root")
    if root is not None:
        single_file(root)
    return root


def given_places(folder: AnyPath, call: Call) -> Places:
    """Places of sources and dark frames of a dataset, by the call or by ``dataset.json``."""
    from unprocess_gen.dataset.dataset_json import recorded_places

    return recorded_places(folder, given_root(call), call.settings.get("noise.dark_frames"))
