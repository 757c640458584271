"""Odd raw files are read rightly, are refused with a reason, or carry a note."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from helpers.cases import slow_except
from helpers.commands import RunMain
from helpers.datasets import samples_json, text_rows
from helpers.dng_files import BLACK, DN, HEIGHT, LIGHT, MATRIX, NEUTRAL, WHITE, WIDTH, dng, image, lossless_jpeg

from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.reference.cfa import plane_sites
from unprocess_gen.sources.image.decode import Photograph
from unprocess_gen.sources.raw.frames import read_raw_source

JPEG: dict[str, Any] = {"side": 32, "encode": lossless_jpeg, "compression": 7}
TWO: dict[str, Any] = {**JPEG, "encode": lambda part: lossless_jpeg(part, 2)}
FLAT: dict[str, Any] = {**JPEG, "side": 0}
RISE = np.arange(HEIGHT)[:, None] % 7 * 8
"""DN that differ by row."""


def damaged(start: float, end: float, word: Callable[[bytes], bytes], **layout: Any) -> bytes:
    """Return a DNG of lossless JPEG data, parts of whose last strip or tile are changed."""
    tags, parts = image(**(layout or JPEG))
    first, last = (int(len(parts[-1]) * place) for place in (start, end))
    parts[-1] = parts[-1][:first] + word(parts[-1][first:last]) + parts[-1][last:]
    return dng((tags, parts))


def tagged(code: int, kind: int, *values: float, pixels: np.ndarray = DN, **layout: Any) -> bytes:
    """Return a DNG with another tag."""
    return dng(image(pixels, {code: (kind, values)}, **layout))


def tile(*levels: int, sides: tuple[int, int]) -> bytes:
    """Return a DNG whose black levels repeat after some rows and columns."""
    y, x = np.ogrid[:HEIGHT, :WIDTH]
    above = np.reshape(levels, sides)[y % sides[0], x % sides[1]] - BLACK
    return dng(image(DN + above, {50713: (3, sides), 50714: (4, levels)}))


def framed(tags: dict[int, Any], above: Any = 0) -> bytes:
    """Return a DNG with masked borders: 3 rows above and 5 columns left of the active area."""
    stored = np.full((HEIGHT + 4, WIDTH + 6), 77, np.uint16)
    stored[3:-1, 5:-1] = DN + above
    return dng(image(stored, {50829: (4, (3, 5, 3 + HEIGHT, 5 + WIDTH)), **tags}))


def opcodes(code: int, *numbers: int) -> bytes:
    """Return a DNG with a list of opcodes."""
    each = (struct.pack(">4I4x", number, 0x1030000, 0, 4) for number in numbers)
    return tagged(code, 7, *struct.pack(">I", len(numbers)), *b"".join(each))


def deltas(code: int, values: Any) -> dict[int, Any]:
    return {code: (10, tuple(np.ravel(values).tolist()))}


def with_white(pixels: np.ndarray, white: float | None) -> bytes:
    return dng(image(pixels, {50717: None if white is None else (4, (white,))}))


def of_12_bits(pixels: np.ndarray) -> bytes:
    """Encode pixels as lossless JPEG, and state 12 bits."""
    return lossless_jpeg(pixels).replace(b"\xff\xc3\0\x0b\x10", b"\xff\xc3\0\x0b\x0c")


SMALL, RGB = DN[::2, ::2] // 4, np.repeat(DN[::4, ::4, None] // 16, 3, axis=2)
PREVIEW = image(RGB.astype(np.uint8), {50714: (4, (9,)), 50717: (4, (255,))}, photometric=2, reduced=1)
REDUCED = image(SMALL, {50714: (4, (64,)), 50717: (4, (1023,))}, reduced=1)
LARGER = image(np.tile(DN, (2, 2)), {50714: (4, (64,))}, reduced=1)
TABLE = np.arange(65536) // 2
ONE = np.zeros(DN.shape, int)
ONE[5, 5] = 9000

KINDS: dict[str, dict[str, tuple[Callable[[], bytes], str]]] = {
    "layouts": {
        "lossless JPEG": (lambda: dng(image(**JPEG)), ""),
        "two components": (lambda: dng(image(**TWO)), ""),
        "tiles apart": (lambda: dng(image(side=32), gap=64), ""),
        "strips": (lambda: dng(image(rows=16)), ""),
        "strips apart": (lambda: dng(image(rows=16), gap=64), "unsupported"),
        "compressed strips": (lambda: dng(image(rows=16, encode=lossless_jpeg, compression=7)), "unsupported"),
        "moved sites": (lambda: tagged(50975, 3, 2), "unsupported"),
        "other order of bits": (lambda: tagged(266, 3, 2), "unsupported"),
        "half as wide, two components": (lambda: dng(image(**TWO | {"side": 48})), "unsupported"),
        "wide tiles": (lambda: dng(image(side=112)), "unsupported"),
        "cut tiles": (lambda: dng(image(**JPEG | {"encode": lambda part: lossless_jpeg(part[:, :30])})), "unsupported"),
    },
    "damage": {
        "zeros": (lambda: damaged(0.5, 1, lambda part: bytes(len(part)), **FLAT), "corrupt"),
        "zeros in a tile": (lambda: damaged(0.3, 0.6, lambda part: bytes(len(part))), "corrupt"),
        "flipped": (lambda: damaged(0.3, 0.7, lambda part: bytes(byte ^ 0x5A for byte in part)), "corrupt"),
        "half as wide": (lambda: damaged(0.99, 1, lambda part: part[:-2], **TWO | {"side": 48}), "corrupt"),
        "end marker": (lambda: damaged(0.99, 1, lambda part: part[:-2]), "corrupt"),
        "cut tile": (lambda: damaged(0.8, 1, lambda part: b""), "corrupt"),
        "hole": (lambda: damaged(0.5, 0.6, lambda part: b""), "corrupt"),
        "rows of zeros": (lambda: dng(image(np.where(RISE > 40, 0, DN))), "corrupt"),
        "tile of zeros": (lambda: dng(image(np.where(np.arange(WIDTH) < 64, DN, 0))), "corrupt"),
        "more than 12 bits": (lambda: dng(image(DN + RISE * 200, **JPEG | {"encode": of_12_bits})), "corrupt"),
        "no tile": (lambda: damaged(0, 1, lambda part: b""), "corrupt"),
        "short strip": (lambda: dng(image(encode=lambda part: part.tobytes()[:-500])), "corrupt"),
        "site above the bits": (lambda: dng(image(DN + ONE)), "corrupt"),
        "rows above white": (lambda: with_white(np.where(RISE > 40, 4090, DN), 4000), "corrupt"),
        "cut file": (lambda: dng(image())[:HEIGHT * WIDTH], "corrupt"),
    },
    "black by row and column": {
        "constant V": (lambda: dng(image(tags={50714: (4, (0,)), **deltas(50716, [BLACK] * HEIGHT)})), ""),
        "constant H": (lambda: dng(image(tags={50714: (4, (300,)), **deltas(50715, [-44] * WIDTH)})), ""),
        "V": (lambda: dng(image(DN + RISE, deltas(50716, RISE))), "differ by site"),
        "H": (lambda: dng(image(DN + np.tile([0, 8], WIDTH // 2), deltas(50715, np.arange(WIDTH) % 2 * 8))),
              "differ by site"),
        "V of an active area": (lambda: framed(deltas(50716, RISE), RISE), "differ by site"),
        "too few": (lambda: dng(image(tags=deltas(50716, RISE[:-1]))), "corrupt"),
    },
    "black tiles": {
        "4 x 4": (lambda: tile(*range(256, 320, 4), sides=(4, 4)), "differ by site"),
        "4 x 4 of 2 x 2": (lambda: tile(*[256, 258, 256, 258, 260, 262, 260, 262] * 2, sides=(4, 4)), ""),
        "1 x 2": (lambda: tile(256, 260, sides=(1, 2)), ""),
        "3 x 3": (lambda: tile(*range(256, 265), sides=(3, 3)), "differ by site"),
        "6 x 6 of one level": (lambda: tile(*[256] * 36, sides=(6, 6)), ""),
        "8 x 8 of two": (lambda: tile(*[256, 260] * 32, sides=(8, 8)), ""),
        "too few": (lambda: dng(image(tags={50713: (3, (2, 2)), 50714: (4, (256, 257, 258))})), "corrupt"),
        "masked areas only": (lambda: framed({50714: None, 50830: (4, (0, 0, 3, 9))}), "unsupported"),
    },
    "white and tables": {
        "table": (lambda: dng(image(DN * np.uint16(2), {50712: (3, TABLE.tolist())})), ""),
        "table of compressed sites": (lambda: dng(image(DN * np.uint16(2), {50712: (3, TABLE.tolist())}, **JPEG)), ""),
        "no white": (lambda: with_white(DN * np.uint16(16), None), "states no WhiteLevel; 65535 DN is assumed"),
        "hot site of 14 bits": (lambda: dng(image(DN + ONE, {258: (3, (14,))}, **JPEG)), ""),
        "white far above": (lambda: with_white(DN, 16383), "far below the white level 16383"),
        "white of each colour": (lambda: tagged(50717, 4, 4095, 4000, 4095), "unsupported"),
        "one white of each colour": (lambda: tagged(50717, 4, 4095, 4095, 4095), ""),
    },
    "several images": {
        "reduced first": (lambda: dng(PREVIEW, REDUCED, image()), ""),
        "reduced last": (lambda: dng(PREVIEW, image(), REDUCED), ""),
        "reduced is larger": (lambda: dng(PREVIEW, LARGER, image()), ""),
        "reduced is first of all": (lambda: dng(REDUCED, image()), ""),
        "linear reduced": (lambda: dng(PREVIEW, image(RGB, {50714: None}, photometric=34892, reduced=1), image()), ""),
        "linear first": (lambda: dng(PREVIEW, image(RGB, {50714: None}, photometric=34892), image()), "unsupported"),
    },
    "opcodes": {
        "GainMap": (lambda: opcodes(51009, 9, 9), "has a GainMap in OpcodeList2"),
        "GainMap after demosaicking": (lambda: opcodes(51022, 1, 9), "has a GainMap in OpcodeList3"),
        "table": (lambda: opcodes(51008, 4, 7), "has opcode 7 in OpcodeList1"),
        "warp": (lambda: opcodes(51022, 1, 3), ""),
        "cut list": (lambda: tagged(51009, 7, 0, 0, 0, 9, 1), "corrupt"),
    },
    "colours": {
        "cyan, magenta, yellow": (lambda: tagged(50710, 1, 3, 4, 5), "unsupported"),
        "four": (lambda: tagged(50710, 1, 0, 1, 2, 3), "unsupported"),
    },
    "formats": {
        "deflate": (lambda: dng(image(encode=zlib.compress, compression=8)), "unsupported"),
        "LZW": (lambda: dng(image(compression=5)), "unsupported"),
        "signed": (lambda: tagged(339, 3, 2), "unsupported"),
        "32 bits": (lambda: dng(image(DN.astype(np.uint32))), "unsupported"),
        "JPEG": (lambda: b"\xff\xd8\xff\xe0" + bytes(99), "unsupported"),
        "HEIF": (lambda: b"\0\0\0\x18ftypheic" + bytes(99), "unsupported"),
        "TIFF": (lambda: dng(image(photometric=1, tags={50706: None})), "unsupported"),
        "Git LFS": (lambda: b"version https://git-lfs.github.com/spec/v1\nsize 9\n", "unsupported"),
        "text": (lambda: b"nothing" * 99, "corrupt"),
        "headerless": (DN.tobytes, "unsupported"),
    },
}  # fmt: skip
CASES = [(kind, case) for kind, cases in KINDS.items() for case in cases]
QUICK = [(kind, next(iter(cases))) for kind, cases in KINDS.items()]


def read(content: bytes, name: str = "a.dng", **settings: Any) -> Photograph:
    return read_raw_source(SourceConfig(kind="raw", **settings), content, name)


def light_error(photograph: Photograph) -> float:
    """Return the largest difference of the light of a frame from `LIGHT`."""
    assert photograph.raw is not None
    source, found = photograph.raw.source, np.zeros(LIGHT.shape)
    levels = zip(plane_sites(source.raw_pattern), source.raw_black_dn, source.raw_white_dn, strict=True)
    for (y, x), black, white in levels:
        found[y::2, x::2] = (photograph.srgb[y::2, x::2, 0].astype(float) - black) / (white - black)
    return float(np.abs(found - LIGHT).max())


@pytest.mark.parametrize(("kind", "case"), slow_except(QUICK, CASES))
def test_odd_file_is_right_or_refused(kind: str, case: str, capfd: Any) -> None:
    make, expected = KINDS[kind][case]
    if expected in ("corrupt", "unsupported"):
        with pytest.raises(SourceError) as error:
            read(make(), "a.raw" if case == "headerless" else "a.dng")
        assert (error.value.reason, capfd.readouterr().err) == (expected, ""), error.value.text
        return
    photograph = read(make())
    assert expected in photograph.note and bool(expected) == bool(photograph.note)
    assert light_error(photograph) < 0.003 or "white" in expected.lower() or "hot" in case


@pytest.mark.slow
@pytest.mark.parametrize("count", [64, 300])
def test_damage_is_found_wherever_it_is(count: int) -> None:
    rng, (tags, parts) = np.random.default_rng(count), image(**JPEG)
    for number in rng.integers(len(parts), size=60).tolist():
        part = bytearray(parts[number])
        start = int(rng.integers(100, len(part) - count))
        part[start : start + count] = rng.bytes(count)
        with pytest.raises(SourceError):
            read(dng((tags, [*parts[:number], bytes(part), *parts[number + 1 :]])))


@pytest.mark.parametrize("colours", slow_except(["BGR"], ["BGR", "GRB", "GBR", "RBG", "BRG"]))
def test_colours_follow_the_order_of_planes(colours: str) -> None:
    order = ["RGB".index(colour) for colour in colours]
    rows, noise = np.reshape(MATRIX, (3, 3)), np.reshape([1e-4, 1e-7, 4e-4, 4e-7, 3e-4, 3e-7], (3, 2))
    own = {50721: (10, rows[[*order]].ravel()), 50728: (5, [NEUTRAL[plane] for plane in order])}
    found = read(dng(image(tags={50710: (1, order), **own, 51041: (12, noise[[*order]].ravel())}))).raw
    expected = read(dng(image(tags={51041: (12, noise.ravel())}))).raw
    assert found is not None and expected is not None
    assert found.camera == expected.camera and found.noise == expected.noise == pytest.approx((3e-4, 3e-7))
    assert (found.camera.red_gain, found.camera.blue_gain) == pytest.approx((2.0, 1 / 0.7))


def test_file_without_exposure_is_read() -> None:
    end = len(tagged(34665, 4, 0))
    exif = struct.pack("<HHHII4x2I", 1, 33434, 5, 1, end + 18, 0, 0)
    assert light_error(read(tagged(34665, 4, end) + exif)) < 0.003


NOISE = {
    "2": ((1e-4, 1e-6), True), "6": ((1e-4, 1e-6) * 3, True), "8": ((1e-4, 1e-6) * 4, True), "none": ((), False),
    "4": ((1e-4, 1e-6) * 2, False), "negative": ((1e-4, -1e-6), False), "one negative": ((-1e-4, 1e-6) * 3, False),
    "NaN": ((float("nan"), 1e-6), False), "infinite": ((float("inf"), 1e-6), False), "zero": ((0.0, 0.0), False),
}  # fmt: skip


@pytest.mark.parametrize("case", NOISE)
def test_own_noise_is_subtracted_or_the_file_is_refused(case: str) -> None:
    values, is_used = NOISE[case]
    content = tagged(51041, 12, *values) if values else dng(image())
    if is_used:
        found = read(content, own_noise="subtract").raw
        assert found is not None and found.noise == pytest.approx((1e-4, 1e-6))
        return
    with pytest.raises(SourceError, match=r"no noise that source\.own_noise=subtract could use .*source\.raw\.a_dn"):
        read(content, own_noise="subtract")
    assert read(content, own_noise="subtract", raw=RawConfig(a_dn=1, b_dn2=4)).raw is not None


def test_pgm_of_dcraw_is_read() -> None:
    raw, header = RawConfig("RGGB", BLACK, WHITE), b"P5\n# dcraw\n%d %d\n%d\n"
    content = header % (WIDTH, HEIGHT, 65535) + DN.astype(">u2").tobytes()
    assert light_error(read(content, "a.pgm", raw=raw)) < 0.003
    refused = {
        "truncated": content[:-1],
        "unsupported": header % (WIDTH, HEIGHT, 255) + bytes(DN.size),
        "corrupt": header % (WIDTH, HEIGHT, 1023) + DN.astype(">u2").tobytes(),
    }
    for reason, data in refused.items():
        with pytest.raises(SourceError) as error:
            read(data, "a.pgm", raw=raw)
        assert error.value.reason == reason


# ------------------------------------------------------------------------------------------------------------ commands


def test_notes_are_in_rows_summary_and_plan(run_main: RunMain, tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "a.dng").write_bytes(opcodes(51009, 9))
    (tmp_path / "frames" / "b.dng").write_bytes(dng(image()))
    settings, note = ("source.kind=raw", "source.root=frames", "noise=none"), "has a GainMap in OpcodeList2"
    assert f"note      a.dng {note}" in run_main("plan", *settings).out
    done = run_main(*settings, "out=ds", "n_jobs=1")
    assert done.code == 0 and f"a.dng {note}" in done.err and "1 noted (column detail)" in done.out + done.err
    rows = text_rows(tmp_path / "ds")
    assert [row["detail"].startswith(note) for row in rows] == [True, False]
    assert [row.get("detail", "")[: len(note)] for row in samples_json(tmp_path / "ds").values()] == [note, ""]


def test_sites_above_the_level_of_libraw_are_noted_and_regenerated(run_main: RunMain, tmp_path: Path) -> None:
    """A raw file that states no level, of a camera of whose table LibRaw has 3692 DN; a row records that level."""
    (tmp_path / "frames").mkdir()
    bayer = (33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True)
    model = (271, "s", 0, "Canon", True), (272, "s", 0, "EOS 5D", True)
    with tifffile.TiffWriter(tmp_path / "frames" / "a.cr2") as file:
        file.write(
            np.minimum(2 * DN, 4095), photometric="cfa", metadata=None, software=False, extratags=[*model, *bayer]
        )
    done = run_main("source.kind=raw", "source.root=frames", "noise=none", "out=ds", "n_jobs=1")
    assert done.code == 0 and "above the white level of LibRaw, 3692 DN" in done.err, done
    assert "1 pair regenerated, bit for bit" in run_main("verify", "ds", "--regenerate", "1").out


def test_damaged_file_is_refused_by_every_verb(run_main: RunMain, tmp_path: Path, capfd: Any) -> None:
    for folder in ("frames", "captures", "darks"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a_dark.dng").write_bytes(KINDS["damage"]["zeros"][0]())
    (tmp_path / "captures" / "captures.csv").write_text("file,kind,iso\na_dark.dng,dark,100\n")
    dark = "noise=sony_a7s2", "noise.iso=6400", "noise.dark_frames=darks", "out=ds2"
    for arguments, code in (
        (("source.kind=raw", "source.root=frames", "noise=none", "out=ds", "n_jobs=1"), 3),
        (("calibrate", "captures", "--to", "profile.yaml"), 2),
        (dark, 2),
        (("camera", "frames/a_dark.dng", "--to", "camera.yaml"), 2),
    ):
        done = run_main(*arguments)
        assert done.code == code and "a_dark.dng" in done.err, done
        assert "damaged lossless JPEG data" in done.err and "unknown file" not in done.err + capfd.readouterr().err
    assert text_rows(tmp_path / "ds")[0]["reason"] == "corrupt"
