"""Build the keys of manifest rows and samples, and group rows by them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from unprocess_gen.dataset.columns import Row, Value
from unprocess_gen.simulation.plan import Place


def key_text(index: int) -> str:
    """Key of the source with an index: eight digits; more from index 10^8 on."""
    return f"{index:08d}"


def patch_key(index: int, patch: int, several: bool) -> str:
    """Key of a sample in its shard: ``00000003``, or ``00000003-p0007`` if images are cut into several patches."""
    return f"{key_text(index)}-p{patch:04d}" if several else key_text(index)


def frame_key(sample: str, frame: int) -> str:
    """Key of a frame of a burst: the key of the burst, then for example ``-f02``."""
    return f"{sample}-f{frame:02d}"


def burst_key(key: str) -> str:
    """Key of the burst of a frame: the key of the frame without number, level and draw."""
    return key.partition("-f")[0]


def clip_identity(row: Row) -> tuple[Value, ...]:
    """Cells that the frames of one clip or burst share: clip, patch, level and draw."""
    return tuple(map(row.get, ("clip", "patch", "level", "draw")))


def pair_key(sample: str, place: Place, several: bool) -> str:
    """Key of a row: the sample's, with for example ``-l01d02`` for level 1, draw 2 if there are several frames."""
    return f"{sample}-l{place.level:02d}d{place.draw:02d}" if several else sample


def image_key(row: Row) -> str:
    """Key of a row's source: the digits of its key."""
    return str(row["key"]).partition("-")[0]


def sample_key(row: Row) -> str:
    """Key of a row's members in the shard: its key without level and draw."""
    return str(row["key"]).partition("-l")[0]


def group_by_image(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Group consecutive rows of one source."""
    return (list(group) for _, group in itertools.groupby(rows, key=image_key))


def group_by_sample(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Group consecutive rows of one sample: a clean frame and its noisy frames."""
    return (list(group) for _, group in itertools.groupby(rows, key=sample_key))
