"""Number files of equal content, so that identical photographs get different noise."""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from unprocess_gen.core.errors import SourceError
from unprocess_gen.core.paths import any_path
from unprocess_gen.core.types import Source
from unprocess_gen.sources.reading import opened

TAIL_BYTES = 4096
"""Bytes at the end of a file that `number_twins` reads first. The ends of photographs of one size nearly always differ;
their beginnings, which hold the metadata of a camera, often do not."""


def number_twins(root: str, sources: Sequence[Source]) -> tuple[Source, ...]:
    """Assign files of equal content the numbers 0, 1, … in listing order (``occurrence``).

    Files of one size are compared by their last `TAIL_BYTES`. Only files that share size and tail are read completely;
    their ``sha256`` is kept. A file that cannot be read keeps number 0, since it has no pixels to distinguish. Raises
    MachineError if a file has another size than when it was listed.
    """
    by_size: dict[int, list[Source]] = {}
    for source in sources:
        if source.size_bytes is not None:
            by_size.setdefault(source.size_bytes, []).append(source)
    groups = [group for group in by_size.values() if len(group) > 1]
    candidates = list(_sharing_tails(root, groups))
    digests = any_path(root).map(partial(_digest, root), candidates)
    numbered, seen = {source.index: source for source in sources}, Counter[str]()
    for source, digest in zip(candidates, digests, strict=True):
        if digest is not None:
            numbered[source.index] = replace(source, occurrence=seen[digest], sha256=digest)
            seen[digest] += 1
    return tuple(numbered.values())


def _sharing_tails(root: str, groups: Iterable[Sequence[Source]]) -> Iterator[Source]:
    """Yield the sources whose last bytes equal the last bytes of another source of their group, group by group."""
    groups = list(groups)
    tails = any_path(root).map(partial(_tail_digest, root), itertools.chain.from_iterable(groups))
    for group in groups:
        pairs = list(zip(group, itertools.islice(tails, len(group)), strict=True))
        counts = Counter(tail for _, tail in pairs)
        yield from (source for source, tail in pairs if tail is not None and counts[tail] > 1)


def _tail_digest(root: str, source: Source) -> str | None:
    """Digest of a file's last `TAIL_BYTES`, None if it cannot be read."""
    return _digest(root, source, max(0, (source.size_bytes or 0) - TAIL_BYTES))


def _digest(root: str, source: Source, first: int = 0) -> str | None:
    """SHA-256 of a file from a byte on, None if it cannot be read."""
    with suppress(SourceError), opened(root, source, first) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    return None
