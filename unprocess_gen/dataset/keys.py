"""Write, read and select the keys of manifest rows."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from unprocess_gen.core.types import Patch, Plan, Row


def key_text(index: int) -> str:
    """Return the key of a source: eight digits (more, should there be more than 10⁸ sources)."""
    return f"{index:08d}"


def patch_key(index: int, patch: Patch, several: bool) -> str:
    """Return the key of a sample in its shard: that of its source, and the patch where images are cut in ``several``.

    Four digits, more where there are more patches.
    """
    return f"{key_text(index)}-p{patch.number:04d}" if several else key_text(index)


def pair_key(sample: str, plan: Plan, several: bool) -> str:
    """Return the key of a row: that of its sample, and the level and draw where the sample has ``several`` pairs."""
    return f"{sample}-l{plan.level:02d}d{plan.draw:02d}" if several else sample


def image_key(row: Row) -> str:
    """Return the key of a row's image."""
    return str(row["key"]).partition("-")[0]


def sample_key(row: Row) -> str:
    """Return the key of a row's members in the shard: that of its image, or of its patch."""
    return str(row["key"]).partition("-l")[0]


def group_by_image(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield the rows of one image together, in order."""
    return (list(some) for _, some in itertools.groupby(rows, key=image_key))


def group_by_sample(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Yield the rows of one sample, a clean frame with its noisy ones, together, in order."""
    return (list(some) for _, some in itertools.groupby(rows, key=sample_key))
