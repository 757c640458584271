"""Compute the levels of the sites of a DNG from its tags (DNG Specification 1.7).

``docs/design/raw_files.md`` has the rule for each tag.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.errors import SourceError

Tags = Mapping[int, tuple[float, ...]]
"""Values of tags by code."""

LINEARIZATION_TABLE, REPEAT_DIM, BLACK_LEVEL, DELTA_H, DELTA_V, WHITE_LEVEL = 50712, 50713, 50714, 50715, 50716, 50717
MASKED_AREAS = 50830
OPCODE_LISTS = {51008: "OpcodeList1", 51009: "OpcodeList2", 51022: "OpcodeList3"}
FIX_VIGNETTE, GAIN_MAP, MAP_TABLE, SCALE_PER_COLUMN = 3, 9, 7, 13
"""Opcodes that change light; those from MapTable to ScalePerColumn all do."""


def black_levels(tags: Tags, height: int, width: int) -> NDArray[np.float64] | None:
    """Black levels from the first site of an active area on: [2, 2], or more sites if these do not repeat.

    None if they are to be measured on masked sites. Raises ValueError for another number of values than of sites.
    """
    stated = tags.get(BLACK_LEVEL)
    if stated is None and MASKED_AREAS in tags:
        return None
    black = (stated or (0.0,))[:: int(tags.get(277, (1,))[0])]  # of the first sample, if there are several
    rows, columns = map(int, tags.get(REPEAT_DIM, (2, 2) if len(black) == 4 else (1, 1)))
    if len(set(black)) == 1:
        black, rows, columns = black[:1], 1, 1
    down, across = _delta(tags.get(DELTA_V), height), _delta(tags.get(DELTA_H), width)
    is_cell = len(down) == len(across) == 1
    y, x = (np.arange(max(len(delta), 2 * period)) for delta, period in ((down, rows), (across, columns)))
    tile = np.reshape(black, (rows, columns))[np.ix_(y % rows, x % columns)]
    levels = tile + down[y % len(down), None] + across[x % len(across)]
    return levels[:2, :2] if is_cell and (tile == tile[np.ix_(y % 2, x % 2)]).all() else levels


def _delta(values: tuple[float, ...] | None, sites: int) -> NDArray[np.float64]:
    """Differences of black levels by row or by column; one number if all are equal."""
    delta = np.reshape(values or (0.0,) * sites, sites)
    return delta[:1] if (delta == delta[0]).all() else delta


def with_one_black(pixels: NDArray[np.uint16], black_dn: NDArray[np.float64], white_dn: float) -> NDArray[np.uint16]:
    """Lower each site by its black level above the lowest one, rounded to DN; sites at white stay there."""
    above = np.rint(black_dn - black_dn.min()).astype(np.uint16)
    y, x = (np.arange(side) % period for side, period in zip(pixels.shape, above.shape, strict=True))
    return pixels - np.where(pixels < white_dn, np.minimum(above[np.ix_(y, x)], pixels), np.uint16(0))


def white_level(tags: Tags, largest_dn: float) -> float:
    """White level: the tag's, else the largest value. SourceError if colours have different ones."""
    whites = set(tags.get(WHITE_LEVEL, ()))
    if len(whites) > 1:
        raise SourceError("unsupported", f"has the white levels {sorted(whites)}; expected one; convert it to NPY")
    return whites.pop() if whites else largest_dn


def unapplied_opcodes(tags: Tags) -> str:
    """Lists of opcodes that would change the light of the mosaic; empty without one."""
    lists = {}
    for code, name in OPCODE_LISTS.items():
        data = bytes(map(int, tags.get(code, (0, 0, 0, 0))))
        (count,), at = struct.unpack_from(">I", data), 4
        for _ in range(count):
            opcode, size = struct.unpack_from(">I8xI", data, at)
            at += 16 + size
            if opcode == GAIN_MAP:
                lists[name] = f"a GainMap in {name}"
            elif name != "OpcodeList3" and (opcode == FIX_VIGNETTE or MAP_TABLE <= opcode <= SCALE_PER_COLUMN):
                lists.setdefault(name, f"opcode {opcode} in {name}")
    return " and ".join(lists.values())
