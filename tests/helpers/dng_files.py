"""DNG files of any layout, written byte by byte, with lossless JPEG data."""

from __future__ import annotations

import itertools
import struct
from typing import Any

import numpy as np

HEIGHT, WIDTH, BLACK, WHITE = 64, 96, 256, 4095
LIGHT = np.linspace(0.01, 0.72, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
"""Light of `DN`: 0 at black, 1 at white."""
DN = np.rint(BLACK + LIGHT * (WHITE - BLACK) + np.random.default_rng(1).normal(0, 2, LIGHT.shape)).astype(np.uint16)
MATRIX = (0.8924, -0.1041, -0.1760, -0.6351, 1.5237, 0.1084, -0.0712, 0.1989, 0.6202)
NEUTRAL = (0.5, 1.0, 0.7)
FILE_TAGS = {50706: (1, (1, 4, 0, 0)), 50721: (10, MATRIX), 50728: (5, NEUTRAL), 50778: (3, (21,))}
LEVELS = {50714: (4, (BLACK,)), 50717: (4, (WHITE,))}
"""Tags by code: type and values."""
CODE_COUNTS = (0, 1, 4, 2, 3, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0)
"""Codes of 1 to 16 bits, one for each number of bits that a difference can have, 0 to 16."""
LENGTHS = np.repeat(np.arange(1, 17), CODE_COUNTS)
CODES = [
    f"{int((2.0 ** -LENGTHS[:n]).sum() * 2 ** int(length)):0{length}b}" for n, length in enumerate(LENGTHS.tolist())
]

Tags = dict[int, tuple[int, Any]]
Image = tuple[Tags, list[bytes]]
"""Tags of an image, and its strips or tiles."""


def lossless_jpeg(pixels: np.ndarray, components: int = 1) -> bytes:
    """Encode pixels as lossless JPEG of 16 bits with the left neighbour as predictor."""
    rows = pixels.astype(int).reshape(len(pixels), -1, components)
    above = np.vstack([np.full((1, components), 2**15), rows[:-1, 0]])
    differences = rows - np.concatenate([above[:, None], rows[:, :-1]], axis=1)
    bits = "".join(
        CODES[n := abs(d).bit_length()] + (f"{d if d > 0 else d + 2**n - 1:0{n}b}" if n else "")
        for d in differences.ravel().tolist()
    )
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    huffman = struct.pack(">HB16B17B", 36, 0, *CODE_COUNTS, *range(17))
    frame = struct.pack(">HBHHB", 8 + 3 * components, 16, *rows.shape) + bytes([1, 17, 0] * components)
    scan = struct.pack(">HB", 6 + 2 * components, components) + bytes([1, 0] * components) + b"\1\0\0"
    return b"\xff\xd8\xff\xc4" + huffman + b"\xff\xc3" + frame + b"\xff\xda" + scan + data + b"\xff\xd9"


def image(
    pixels: np.ndarray = DN,
    tags: Tags | None = None,
    photometric: int = 32803,
    reduced: int = 0,
    side: int = 0,
    rows: int = 0,
    encode: Any = None,
    compression: int = 1,
) -> Image:
    """An image in tiles of a side, or in strips of rows; integers are stored in 16 bits; a tag of None is left out."""
    pixels = pixels.astype(np.uint16) if pixels.dtype == int else pixels
    height, width = pixels.shape[:2]
    tall, wide = (side, side) if side else (rows or height, width)
    edge = np.pad(
        pixels, [(0, -height % tall if side else 0), (0, -width % wide), *[(0, 0)] * (pixels.ndim - 2)], "edge"
    )
    parts = [edge[y : y + tall, x : x + wide] for y in range(0, height, tall) for x in range(0, width, wide)]
    own: Tags = {
        254: (4, (reduced,)), 256: (4, (width,)), 257: (4, (height,)),
        258: (3, (pixels.itemsize * 8,) * edge[0, 0].size),
        259: (3, (compression,)), 262: (3, (photometric,)), 277: (3, (edge[0, 0].size,)), **LEVELS,
        **({322: (4, (side,)), 323: (4, (side,))} if side else {278: (4, (tall,))}),
        **({33421: (3, (2, 2)), 33422: (1, (0, 1, 1, 2))} if photometric == 32803 else {}),
    }  # fmt: skip
    return own | (tags or {}), [(encode or np.ndarray.tobytes)(np.ascontiguousarray(part)) for part in parts]


def dng(*images: Image, gap: int = 0) -> bytes:
    """A DNG of images, all but the first as SubIFDs; ``gap`` bytes follow each strip or tile."""
    content, places = bytearray(b"II*\0" + bytes(4)), list[int]()

    def put(data: bytes) -> int:
        content.extend(bytes(len(content) % 2) + data)
        return len(content) - len(data)

    for number, (own, parts) in reversed(list(enumerate(images))):
        tags = own if number else FILE_TAGS | own | ({330: (4, tuple(places[::-1]))} if places else {})
        starts = tuple(put(part + bytes(gap)) for part in parts)
        where = (324, 325) if 322 in tags else (273, 279)
        tags = tags | {where[0]: (4, starts), where[1]: (4, tuple(map(len, parts)))}
        entries = b""
        for code, (kind, values) in sorted((code, tag) for code, tag in tags.items() if tag is not None):
            if kind in (5, 10):
                data = struct.pack(
                    f"<{len(values) * 2}{'iI'[kind == 5]}",
                    *itertools.chain(*((round(v * 10000), 10000) for v in values)),
                )
            else:
                data = struct.pack(f"<{len(values)}{'xBxHIxxBxxxxd'[kind]}", *values)
            field = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", put(data))
            entries += struct.pack("<HHI", code, kind, len(values)) + field
        places.append(put(struct.pack("<H", len(entries) // 12) + entries + bytes(4)))
    content[4:8] = struct.pack("<I", places[-1])
    return bytes(content)
