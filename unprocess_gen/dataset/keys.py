"""Build the keys of manifest rows and samples, and group rows by them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from unprocess_gen.dataset.columns import Row
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.plan import Plan


def key_text(index: int) -> str:
    """Return the key of a source.

    Parameters
    ----------
    index : int
        Position of the source in the listing, from 0.

    Returns
    -------
    str
        Eight digits; more from index 10^8 on.
    """
    return f"{index:08d}"


def patch_key(index: int, patch: Patch, several: bool) -> str:
    """Return the key of a sample in its shard.

    Parameters
    ----------
    index : int
        Position of the source in the listing.
    patch : Patch
        Part of the source.
    several : bool
        Whether images are cut into patches.

    Returns
    -------
    str
        ``00000003``, or ``00000003-p0007`` for a patch; more digits from patch 10000 on.
    """
    return f"{key_text(index)}-p{patch.number:04d}" if several else key_text(index)


def pair_key(sample: str, plan: Plan, several: bool) -> str:
    """Return the key of a row.

    Parameters
    ----------
    sample : str
        Key of the sample (`patch_key`).
    plan : Plan
        Plan with level and draw.
    several : bool
        Whether the sample has several noisy frames.

    Returns
    -------
    str
        The sample's key, with for example ``-l01d02`` for level 1, draw 2.
    """
    return f"{sample}-l{plan.place.level:02d}d{plan.place.draw:02d}" if several else sample


def image_key(row: Row) -> str:
    """Return the key of a row's source.

    Parameters
    ----------
    row : Row
        Manifest row.

    Returns
    -------
    str
        The digits of its key.
    """
    return str(row["key"]).partition("-")[0]


def sample_key(row: Row) -> str:
    """Return the key that a row's members have in the shard.

    Parameters
    ----------
    row : Row
        Manifest row.

    Returns
    -------
    str
        Its key without level and draw.
    """
    return str(row["key"]).partition("-l")[0]


def group_by_image(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Group consecutive rows of one source.

    Parameters
    ----------
    rows : iterable of Row
        Rows in manifest order.

    Returns
    -------
    iterator of list of Row
        The rows of each source.
    """
    return (list(group) for _, group in itertools.groupby(rows, key=image_key))


def group_by_sample(rows: Iterable[Row]) -> Iterator[list[Row]]:
    """Group consecutive rows of one sample: a clean frame and its noisy frames.

    Parameters
    ----------
    rows : iterable of Row
        Rows in manifest order.

    Returns
    -------
    iterator of list of Row
        The rows of each sample.
    """
    return (list(group) for _, group in itertools.groupby(rows, key=sample_key))
