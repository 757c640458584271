"""Check that lossless JPEG data are complete (ITU-T T.81, process 14).

LibRaw decodes data that end early, or whose codes were altered, without a report. Altered codes nearly always change
the number of samples, so that the last one does not end at the end marker. Checking takes a quarter of the time of
decoding.
"""

from __future__ import annotations

import functools
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.simulation.kernels.jit import kernel

HUFFMAN_TABLES, FRAME, SCAN, RESTART_INTERVAL = 0xC4, 0xC3, 0xDA, 0xDD
"""Markers of segments. Other codecs have other frames; no DNG is known with restart intervals."""


def line_samples(data: bytes) -> tuple[int, int, int] | None:
    """Lines, samples of a line and components; zeros if the data do not end properly, None for other JPEG data."""
    at, tables, size = 2, dict[int, NDArray[np.uint8]](), (0, 0, 0)
    try:
        while True:
            marker, length = struct.unpack_from(">xBH", data, at)
            body, at = data[at + 4 : at + 2 + length], at + 2 + length
            if marker == HUFFMAN_TABLES:
                tables |= _tables(body)
            elif marker == FRAME:
                size = struct.unpack_from(">xHHB", body)
            elif 0xC0 <= marker <= 0xCF or marker == RESTART_INTERVAL:
                return None
            elif marker == SCAN:
                components = np.stack([tables[code >> 4] for code in body[2 : 1 + 2 * body[0] : 2]])
                break
        sites = size[0] * size[1]
        is_whole = len(components) == size[2] and _ends(np.frombuffer(data, np.uint8), at, sites, components)
    except (struct.error, IndexError, KeyError, ValueError):
        return 0, 0, 0
    return (size[0], size[1] * size[2], size[2]) if is_whole else (0, 0, 0)


@functools.lru_cache(maxsize=8)
def _tables(body: bytes) -> dict[int, NDArray[np.uint8]]:
    """Bits of code and difference that each 16 bits begin with, or 0 if they begin with no code, by number of table."""
    tables, at = {}, 0
    while at < len(body):
        lengths = np.repeat(np.arange(1, 17), list(body[at + 1 : at + 17]))
        bits = lengths + np.frombuffer(body, np.uint8, len(lengths), at + 17) % 16  # 16: the difference is 32768
        codes = np.repeat(bits, 1 << 16 - lengths)
        tables[body[at] & 15] = np.pad(codes, (0, 2**16 - len(codes))).astype(np.uint8)
        at += 17 + len(lengths)
    return tables


@kernel
def _ends(data: Any, at: int, sites: int, tables: Any) -> bool:
    """True if the end marker follows the last sample; each site has a sample for each table."""
    bits, held, missing = np.uint64(0), 0, 0  # bits held, of which the last ones are missing
    for _ in range(sites):
        for component in range(len(tables)):
            while held < 32:
                byte = np.uint64(0)
                if at < data.size and data[at] != 0xFF:
                    byte, at = np.uint64(data[at]), at + 1
                elif at + 1 < data.size and data[at + 1] == 0:
                    byte, at = np.uint64(0xFF), at + 2
                else:
                    missing += 8
                bits, held = (bits << np.uint64(8)) | byte, held + 8
            used = tables[component, (bits >> np.uint64(held - 16)) & np.uint64(0xFFFF)]
            held -= used
            if used == 0 or held < missing:
                return False
    while at + 2 < data.size and data[at] == data[at + 1] == 0xFF:
        at += 1
    return held - missing < 8 and at + 1 < data.size and data[at] == 0xFF and data[at + 1] == 0xD9
