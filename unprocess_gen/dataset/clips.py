"""Read the clips of a dataset: all frames of a clip as one array."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import Frame
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.reader import DatasetPath, RawPairs


class _Frames(NamedTuple):
    clean: Frame
    noisy: Frame
    rows: list[dict[str, Any]]


class Clip(_Frames):
    """One clip of a dataset: ``clean, noisy, rows = clip``.

    Attributes
    ----------
    clean, noisy : ndarray, [T, H, W]
        Frames in order, as in `Sample`; packed planes are [T, 4, H / 2, W / 2].
    rows : list of dict
        Manifest row of each frame.
    dataset : str
        Name of the dataset, as in `Sample`.
    targets : dict of str to ndarray
        Stored targets by name, with T as first axis; of a burst those of its first frame.
    """

    dataset: str
    targets: Mapping[str, NDArray[Any]] = MappingProxyType({})

    def __new__(cls, frames: Sequence[Any]) -> Self:
        """Stack the samples of a clip."""
        clean, noisy = (np.stack([getattr(frame, name) for frame in frames]) for name in ("clean", "noisy"))
        clip = super().__new__(cls, clean, noisy, [frame.row for frame in frames])
        clip.dataset = frames[0].dataset
        targets = frames[0].targets
        if clip.rows[0]["motion_y"] is None:
            targets = {name: np.stack([frame.targets[name] for frame in frames]) for name in targets}
        clip.targets = targets
        return clip

    @property
    def target(self) -> NDArray[Any] | None:
        """Stored ``linear_rgb``, or None.

        Of a burst, float32 [s H, s W, 3] with s = ``burst_downscale``: the light of its first frame before it was
        averaged, exposed and clipped.
        """
        return self.targets.get(LINEAR_RGB)

    def __repr__(self) -> str:
        name, frames = self.rows[0]["clip"], self.noisy
        return f"Clip({frames.dtype} {list(frames.shape)}, clip={name}, dataset={self.dataset!r})"


class RawClips:
    """Read the clips of a dataset by number: a map-style dataset.

    ``clips[i]`` is a `Clip`. A clip with several noise levels, draws or patches is an item for each of them, in the
    order of the manifest. Frames that failed are missing; the column ``frame`` of the rows numbers the others. An
    instance can be pickled and forked as `RawPairs`.

    Parameters
    ----------
    path : str or Path, or a list of them
        As for `RawPairs`.
    split : str, optional
        Only clips of this split, by default all.

    Raises
    ------
    ConfigError
        As `RawPairs`; if there are no clips; or the frames of a clip differ in size, when it is read.
    DamageError
        As `RawPairs`.
    IndexError
        If a number is out of range.

    Examples
    --------
    >>> import unprocess_gen as ug
    >>> settings = ["source.clips=true", "source.limit=16", "out=clips", "n_jobs=1"]
    >>> _ = ug.generate(ug.load_config(settings))
    >>> clips = ug.RawClips("clips")
    >>> len(clips), clips[0].noisy.shape[0], clips[1].rows[7]["frame"]
    (2, 8, 7)
    """

    def __init__(self, path: DatasetPath | Sequence[DatasetPath], *, split: str | None = None) -> None:
        self._pairs = RawPairs(path, split=split)
        self.path = self._pairs.path
        datasets = enumerate(self._pairs._datasets)
        rows = ((dataset, row) for dataset, pairs in datasets for _, row in pairs.pair_rows(split))
        clips: dict[tuple[Any, ...], list[int]] = {}
        for number, (dataset, row) in enumerate(rows):
            if row["clip"]:
                place = dataset, row["clip"], row["patch"], row["level"], row["draw"]
                clips.setdefault(place, []).append(number)
        if not clips:
            raise ConfigError(
                f"RawClips: {path}: has no clips; expected a dataset of source.clips=true or source.burst; use RawPairs"
            )
        self._clips = [np.array(numbers) for numbers in clips.values()]

    def __len__(self) -> int:
        return len(self._clips)

    def __repr__(self) -> str:
        return f"RawClips({str(self.path)!r}, length={len(self)})"

    def __iter__(self) -> Iterator[Clip]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: SupportsIndex) -> Clip:
        frames = [self._pairs[frame] for frame in self._clips[operator.index(number)]]
        shapes = {frame.noisy.shape for frame in frames}
        if len(shapes) > 1:
            sizes = " and ".join(map(str, sorted(shapes)))
            name = frames[0].row["clip"]
            raise ConfigError(f"RawClips: clip {name} has frames of {sizes}; expected one size; use RawPairs")
        return Clip(frames)
