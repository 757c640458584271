"""Estimate the bytes that shards will take, from image headers, and refuse a run that does not fit the disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from unprocess_gen.config.interpretation import noise_levels, patch_rule
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import MachineError, SourceError
from unprocess_gen.core.files import free_bytes
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import PACKED, Source
from unprocess_gen.dataset.manifest import json_size
from unprocess_gen.dataset.shards import array_format, image_bytes, shard_bytes
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.sources.image.headers import probe
from unprocess_gen.sources.listing import read_bytes
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import list_patches
from unprocess_gen.sources.scenes import synthetic

SAMPLE = 32
"""Sources whose headers are read; the sizes of longer listings are extrapolated."""


@dataclass(frozen=True, slots=True)
class SizeEstimate:
    """Hold the bytes of some shards: in total, and of the largest one."""

    total: int
    largest_shard: int


def source_bytes(config: Config, name: str, height: int, width: int) -> int:
    """Return the bytes that one source takes in its shard.

    Parameters
    ----------
    config : Config
        Validated config.
    name : str
        Name of the source in the manifest; it decides the size of the JSON members.
    height, width : int
        Pixels of the decoded source after ``source.downscale``.

    Returns
    -------
    int
        Bytes of all samples, tar headers and padding included; exact, because no other value decides sizes. 0 if no
        patch or tile fits.
    """
    output, pairs = config.output, len(noise_levels(config.noise)) * config.noise.draws
    rule = patch_rule(config.source)
    smallest = rule.side if rule is not None else 2 if output.layout == PACKED else 1
    if min(height, width) < smallest:
        return 0
    patches = list_patches(rule, 0, height, width, output.layout)
    json_bytes = json_size(name, pairs)
    noisy = [array_format(output.dtype, output.layout, patch.height, patch.width) for patch in patches]
    clean = [form._replace(dtype=output.clean_dtype or output.dtype) for form in noisy]
    return sum(image_bytes(form, json_bytes, pairs, of_clean) for form, of_clean in zip(noisy, clean, strict=True))


def estimate_shards(config: Config, tasks: Sequence[ShardTask]) -> SizeEstimate:
    """Estimate the bytes of shards from the headers of at most `SAMPLE` sources.

    The estimate is exact if there are no more sources and all of them are pictures that decode.
    """
    sources = [source for task in tasks for source in task.sources]
    if not sources:
        return SizeEstimate(0, 0)
    film: dict[str, int] = {}
    sizes = [_header_bytes(config, source, film) for source in evenly_spaced(sources, SAMPLE)]
    if len(sizes) < len(sources):
        mean = sum(sizes) // len(sizes)
        largest = max(len(task.sources) for task in tasks)
        total = mean * len(sources) + len(tasks) * shard_bytes([0])
        return SizeEstimate(total, shard_bytes([mean] * largest))
    by_index = {source.index: size for source, size in zip(sources, sizes, strict=True)}
    of_shards = [shard_bytes([by_index[source.index] for source in task.sources if by_index[source.index]])
                 for task in tasks]  # fmt: skip
    return SizeEstimate(sum(of_shards), max(of_shards))


def check_free_space(config: Config, tasks: Sequence[ShardTask], out: Path) -> None:
    """Raise MachineError if the shards of ``tasks`` do not fit the free space of ``out``."""
    needed, free = estimate_shards(config, tasks), free_bytes(out)
    if needed.total > free:
        raise MachineError(
            f"out={out}: not enough disk space for {len(tasks)} shards; expected about {needed.total} free bytes "
            f"({needed.largest_shard} for the largest shard), found {free}; free space, choose another out, or set "
            "check_disk=false to start anyway"
        )


def _header_bytes(config: Config, source: Source, film: dict[str, int]) -> int:
    """Return the bytes of a source in its shard, 0 if it will fail; ``film`` keeps the size of a video's frames.

    Frames of all videos are taken to be as large as those of the first one, because opening a video reads all of it.
    """
    try:
        if not source.is_video:
            return _size_in_shard(config, source)
        if not film:
            film[""] = _size_in_shard(config, replace(source, frame=0))
        return film[""]
    except (SourceError, MachineError):
        return 0


def _size_in_shard(config: Config, source: Source) -> int:
    side = config.source.downscale
    if config.source.root is None:
        height, width = synthetic.SIZES.get(source.path, synthetic.DEFAULT_SIZE)
    elif source.is_video:
        height, width = load_source(config.source, source)[1].srgb.shape[:2]
        side = 1
    else:
        header = probe(read_bytes(config.source.root, source))
        if header.missing or header.width * header.height > config.source.max_pixels:
            return 0
        height, width = header.height, header.width
    return source_bytes(config, source.name, height // side, width // side)
