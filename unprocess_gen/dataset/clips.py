"""Read the clips of a dataset: all frames of a clip as one array."""

from __future__ import annotations

import operator
from collections import namedtuple
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Self, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import PACKED, Frame
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.development import development_parameters
from unprocess_gen.dataset.inputs import Options, stackable_row
from unprocess_gen.dataset.keys import clip_identity
from unprocess_gen.dataset.reader import DatasetPath, RawPairs, Sample


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
        Stored targets by name, with T as first axis; for a burst, the targets of its first frame.
    """

    dataset: str
    targets: Mapping[str, NDArray[Any]]

    def __new__(
        cls,
        clean: Frame,
        noisy: Frame,
        rows: list[dict[str, Any]],
        dataset: str = "",
        targets: Mapping[str, NDArray[Any]] = MappingProxyType({}),
    ) -> Self:
        """Make the tuple, and set its other attributes."""
        clip = super().__new__(cls, clean, noisy, rows)
        clip.dataset, clip.targets = dataset, dict(targets)
        return clip

    @property
    def target(self) -> NDArray[Any] | None:
        """Stored ``linear_rgb``, or None.

        For a burst, float32 [s H, s W, 3] with s = ``burst_downscale``: the light of its first frame before it was
        averaged, exposed and clipped.
        """
        return self.targets.get(LINEAR_RGB)

    def __repr__(self) -> str:
        name, frames = self.rows[0]["clip"], self.noisy
        return f"Clip({frames.dtype} {list(frames.shape)}, clip={name}, dataset={self.dataset!r})"


_Batch = namedtuple("_Batch", "clean noisy rows targets")

MOTION = "motion_yy", "motion_yx", "motion_y", "motion_xy", "motion_xx", "motion_x"
"""Columns of the motion of a burst's frame."""


def clip_item(samples: Sequence[Any], options: Options, columns: Sequence[Row] = ()) -> Any:
    """Convert the cropped frames of a clip to a `Clip`, or with ``inputs`` to a dict of arrays [T, …].

    The dict of a burst has ``motion`` [T, 6], and the target of the first frame. ``columns`` are those of the rows that
    this takes; without them, it reads the rows.
    """
    columns, first = columns or [sample.row for sample in samples], samples[0]
    is_burst = columns[0]["motion_y"] is not None
    targets = first.targets
    if options.inputs is None:
        if not is_burst:
            targets = {name: np.stack([sample.targets[name] for sample in samples]) for name in targets}
        clean, noisy = (np.stack([getattr(sample, name) for sample in samples]) for name in ("clean", "noisy"))
        return Clip(clean, noisy, [sample.row for sample in samples], first.dataset, targets)
    development = development_parameters(first.row)  # of all frames, which have one camera
    items = [
        options.item(_without_targets(sample) if is_burst else sample, row, (0, 0), lambda: development)
        for sample, row in zip(samples, columns, strict=True)
    ]
    item = _stacked([{name: item[name] for name in item if name != "development"} for item in items])
    item["development"] = development
    item["frame"] = np.array([row["frame"] for row in columns])
    if is_burst:
        item["motion"] = np.array([[row[name] for name in MOTION] for row in columns])
        scale = int(columns[0]["burst_downscale"] or 1) * (2 if options.inputs == PACKED else 1)
        height, width = (length * scale for length in item["noisy"].shape[-2:])  # planes leave out an odd row
        item |= {name: np.require(target[:height, :width], requirements=["C", "W"]) for name, target in targets.items()}
    return item


def _without_targets(sample: Any) -> Sample:
    return Sample(sample.clean, sample.noisy, sample.row, sample.dataset)


def _stacked(items: Sequence[Any]) -> Any:
    """Stack the values of equal names; texts become a list."""
    if isinstance(items[0], dict):
        return {name: _stacked([item[name] for item in items]) for name in items[0]}
    return list(items) if isinstance(items[0], str) else np.stack(items)


def stackable_clip(clip: Any) -> Any:
    """Convert a clip to a named tuple that PyTorch's default ``collate_fn`` stacks; a dict is unchanged."""
    if isinstance(clip, dict):
        return clip
    rows = [stackable_row(row, {}) for row in clip.rows]
    return _Batch(clip.clean, clip.noisy, rows, dict(clip.targets))


class RawClips:
    """Read the clips of a dataset by number: a map-style dataset.

    ``clips[i]`` is a `Clip`. A burst is a clip whose ``target`` is the light of its first frame. A clip with several
    noise levels, draws or patches is an item for each of them, in the order of the manifest. Frames that failed are
    missing; the column ``frame`` of the rows numbers the others. An instance can be pickled and forked like `RawPairs`.

    Parameters
    ----------
    path : str or Path, or a list of them
        As for `RawPairs`.
    split : str, optional
        Only clips of this split, by default all.
    inputs, noise_map, rows, clip_black
        As for `RawPairs`, with T as first axis: dicts that PyTorch's default ``collate_fn`` stacks. ``frame`` [T] is
        the number of each frame. Bursts have ``motion`` too, float64 [T, 6]: yy, yx, y, xy, xx, x of the manifest.

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

    def __init__(
        self,
        path: DatasetPath | Sequence[DatasetPath],
        *,
        split: str | None = None,
        inputs: str | None = None,
        noise_map: bool = False,
        rows: bool = False,
        clip_black: bool = False,
    ) -> None:
        self._options = Options("RawClips", None, False, inputs, noise_map, rows, clip_black)
        self._pairs = RawPairs(path, split=split)
        self.path = self._pairs.path
        datasets = enumerate(self._pairs._datasets)
        numbered = ((dataset, row) for dataset, pairs in datasets for _, row in pairs.pair_rows(split))
        clips: dict[tuple[Any, ...], list[int]] = {}
        for number, (dataset, row) in enumerate(numbered):
            if row["clip"]:
                clips.setdefault((dataset, *clip_identity(row)), []).append(number)
        if not clips:
            raise ConfigError(
                f"RawClips: {path}: has no clips; expected a dataset of source.clips=true or source.burst; use RawPairs"
            )
        self._clips = [np.array(numbers) for numbers in clips.values()]

    def __len__(self) -> int:
        return len(self._clips)

    def __repr__(self) -> str:
        return f"RawClips({str(self.path)!r}, length={len(self)})"

    def __iter__(self) -> Iterator[Any]:
        return (self[number] for number in range(len(self)))

    def __getitem__(self, number: SupportsIndex) -> Any:  # a Clip, or a dict with inputs
        frames = [self._pairs[frame] for frame in self._clips[operator.index(number)]]
        shapes = {frame.noisy.shape for frame in frames}
        if len(shapes) > 1:
            sizes = " and ".join(map(str, sorted(shapes)))
            name = frames[0].row["clip"]
            raise ConfigError(f"RawClips: clip {name} has frames of {sizes}; expected one size; use RawPairs")
        return clip_item(frames, self._options)

    def __getitems__(self, numbers: Sequence[int]) -> list[Any]:
        """Read a batch for PyTorch's DataLoader, in items that its default ``collate_fn`` stacks."""
        return [stackable_clip(self[number]) for number in numbers]
