"""Estimate the bytes of pairs from the size of a few sources, and refuse a run that does not fit the disk."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from unprocess_gen.config.interpretation import burst_rule, patch_rule
from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import MachineError, SourceError
from unprocess_gen.core.files import free_bytes
from unprocess_gen.core.object_store import ObjectPath
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.source import Source
from unprocess_gen.simulation.conditions import noisy_frames
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.sources import synthetic
from unprocess_gen.sources.image.headers import probe
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.patches import list_patches
from unprocess_gen.sources.reading import read_bytes

HEADERS_READ = 8
"""Sources whose sizes are read before a run; the others are taken to be as large as their mean."""

OTHER_BYTES = 8000
"""Bytes of a pair in a shard without its arrays: the row as JSON, and headers."""


def source_bytes(config: Config, height: int, width: int) -> int:
    """Bytes of the pairs of a source with these sides after ``source.downscale``: arrays, and 8 kB a pair."""
    output, pairs = config.output, noisy_frames(config)
    rule, burst = patch_rule(config.source), burst_rule(config.source)
    if rule is not None and rule.kind == "random" and burst is None:  # places change no size
        patches: Sequence[Patch] = [Patch(rule.side, rule.side)] * rule.count
    else:
        patches = list_patches(rule, 0, height, width, output.layout, burst=burst)
    frames, step = (1, 1) if burst is None else (burst.frames, burst.downscale)
    clean, noisy = (np.dtype(name).itemsize for name in (output.clean_dtype or output.dtype, output.dtype))
    target = len(output.targets) * 3 * np.dtype(np.float32).itemsize * step**2
    sites = sum(patch.height * patch.width for patch in patches)
    samples = frames * (sites * (clean + pairs * noisy) + len(patches) * pairs * OTHER_BYTES)
    return (samples + sites * target) * output.frames


def check_free_space(config: Config, sources: Sequence[Source]) -> None:
    """Raise MachineError if the pairs of sources do not fit the free space of ``out``; of an object store, never."""
    out = any_path(config.out)
    if isinstance(out, ObjectPath) or not sources:
        return
    sample = [source_bytes(config, *_sides(config, source)) for source in evenly_spaced(sources, HEADERS_READ)]
    needed, free = sum(sample) * len(sources) // len(sample), free_bytes(out)
    if needed > free:
        raise MachineError(
            f"out={out}: not enough disk space for {len(sources)} sources; expected about {needed} free bytes, found "
            f"{free}; free space, choose another out, or set check_disk=false to start anyway"
        )


def _sides(config: Config, source: Source) -> tuple[int, int]:
    """Height and width of a source after ``source.downscale``; 0 if it will fail."""
    with suppress(SourceError, MachineError):
        if config.source.place is None:
            return synthetic.DEFAULT_SIZE
        if config.source.kind != "srgb":
            height, width = load_source(config.source, source)[1].srgb.shape[:2]
            return height, width
        header = probe(read_bytes(config.source.place, source))
        return header.height // config.source.downscale, header.width // config.source.downscale
    return 0, 0
