"""Make the pairs of a training while it runs: new noise in each epoch, and nothing stored but the manifest."""

from __future__ import annotations

import operator
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.interpretation import patch_rule
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.random_streams import EPOCHS, crop_words
from unprocess_gen.core.targets import TARGETS
from unprocess_gen.core.types import Frame, Patch, Plan, Row
from unprocess_gen.dataset.reader import Sample
from unprocess_gen.dataset.training import to_light
from unprocess_gen.pipeline.live_sources import LiveImage, LiveSource, PlannedPairs, RecordedPairs
from unprocess_gen.pipeline.pairs import PlannedImage
from unprocess_gen.pipeline.targets import kernels_for, targets_of
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import next_dark_frame, redraw_plan
from unprocess_gen.simulation import self_test
from unprocess_gen.sources.patches import even_corner, list_patches
from unprocess_gen.sources.pixel_cache import PixelCache

REDRAWS = ("noise", "all", "none")


class LiveSample(Sample):
    """One pair of `LivePairs`: ``clean, noisy, row = sample``, as `Sample`.

    ``targets`` are the arrays that ``targets`` of `LivePairs` names.
    """


class LivePairs:
    """Make the pairs of a dataset when they are read, with new noise in each epoch: a map-style dataset.

    ``live[epoch, i]`` depends only on the dataset, epoch and i, whatever process, worker or order reads it. ``live[i]``
    is epoch 0, which equals ``RawPairs(ds)[i]`` byte for byte. Fixed patterns of a camera body are the same in every
    epoch. Only the patch is simulated. An instance can be pickled and forked.

    Parameters
    ----------
    dataset : str, Path, Config, or list of str
        Folder of a finished dataset, whose manifest and sources are read, not its shards. Or a config or Hydra
        overrides, of which no dataset is generated: pairs are planned when they are read, and a source that cannot be
        used raises its error.
    root : str or Path, optional
        Folder of the sources; by default the one that the dataset records, or ``source.root`` of the config.
    redraw : str
        ``"noise"``: new noise in each epoch, clean frames as in epoch 0. ``"all"``: new cameras, gains, noise levels
        and random patches too. ``"none"``: the pairs of epoch 0 in every epoch.
    cache : str or Path, optional
        Folder for decoded pixels, 3 bytes a pixel, which worker processes share; ``"memory"`` for a temporary one.
    cache_bytes : int
        Size up to which pixels are added to the cache.
    patch : int, optional
        Side of a square that is cut from each pair at an even row and column, new in each epoch unless ``redraw`` is
        ``"none"``. It is the crop of the complete pair, bit for bit.
    as_float : bool
        Frames are float32 with 0 at black and 1 at white.
    targets : sequence of str
        More arrays: ``"variance"`` of the noise at each site, by the row's law on the clean frame; ``"noise_std"``, the
        standard deviation that `noise_std` estimates from the noisy frame; ``"srgb"``, the pixels of the photograph;
        ``"linear_rgb"``, the scene before the mosaic, 0 at black and 1 at white, [H, W, 3]. The first two are float32,
        in DN² and DN, or in units of white with ``as_float``; the last is float32.
    arrays_only : bool
        Items are tuples of the clean frame, the noisy frame and the targets, which PyTorch's default ``collate_fn``
        stacks.

    Raises
    ------
    ConfigError
        If an argument is not allowed, or the sources' folder is unknown.
    DamageError
        If the manifest is damaged.
    MachineError
        If a source was changed or deleted, or the self-test fails; when a pair is read.
    SourceError
        If a source of a config cannot be used; when a pair is read.
    IndexError
        If an epoch or a number is out of range.

    Examples
    --------
    The dataset of the example of `unprocess_gen.generate`:

    >>> import unprocess_gen as ug
    >>> live = ug.LivePairs("ds")
    >>> bool((live[0].noisy == ug.RawPairs("ds")[0].noisy).all())
    True
    >>> first, second = live[0], live[1, 0]
    >>> bool((first.clean == second.clean).all()), bool((first.noisy == second.noisy).all())
    (True, False)
    """

    def __init__(
        self,
        dataset: str | Path | ObjectPath | Config | Sequence[str],
        root: str | os.PathLike[str] | None = None,
        redraw: str = "noise",
        cache: str | os.PathLike[str] | None = None,
        *,
        cache_bytes: int = 2**36,
        patch: int | None = None,
        as_float: bool = False,
        targets: Sequence[str] = (),
        arrays_only: bool = False,
    ) -> None:
        if redraw not in REDRAWS:
            raise ConfigError(f"LivePairs: redraw={redraw!r}: unknown; expected one of {', '.join(REDRAWS)}")
        unknown = [name for name in targets if name not in TARGETS]
        if isinstance(targets, str) or unknown:
            raise ConfigError(f"LivePairs: targets={targets!r}: unknown; expected a list of {', '.join(TARGETS)}")
        if patch is not None and (patch < 2 or patch % 2):
            raise ConfigError(f"LivePairs: patch={patch}: out of range; expected an even number from 2")
        pixels = None if cache is None else PixelCache(cache, cache_bytes)
        self._source = _live_source(dataset, None if root is None else os.fspath(root), pixels)
        self._redraw, self._patch, self._as_float = redraw, patch, as_float
        self._targets, self._arrays_only = tuple(targets), arrays_only

    def __len__(self) -> int:
        return len(self._source)

    def __repr__(self) -> str:
        return f"LivePairs({self._source.name!r}, length={len(self)}, redraw={self._redraw!r})"

    def __getitem__(self, item: int | tuple[int, int]) -> Any:  # arrays instead of a LiveSample with arrays_only
        epoch, number = map(operator.index, item if isinstance(item, tuple) else (0, item))
        if not 0 <= epoch < EPOCHS:
            raise IndexError(f"epoch {epoch} is out of range; expected 0 to {EPOCHS - 1}")
        number = range(len(self))[number]
        image = self._source.image(number)
        plan, patch = self._redrawn(image, epoch if self._redraw != "none" else 0)
        settings = self._source.settings
        for kernels in kernels_for(self._targets, plan):
            self_test.check(kernels)
        _, _, pair = next(PlannedImage(image.srgb, (plan,), (patch,), dark_folder=settings.dark_folder).pairs())
        row: Any = image.row(plan, patch, pair)
        clean, noisy = pair.clean, pair.noisy
        if self._as_float:
            clean, noisy = _light(clean, row), _light(noisy, row)
        targets = targets_of(self._targets, image.srgb, plan, patch, pair, row, as_float=self._as_float)
        if self._arrays_only:
            return (clean, noisy, *targets.values())
        return LiveSample(clean, noisy, row, self._source.name, targets)

    def _redrawn(self, image: LiveImage, epoch: int) -> tuple[Plan, Patch]:
        """Return the plan and the patch of an epoch."""
        plan, patch, settings = image.plan, image.patch, self._source.settings
        if epoch and self._redraw == "all":
            config, (height, width) = settings.config, image.srgb.shape[:2]
            facts = facts_for(config, image.srgb, image.source.frames)
            plan = redraw_plan(config, plan, facts, settings.dark_frames, epoch)
            rule = patch_rule(config.source)
            patch = list_patches(rule, plan.stream_key, height, width, plan.output.layout, epoch)[patch.number]
        if epoch:
            plan = plan.replace(epoch=epoch)
            if plan.noise.dark.sha256 and settings.dark_frames is not None:
                plan = next_dark_frame(plan, settings.dark_frames, epoch)
        return plan, patch if self._patch is None else _crop(plan, patch, self._patch)


def _live_source(dataset: Any, root: str | None, cache: PixelCache | None) -> LiveSource:
    """Open a finished dataset, or list the sources of a config or of overrides."""
    if isinstance(dataset, str | Path | ObjectPath):
        return RecordedPairs(any_path(dataset), root, cache)
    if not isinstance(dataset, Config):
        from unprocess_gen.config.composition import load_config

        dataset = load_config(dataset)
    return PlannedPairs(dataset, root, cache)


def _crop(plan: Plan, patch: Patch, side: int) -> Patch:
    """Cut a random square from a patch, at an even row and column."""
    if side > min(patch.height, patch.width):
        raise ConfigError(
            f"LivePairs: patch={side}: exceeds a pair of {patch.width} x {patch.height} pixels; expected at most its "
            "shorter side"
        )
    words = crop_words(plan.stream_key, patch.number, plan.noise.level, plan.noise.draw, plan.noise.frame_word)
    y, x = even_corner(words, side, patch.height, patch.width)
    return Patch(patch.number, patch.y + y, patch.x + x, side, side)


def _light(frame: Frame, row: Row) -> NDArray[np.float32]:
    return to_light(frame, row) if frame.dtype == np.uint16 else np.asarray(frame, dtype=np.float32)
