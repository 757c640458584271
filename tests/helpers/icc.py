"""Write ICC profiles of matrix and curves, versions 2 and 4, byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from unprocess_gen.simulation.reference.primaries import PRIMARIES, primaries2xyz

ADOBE = 0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290
PROPHOTO = 0.734699, 0.265301, 0.159597, 0.840403, 0.036598, 0.000105, 0.345704, 0.358540
SRGB_PARAMETERS = 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045


def fixed(*numbers: float) -> bytes:
    """Numbers as s15Fixed16."""
    return b"".join(struct.pack(">i", round(number * 65536)) for number in numbers)


def para(kind: int, *numbers: float) -> bytes:
    return b"para\0\0\0\0" + struct.pack(">HH", kind, 0) + fixed(*numbers)


def curv(*values: int) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(f">I{len(values)}H", len(values), *values)


def named(text: str, version: int) -> bytes:
    if version == 2:
        return b"desc\0\0\0\0" + struct.pack(">I", len(text) + 1) + text.encode() + bytes(79)
    return b"mluc\0\0\0\0" + struct.pack(">II2s2sII", 1, 12, b"en", b"US", 2 * len(text), 28) + text.encode("utf-16-be")


def profile_of_tags(
    tags: dict[bytes, bytes], version: int = 4, space: bytes = b"RGB ", connection: bytes = b"XYZ "
) -> bytes:
    """A profile with these tags; equal ones share their bytes."""
    start, table, data = 132 + 12 * len(tags), b"", b""
    places: dict[bytes, int] = {}
    for name, content in tags.items():
        if content not in places:
            places[content] = start + len(data)
            data += content.ljust(-len(content) % 4 + len(content), b"\0")
        table += struct.pack(">4sII", name, places[content], len(content))
    head = struct.pack(">I4sI4s4s4s", start + len(data), b"lcms", version << 24, b"mntr", space, connection)
    head = head + bytes(12) + b"acsp" + bytes(28) + fixed(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


def tags_of(primaries: Sequence[float], *curves: bytes, name: str = "chart", version: int = 4) -> dict[bytes, bytes]:
    """Tags of a profile with these chromaticities (R, G, B, white) and one or three curves."""
    xyz = [*map(float, primaries2xyz(primaries))]
    columns = {b"%cXYZ" % c: b"XYZ \0\0\0\0" + fixed(*xyz[n::3]) for n, c in enumerate(b"rgb")}
    trcs = {b"%cTRC" % c: curve for c, curve in zip(b"rgb", (curves * 3)[:3], strict=True)}
    white = {b"wtpt": b"XYZ \0\0\0\0" + fixed(0.9642, 1, 0.8249)}
    return {b"desc": named(name, version), b"cprt": named("none", version), **white, **columns, **trcs}


def icc(primaries: Sequence[float], *curves: bytes, name: str = "chart", version: int = 4) -> bytes:
    return profile_of_tags(tags_of(primaries, *curves, name=name, version=version), version)


PROFILES = {
    "Display P3": icc(PRIMARIES["p3"], para(3, *SRGB_PARAMETERS), name="Display P3"),
    "Adobe RGB": icc(ADOBE, curv(563), name="Adobe RGB", version=2),
    "ProPhoto": icc(PROPHOTO, para(3, 1.8, 1, 0, 1 / 16, 1 / 32), name="ProPhoto"),
}
