"""Generate training pairs when they are read: new noise in each epoch, and no stored frames."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.interpretation import BurstRule, burst_rule, patch_rule
from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import read_dataset_yaml
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import Srgb
from unprocess_gen.core.errors import ConfigError, DamageError, UnknownKeyError
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.core.forks import SharedCount
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import AnyPath, any_path
from unprocess_gen.core.random_streams import crop_words, frame_word
from unprocess_gen.core.sequences import Recent, first_of
from unprocess_gen.core.source import Source
from unprocess_gen.core.targets import LINEAR_RGB, TARGETS
from unprocess_gen.dataset.clips import Clip, clip_item, stackable_clip
from unprocess_gen.dataset.columns import Row, Value, flatten
from unprocess_gen.dataset.dataset_json import recorded_places
from unprocess_gen.dataset.development import development_parameters
from unprocess_gen.dataset.inputs import Options
from unprocess_gen.dataset.keys import frame_key, pair_key, patch_key
from unprocess_gen.dataset.reader import DatasetPath, DatasetRows, Sample, check_split, open_datasets, stackable
from unprocess_gen.dataset.row import pair_row, patch_from_row, plan_from_row
from unprocess_gen.dataset.table import PairTable
from unprocess_gen.pipeline.live_bursts import burst_pairs, moved_burst, redrawn_burst
from unprocess_gen.pipeline.pairs import (
    PairSettings,
    facts_of_burst,
    noise_columns,
    plan_pixels,
    targets_of,
    with_motion,
)
from unprocess_gen.pipeline.replay import source_of
from unprocess_gen.pipeline.run import resolve
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import draw_split, next_dark_frame, redraw_plans
from unprocess_gen.planning.raw_source import parts_of, stated_source
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.conditions import noisy_frames
from unprocess_gen.simulation.facts import Facts
from unprocess_gen.simulation.frames import Pair, Patch
from unprocess_gen.simulation.pair import CropMaker, crop_maker
from unprocess_gen.simulation.plan import Place, Plan
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.loader import identity_sha256, load_source
from unprocess_gen.sources.patches import crop_patch, list_patches
from unprocess_gen.sources.pixel_cache import PixelCache
from unprocess_gen.sources.recorded_photographs import RecordedPhotographs

REDRAWS = ("noise", "all", "none")

KEPT = 4096
"""Plans that a process keeps, 8 kB each: reading or drawing one again takes longer than a patch of 128 x 128."""

KEPT_CROPS, NEW_CROPS = KEPT, 4
"""Numbers of pairs whose records are kept, 25 kB each; and of those that are new in each epoch, or whose pixels have 16
bits, 5 MB each."""


class LiveSample(Sample):
    """One pair of `LivePairs`: ``clean, noisy, row = sample``, as `Sample`; ``row`` is built on first access.

    ``targets`` are the arrays that ``targets`` of `LivePairs` names.
    """


class LivePairs(PairTable):
    """Generate pairs when they are read, with new noise in each epoch: a map-style dataset.

    ``live[epoch, i]`` depends only on the dataset, epoch and i, not on process, worker or order. ``live[i]`` is epoch
    0, which equals ``RawPairs(ds)[i]`` byte for byte. Fixed patterns of a camera body are the same in every epoch. Only
    the patch is simulated. An instance can be pickled and forked. ``live[epoch, "00000003"]`` is the pair with this
    key, and a slice is a `LivePairs` of those pairs. Both need items that are pairs (``patches=1``).

    With ``source.burst``, an item is a burst: a `Clip`, or with ``inputs`` a dict like those of `RawClips`. Its key is
    the key of its first frame.

    Parameters
    ----------
    dataset : str, Path, Config, mapping, or a list of str or Path
        Folder of a dataset or sweep, or a list of them, as for `RawPairs`; shards are not read. Or a config, or an
        argument of `load_config`: no dataset is generated, and pairs are planned when they are read.
    root : str or Path, optional
        Folder of the sources; by default the folder in the dataset's record, or ``source.root`` of the config.
    redraw : str
        ``"noise"``: new noise in each epoch, clean frames as in epoch 0. ``"all"``: new cameras, gains, noise levels,
        random patches and motion of bursts too. ``"none"``: the pairs of epoch 0 in every epoch.
    cache : str or Path, optional
        Folder for decoded pixels, which worker processes share; ``"memory"`` for a temporary folder. A pixel of an
        8-bit photograph takes 3 bytes. If the disk is full, further pixels are decoded each time.
    split : str, optional
        Only pairs of this split, by default all. With a config or overrides, each source is read once to find its
        split.
    cache_bytes : int
        Size up to which pixels are added to the cache.
    patch : int, optional
        Side of a square that is cut from each pair at an even row and column, new in each epoch unless ``redraw`` is
        ``"none"``. It is the crop of the complete pair, bit for bit.
    patches : int
        Number of such squares of each pair, at random places: consecutive items, which share the decoded image. The
        length grows by this factor. `EpochSampler` with this ``block`` keeps them together.
    targets : sequence of str
        Further arrays. ``"variance"``: expected variance of the noise at each site, from row and clean frame.
        ``"noise_std"``: `noise_std` of the noisy frame. ``"srgb"``: pixels of the source. ``"linear_rgb"``: light
        before the mosaic, float32 [H, W, 3], 0 at black and 1 at white. The first two are float32, in DN² and DN, or
        in units of white with ``inputs``. Bursts have ``"linear_rgb"`` only, [s H, s W, 3] of the first frame; always
        if a dataset stores it.
    flip, inputs, noise_map, rows, clip_black
        As for `RawPairs`: random flips in each epoch, and dicts of network inputs.

    Raises
    ------
    ConfigError
        If an argument is not allowed, or the sources' folder is unknown.
    DamageError
        If the manifest is damaged; for a motion that leads outside of the picture, when the burst is read.
    MachineError
        If a source was changed or deleted, or the self-test fails; when a pair is read.
    SourceError
        If a source of a config cannot be used; when a pair is read.
    IndexError
        If an epoch or a number is out of range.
    KeyError
        If no pair has a key, or several items have it; also a ConfigError.

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
        dataset: str | Path | ObjectPath | Config | Sequence[str] | Mapping[str, Any],
        root: str | os.PathLike[str] | None = None,
        redraw: str = "noise",
        cache: str | os.PathLike[str] | None = None,
        *,
        split: str | None = None,
        cache_bytes: int = 2**36,
        patch: int | None = None,
        patches: int = 1,
        targets: Sequence[str] = (),
        flip: bool = False,
        inputs: str | None = None,
        noise_map: bool = False,
        rows: bool = False,
        clip_black: bool = False,
    ) -> None:
        if redraw not in REDRAWS:
            raise ConfigError(f"LivePairs: redraw={redraw!r}: unknown; expected one of {', '.join(REDRAWS)}")
        unknown = [name for name in targets if name not in TARGETS]
        if isinstance(targets, str) or unknown:
            raise ConfigError(f"LivePairs: targets={targets!r}: unknown; expected a list of {', '.join(TARGETS)}")
        self._options = Options("LivePairs", patch, flip, inputs, noise_map, rows, clip_black)
        if patches < 1 or (patches > 1 and patch is None):
            expected = "1 or more, and patch with more than 1"
            raise ConfigError(f"LivePairs: patches={patches}: out of range; expected {expected}")
        self._cache = None if cache is None else PixelCache(cache, cache_bytes)
        super().__init__(_live_sources(dataset, None if root is None else os.fspath(root), split))
        self._rules = [burst_rule(source.settings.config.source) for source in self._datasets]
        if any(rule is not None for rule in self._rules):
            self._numbers = self._first_frames(flip, {*targets})
            if any(LINEAR_RGB in source.settings.config.output.targets for source in self._datasets):
                targets = [LINEAR_RGB]  # epoch 0 is what is stored
        self._redraw, self._patches, self._targets = redraw, patches, tuple(targets)
        most = (NEW_CROPS if redraw == "all" else KEPT_CROPS), NEW_CROPS
        self._kept: list[Recent[tuple[Any, ...], tuple[Plan, CropMaker]]] = [*map(Recent, most)]
        self._facts: Recent[int, Facts | None] = Recent(KEPT)  # they read all pixels of a photograph
        self._reads_of_epoch_0 = SharedCount()

    def __len__(self) -> int:
        return len(self._numbers) * self._patches

    def __repr__(self) -> str:
        names = first_of([repr(source.name) for source in self._datasets])
        return f"LivePairs({names}, length={len(self)}, redraw={self._redraw!r})"

    def __getitem__(self, item: Any) -> Any:  # a dict instead of a LiveSample with inputs
        number = item[1] if isinstance(item, tuple) else item
        if self._patches > 1 and isinstance(number, str | slice):
            raise UnknownKeyError(f"{number!r:.40}: an item is one patch of a pair; expected its number, or select(…)")
        if isinstance(item, slice):
            return self._part(self._numbers[item])
        epoch, number = self._item(item)
        position, crop = divmod(number, self._patches)
        if not isinstance(item, tuple | str) and self._redraw != "none":
            self._warn_of_repetition()
        number = int(self._numbers[position])
        place, number_in_dataset = self._place(number)
        source = self._datasets[place]
        image = source.image(number_in_dataset)
        epoch = epoch if self._redraw != "none" else 0
        decode = partial(source.decode, image)
        srgb = decode() if self._cache is None else self._cache.get(image.cache_name, decode)
        if (rule := self._rules[place]) is not None:
            step = noisy_frames(source.settings.config)
            images = [source.image(number_in_dataset + frame * step) for frame in range(rule.frames)]
            return self._burst(source, rule, images, srgb, epoch, crop, number)
        plan, patch, make = self._prepared(place, image, srgb, epoch, number)
        options, words = self._options, (0, 0)
        if options.side is not None:
            drawn = plan.place.level, plan.place.draw, frame_word(plan.place.frame, epoch), crop
            words = crop_words(plan.stream_key, patch.patch, *drawn)
            y, x = options.place(words, patch.height, patch.width)
            patch = Patch(options.side, options.side, patch.patch, patch.patch_y + y, patch.patch_x + x)
        clean, noisy, counts = make(crop_patch(srgb, patch), patch.origin, epoch)

        def pair() -> Pair:
            return Pair(clean, noisy, counts())

        targets, of_white = {}, options.inputs is not None
        if self._targets:
            targets = targets_of(self._targets, srgb, plan, patch, pair(), of_white=of_white)
        row: Any = LiveRow(partial(image.row, plan, epoch, patch, pair))
        sample = LiveSample(clean, noisy, row, source.name, targets)
        columns = noise_columns(plan) if options.flip or of_white else {}
        return options.item(sample, columns, words, partial(development_parameters, plan), epoch=0)

    def _first_frames(self, flip: bool, targets: set[str]) -> NDArray[np.int64]:
        """Numbers of the pairs that are items; for a burst, of its first frame at each level and draw."""
        if flip or targets - {LINEAR_RGB}:
            problem = "flip=True" if flip else f"targets={sorted(targets)}"
            raise ConfigError(f"LivePairs: {problem}: not possible for bursts; expected no flip, and only {LINEAR_RGB}")
        firsts = []
        for source, rule, start in zip(self._datasets, self._rules, self._starts, strict=False):
            step, numbers = noisy_frames(source.settings.config), np.arange(len(source))
            firsts.append(start + (numbers if rule is None else numbers[numbers % (rule.frames * step) < step]))
        return np.concatenate(firsts)

    def _burst(
        self, source: LiveSource, rule: BurstRule, images: Sequence[LiveImage], srgb: Srgb, epoch: int, crop: int,
        number: int,
    ) -> Any:  # fmt: skip
        """Generate a burst: a `Clip`, or a dict with inputs."""
        settings, options, patch = source.settings, self._options, images[0].patch
        plans: Sequence[Plan] = [image.plan for image in images]
        if not all(plan.motion and plan.place.frame == frame for frame, plan in enumerate(plans)):
            raise DamageError(f"row {images[0].key}: not the first of the {rule.frames} frames of a burst")
        if epoch and self._redraw == "all":
            facts = facts_of_burst(rule, self._facts_of(number, settings, images[0], srgb))
            plans = redrawn_burst(settings, plans, facts, epoch)
            plans, patch = moved_burst(settings, rule, plans, patch, (srgb.shape[0], srgb.shape[1]), epoch)
        part = patch
        if options.side is not None:
            place = plans[0].place
            words = plans[0].stream_key, patch.patch, place.level, place.draw, frame_word(0, epoch), crop
            y, x = options.place(crop_words(*words), patch.height, patch.width)
            part = Patch(options.side, options.side, patch.patch, patch.patch_y + y, patch.patch_x + x)
        self_test.check(plans[:1])
        try:
            made, targets = burst_pairs(settings, srgb, plans, patch, part, epoch, self._targets)
        except ValueError as error:  # of an edited manifest, whose motion leads outside
            raise DamageError(f"row {images[0].key}: {error}") from error
        samples, columns = [], list[Row]()
        for image, (plan, pair) in zip(images, made, strict=True):
            known = partial(Pair, pair.clean, pair.noisy, pair.counts)
            row: Any = LiveRow(partial(image.row, plan, epoch, part, known))
            samples.append(LiveSample(pair.clean, pair.noisy, row, source.name, targets))
            assert plan.motion is not None
            columns.append({**flatten(plan.motion), **noise_columns(plan), "frame": plan.place.frame})
        return clip_item(samples, options, columns)

    def _part(self, numbers: NDArray[np.int64]) -> Self:
        part = super()._part(numbers)
        part._reads_of_epoch_0 = SharedCount()
        return part

    def __getitems__(self, items: Sequence[int | tuple[int, int]]) -> list[Any]:
        """Generate a batch for PyTorch's DataLoader, in items that its default ``collate_fn`` stacks.

        With ``inputs``, items are dicts. Otherwise they are named tuples of the clean frame, the noisy frame, the row
        as a dict with NaN for None, and targets if there are any.
        """
        made = map(self.__getitem__, items)
        return [stackable_clip(item) if isinstance(item, Clip) else stackable(item, epoch=0) for item in made]

    def _warn_of_repetition(self) -> None:
        """Warn when a second epoch begins without a number; a copy in a worker process does not see other epochs."""
        count = self._reads_of_epoch_0
        if count.next() == (1 if count.is_copy else len(self) + 1):
            warnings.warn(
                "LivePairs: items without an epoch have the noise of epoch 0 each time; give the DataLoader "
                "sampler=EpochSampler(len(live)), or LivePairs redraw='none'",
                stacklevel=3,
            )

    def _prepared(
        self, place: int, image: LiveImage, srgb: Srgb, epoch: int, number: int
    ) -> tuple[Plan, Patch, CropMaker]:
        """Find the plan of an epoch, without the epoch's number; the patch; and the function that makes crops."""
        redraws = self._redraw == "all"
        plan_epoch = epoch if redraws or image.plan.dark else 0
        settings, patch, frame = self._datasets[place].settings, image.patch, (srgb.shape[0], srgb.shape[1])
        kept = self._kept[srgb.itemsize == 2 or image.plan.source.dequantize != "off"]
        side = self._options.side
        shape = (patch.height, patch.width) if side is None else (side, side)
        key = place, image.plan.stream_key, image.plan.place, plan_epoch, shape
        prepared = kept.get(key)
        if prepared is None:
            plan = self._redrawn(settings, image, srgb, plan_epoch, number) if plan_epoch else image.plan
            self_test.check([plan], self._targets)
            make = crop_maker(plan, shape, frame, patch.origin, 256**srgb.itemsize, settings.dark_folder)
            prepared = kept.keep(key, (plan, make))
        if plan_epoch and redraws and (rule := patch_rule(settings.config.source)) is not None:
            plan = image.plan
            patch = list_patches(rule, plan.stream_key, *frame, plan.output.layout, epoch)[patch.patch]
        return prepared[0], patch, prepared[1]

    def _redrawn(self, settings: PairSettings, image: LiveImage, srgb: Srgb, epoch: int, number: int) -> Plan:
        """Draw the plan of an epoch, without the epoch's number."""
        plan = image.plan
        if self._redraw == "all":
            facts = self._facts_of(number, settings, image, srgb)
            (plan,) = redraw_plans(settings.config, plan, facts, settings.dark_frames, epoch)
        if plan.dark and settings.dark_frames is not None:
            plan = next_dark_frame(plan, settings.dark_frames, epoch)
        return plan

    def _facts_of(self, number: int, settings: PairSettings, image: LiveImage, srgb: Srgb) -> Facts | None:
        """Facts about the pixels of an image from which its parameters are redrawn, computed once for each item."""
        plan, facts = image.plan, self._facts.get(number)
        if facts is None:
            parts, stated, profile = parts_of(plan), stated_source(plan), plan.source.profile
            computed = facts_for(settings.config, srgb, image.source.frames, parts, stated, profile)
            facts = self._facts.keep(number, computed)
        return facts


class LiveRow(Mapping[str, Value]):
    """Row of a live pair, built on first access: its digests take longer than a small pair. Pickled as a dict."""

    def __init__(self, build: Callable[[], dict[str, Value]]) -> None:
        self._build = build

    @cached_property
    def _row(self) -> dict[str, Value]:
        return self._build()

    def __getitem__(self, name: str) -> Value:
        return self._row[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._row)

    def __len__(self) -> int:
        return len(self._row)

    def __repr__(self) -> str:
        return repr(self._row)

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self._row,)


def _live_sources(dataset: Any, root: str | None, split: str | None) -> list[LiveSource]:
    """Open datasets, or list the sources of a config or of overrides."""
    is_place = isinstance(dataset, DatasetPath)
    if is_place or (not isinstance(dataset, Config | Mapping) and any(map(_is_dataset, dataset))):
        return [*open_datasets("LivePairs", dataset, split, partial(RecordedPairs, root))]
    if not isinstance(dataset, Config):
        from unprocess_gen.config.composition import load_config

        dataset = load_config(dataset)
    return [PlannedPairs(dataset, root, split)]


def _is_dataset(place: Any) -> bool:
    """Check whether an item of a list is a folder, not an override."""
    return not isinstance(place, str) or "://" in place.partition("=")[0] or any_path(place).is_dir()


# ------------------------------------------------------------------------------------------- pairs of epoch 0


@dataclass(frozen=True, slots=True)
class LiveImage:
    """Everything that decides a pair in epoch 0: arguments of `dataset.row.pair_row`.

    ``recorded`` reads the row of the pair from the manifest of a dataset, if the row has digests.
    """

    source: Source
    sha256: str
    orientation: int
    shard: int
    key: str
    plan: Plan
    patch: Patch
    source_noise_dn: float | None = None
    recorded: Callable[[], dict[str, Value]] | None = None

    @property
    def cache_name(self) -> str:
        """Name of the decoded image in a `PixelCache`."""
        prepared = self.plan.source
        if not prepared.is_raw:
            return f"{prepared.pixels_xxh3 or self.sha256}-{prepared.downscale}"
        means = prepared.raw_pattern, *prepared.raw_black_dn, *prepared.raw_white_dn
        return "-".join(map(str, (prepared.mosaic_xxh3, prepared.shrink, *(means if prepared.shrink > 1 else ()))))

    def row(self, plan: Plan, epoch: int, patch: Patch, pair: Callable[[], Pair]) -> dict[str, Value]:
        """Build the row of a pair in an epoch, or read the recorded one."""
        if self.recorded is not None and not epoch and patch == self.patch:
            return self.recorded()
        made = pair()
        digests = array_xxh3(made.clean), array_xxh3(made.noisy)
        identity = self.key, self.source, self.sha256, self.orientation, self.shard
        row = pair_row(*identity, plan.replace(epoch=epoch), made, digests, patch, self.source_noise_dn)
        return {**row, "epoch": epoch} if epoch else dict(row)


class RecordedPairs(DatasetRows):
    """Pairs of a dataset, or the pairs in a split, from its manifest and sources, without shards."""

    def __init__(self, root: str | None, folder: AnyPath, split: str | None = None) -> None:
        super().__init__(folder, split)
        config, _ = read_dataset_yaml(folder / "config.yaml")
        places = recorded_places(folder, root)
        self.settings = PairSettings.read(replaced(config, {"noise.dark_frames": places.dark_frames}))
        self._photographs = RecordedPhotographs(places.root)
        self._kept: Recent[int, LiveImage] = Recent(KEPT)

    def image(self, number: int) -> LiveImage:
        """Read all that decides the pair of a row."""
        image = self._kept.get(number)
        if image is None:
            row = self.row(number)
            numbers, noise_dn = (int(row["orientation"] or 1), int(row["shard"] or 0)), row["source_noise_dn"]
            identity = source_of(row), str(row["source_sha256"]), *numbers, str(row["key"])
            assert not isinstance(noise_dn, str)
            plan = self._photographs.with_profile(plan_from_row(row), *identity[:2])
            parts = plan, patch_from_row(row), noise_dn
            recorded = partial(self.row, number) if row["clean_xxh3"] else None
            image = self._kept.keep(number, LiveImage(*identity, *parts, recorded))
        return image

    def decode(self, image: LiveImage) -> Srgb:
        """Decode the image of a pair; raise as `RecordedPhotographs`."""
        return self._photographs.load(image.source, image.sha256, image.plan.source).srgb


class PlannedPairs:
    """Pairs of listed sources, planned when they are read; equal to the pairs of a run."""

    name = ""

    def __init__(self, config: Config, root: str | None, split: str | None = None) -> None:
        config = config if root is None else replaced(config, {"source.root": root})
        validate_config(config)
        rule = patch_rule(config.source)
        if rule is not None and rule.kind == "grid":
            raise ConfigError(
                f"source.patch={config.source.patch}: the number of patches depends on the sizes of the images; "
                "expected random patches or null; give LivePairs a finished dataset"
            )
        run = resolve(config)
        self.settings = run.settings
        self._sources = [source for source in run.sources if source.reason is None]
        if split is not None:
            read = map if config.source.place is None else any_path(config.source.place).map
            digests = read(partial(identity_sha256, config.source), self._sources)
            splits = [draw_split(config, sha256) for sha256 in digests]
            check_split("LivePairs", split, {*splits})
            self._sources = [source for source, name in zip(self._sources, splits, strict=True) if name == split]
        self._patches = 1 if rule is None else rule.count
        self._rule = burst_rule(config.source)
        self._plans = noisy_frames(config) * (1 if self._rule is None else self._rule.frames)
        self._planned: Recent[int, tuple[str, int, tuple[Plan, ...], tuple[Patch, ...]]] = Recent(KEPT)
        self._decoded: tuple[Source, str, Photograph] | None = None

    def __len__(self) -> int:
        return len(self._sources) * self._patches * self._plans

    def image(self, number: int) -> LiveImage:
        """Plan a pair; raise as `load_source`."""
        index, rest = divmod(number, self._patches * self._plans)
        source = self._sources[index]
        planned = self._planned.get(index)
        if planned is None:
            sha256, photograph = self._load(source)
            image = plan_pixels(self.settings, photograph, source, sha256)
            planned = self._planned.keep(index, (sha256, photograph.orientation, image.plans, image.patches))
        sha256, orientation, plans, patches = planned
        patch, plan = patches[rest // self._plans], plans[rest % self._plans]
        if self._rule is not None:
            (plan,) = with_motion(self._rule, [plan], patch)
        shard = source.index // self.settings.config.output.pairs_per_shard
        return LiveImage(source, sha256, orientation, shard, self.key(number), plan, patch)

    def key(self, number: int) -> str:
        """Key of a pair, without planning it."""
        index, rest = divmod(number, self._patches * self._plans)
        patch, plan = divmod(rest, self._plans)
        config = self.settings.config
        sample = patch_key(self._sources[index].index, patch, several=config.source.patch is not None)
        frame, plan = divmod(plan, noisy_frames(config))
        level, draw = divmod(plan, config.noise.draws)
        sample = sample if self._rule is None else frame_key(sample, frame)
        return pair_key(sample, Place(level=level, draw=draw), several=noisy_frames(config) > 1)

    def row(self, number: int) -> dict[str, Value]:
        """Raise ConfigError: the rows of a table need every photograph."""
        raise ConfigError(
            "LivePairs: overrides give no table of rows, because each needs a decoded photograph; expected a dataset; "
            "make one without frames: gen-dataset manifest OVERRIDES out=FOLDER"
        )

    def decode(self, image: LiveImage) -> Srgb:
        """Decode the image of a pair; raise as `load_source`."""
        return self._load(image.source)[1].srgb

    def _load(self, source: Source) -> tuple[str, Photograph]:
        """Load a source; the last one stays decoded, because pairs of one image are consecutive."""
        decoded, config = self._decoded, self.settings.config
        if decoded is None or decoded[0] != source:
            decoded = self._decoded = source, *load_source(config.source, source, config.output.layout)
        return decoded[1:]


LiveSource = RecordedPairs | PlannedPairs
