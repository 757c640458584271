"""Estimate the bytes that shards will take, from image headers.

The estimate decides ``output.pairs_per_shard=auto``, warns of too many shards, and refuses a run that does not fit the
disk.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from unprocess_gen.config.interpretation import noise_levels, patch_rule
from unprocess_gen.config.schema import AUTO, Config, OutputConfig
from unprocess_gen.config.serialization import parse_dataset_yaml
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.files import free_bytes
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.targets import FRAME_TARGETS
from unprocess_gen.core.types import FLOAT32, PACKED, UINT8, UINT16, Source
from unprocess_gen.dataset.manifest import json_size
from unprocess_gen.dataset.shards import array_format, image_bytes, shard_bytes, target_format
from unprocess_gen.pipeline.storage import Storage
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.sources.image.headers import probe
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import list_patches
from unprocess_gen.sources.read_ahead import ReadFile, reading_ahead
from unprocess_gen.sources.reading import read_bytes
from unprocess_gen.sources.scenes import synthetic

HEADERS_READ = 32
"""Sources whose headers are read; the sizes of longer listings are extrapolated."""

SHARD_BYTES = 256_000_000
"""Bytes of a shard under ``output.pairs_per_shard=auto``: few enough files, and few enough bytes to make twice."""

MAX_PAIRS_PER_SHARD = 10**6
"""The limit of ``output.pairs_per_shard``."""

MAX_SHARDS = 200_000
"""Shards above which a run warns. A million shards take 170 MB in ``dataset.json``, and one folder holds them all."""


class SizeEstimate(NamedTuple):
    """Hold the bytes of some shards: in total, and of the largest one."""

    total: int
    largest_shard: int


def source_bytes(config: Config, name: str, height: int, width: int, bits: int = 8) -> int:
    """Return the bytes that one source takes in its shard.

    Parameters
    ----------
    config : Config
        Validated config.
    name : str
        Name of the source in the manifest; it decides the size of the JSON members.
    height, width : int
        Pixels of the decoded source after ``source.downscale``.
    bits : int
        Bits of the source, 8 or 16; they decide the size of the target ``srgb``.

    Returns
    -------
    int
        Bytes of all samples, tar headers and padding included; exact, because no other value decides sizes. 0 if no
        patch or tile fits, or the source is left out.
    """
    output, pairs = config.output, len(noise_levels(config.noise)) * config.noise.draws
    rule = patch_rule(config.source)
    smallest = rule.side if rule is not None else 2 if output.layout == PACKED else 1
    if min(height, width) < max(smallest, config.source.min_side or 1):
        return 0
    patches = list_patches(rule, 0, height, width, output.layout)
    json_bytes, total = json_size(name, pairs, len(output.targets), config.source.kind == "raw"), 0
    srgb_dtype = UINT16 if bits == 16 or config.source.downscale > 1 else UINT8
    for patch in patches:
        noisy = array_format(output.dtype, output.layout, patch.height, patch.width)
        targets = [
            target_format(target, output.layout, patch.height, patch.width, srgb_dtype if target == "srgb" else FLOAT32)
            for target in output.targets
            for _ in range(pairs if target in FRAME_TARGETS else 1)
        ]
        clean = noisy._replace(dtype=output.clean_dtype or output.dtype)
        total += image_bytes(noisy, json_bytes, pairs, clean, targets)
    return total


def estimate_shards(config: Config, tasks: Sequence[ShardTask], headers: int = HEADERS_READ) -> SizeEstimate:
    """Estimate the bytes of shards from at most ``headers`` headers of evenly spaced sources.

    The estimate is exact if there are no more sources and all of them are pictures that decode.
    """
    sources = [source for task in tasks for source in task.sources]
    if not sources or not config.output.frames:
        return SizeEstimate(0, 0)
    sizes = _sampled_bytes(config, sources, headers)
    if len(sizes) < len(sources):
        mean = sum(sizes) // len(sizes)
        largest = max(len(task.sources) for task in tasks)
        total = mean * len(sources) + len(tasks) * shard_bytes([0])
        return SizeEstimate(total, shard_bytes([mean] * largest))
    by_index = {source.index: size for source, size in zip(sources, sizes, strict=True)}
    shards = ([by_index[source.index] for source in task.sources] for task in tasks)
    totals = [shard_bytes(list(filter(None, shard))) for shard in shards]
    return SizeEstimate(sum(totals), max(totals))


def resolve_pairs_per_shard(config: Config, sources: Sequence[Source]) -> Config:
    """Replace ``output.pairs_per_shard=auto`` by the number of a begun dataset, or by an estimate.

    The estimate follows from names and headers of the sources, not from the machine, because it decides the bytes.
    """
    if config.output.pairs_per_shard != AUTO:
        return config
    number = _recorded_pairs_per_shard(config.out) or fitting_pairs_per_shard(config, sources)
    return replace(config, output=replace(config.output, pairs_per_shard=number))


def _recorded_pairs_per_shard(out: str) -> int | None:
    """Read the number in ``config.yaml``, None without one; later checks report what is wrong with the file."""
    try:
        config, _ = parse_dataset_yaml(Storage(out).read("config.yaml"))
    except (OSError, ValueError, ConfigError):
        return None
    number = config.output.pairs_per_shard
    return number if isinstance(number, int) else None


def fitting_pairs_per_shard(config: Config, sources: Sequence[Source]) -> int:
    """Return the number of sources whose pairs take about `SHARD_BYTES`.

    Parameters
    ----------
    config : Config
        Validated config.
    sources : sequence of Source
        The listing.

    Returns
    -------
    int
        From the mean size of those sources, among `HEADERS_READ` of them, that can be read; 1 if a single one takes
        more. The default if none can be read.
    """
    sizes = list(filter(None, _sampled_bytes(config, sources, HEADERS_READ)))
    if not sizes:
        return int(OutputConfig().pairs_per_shard)
    return min(max(1, SHARD_BYTES * len(sizes) // sum(sizes)), MAX_PAIRS_PER_SHARD)


def shards_warning(config: Config, sources: Sequence[Source]) -> str:
    """Return a warning about more than `MAX_SHARDS` shards, empty if there are fewer.

    Parameters
    ----------
    config : Config
        Validated config, with a number in ``output.pairs_per_shard``.
    sources : sequence of Source
        The listing.

    Returns
    -------
    str
        One sentence, with the number for shards of about `SHARD_BYTES`.
    """
    per_shard = config.output.pairs_per_shard
    shards = -(-len(sources) // per_shard)
    if shards <= MAX_SHARDS:
        return ""
    fitting = fitting_pairs_per_shard(config, sources)
    advice = f"; output.pairs_per_shard={fitting} gives shards of about 256 MB" if fitting > per_shard else ""
    return f"output.pairs_per_shard={per_shard}: {shards:,} shards; expected at most {MAX_SHARDS:,}{advice}"


def check_free_space(config: Config, tasks: Sequence[ShardTask], workers: int) -> None:
    """Raise MachineError if shards do not fit the free space of ``out``.

    Shards of an object store are in local temporary space until they are put, one for each worker.
    """
    needed, out = estimate_shards(config, tasks), any_path(config.out)
    if isinstance(out, ObjectPath):
        _check_temporary_space(needed.largest_shard * workers, out)
    elif needed.total > (free := free_bytes(out)):
        raise MachineError(
            f"out={out}: not enough disk space for {len(tasks)} shards; expected about {needed.total} free bytes "
            f"({needed.largest_shard} for the largest shard), found {free}; free space, choose another out, or set "
            "check_disk=false to start anyway"
        )


def _check_temporary_space(needed: int, out: ObjectPath) -> None:
    folder = Path(tempfile.gettempdir())
    if needed > (free := free_bytes(folder)):
        raise MachineError(
            f"out={out}: not enough temporary disk space in {folder}; expected about {needed} free bytes, one shard "
            f"for each worker, found {free}; free space, set TMPDIR, or set check_disk=false to start anyway"
        )


def _sampled_bytes(config: Config, sources: Sequence[Source], count: int) -> list[int]:
    """Bytes of at most ``count`` evenly spaced sources in their shards, 0 for sources that will fail."""
    sizes: list[int] = []
    sample = evenly_spaced(sources, count)
    with reading_ahead(config.source.place, read_bytes, sample) as read:
        for source in sample:
            size = 0
            with suppress(SourceError, MachineError):
                size = _size_in_shard(config, source, read)
            sizes.append(size)
    return sizes


def _size_in_shard(config: Config, source: Source, read: ReadFile) -> int:
    side, bits = config.source.downscale, 8
    if config.source.place is None:
        height, width = synthetic.SCENE_SIZES.get(source.path, synthetic.DEFAULT_SIZE)
    elif config.source.kind == "raw":
        height, width = load_source(config.source, source)[1].srgb.shape[:2]
        side = 1
    else:
        header = probe(read(config.source.place, source))
        if header.missing or header.width * header.height > config.source.max_pixels:
            return 0
        height, width, bits = header.height, header.width, header.bits
    return source_bytes(config, source.name, height // side, width // side, bits)
