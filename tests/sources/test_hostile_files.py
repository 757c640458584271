"""Files made to break a decoder: whatever lies in the folder, the run ends, within bounds, with a row for each file.

Quick: generated photographs, damaged in the ways of `corpus`; headers that declare more than there is; deflated zeros;
and folder entries that are not files. Slow: the test pictures of image libraries, some eight thousand with
those derived from them, from the folder that ``CORPUS`` names, or fetched (minutes). What a file takes is measured in a
process of its own, whose high-water mark of memory is set back before each.
"""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import random
import re
import socket
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from helpers import corpus as corpus_module
from helpers.cases import slow_except
from helpers.commands import COMMAND, run_process
from helpers.corpus import DAMAGES, MATCHED, retagged
from helpers.datasets import Settings, text_rows
from helpers.photographs import pixels
from helpers.promise_report import Figure
from PIL import Image

from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import REASONS, SourceError
from unprocess_gen.core.source import Source
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.tasks import RunContext, ShardTask
from unprocess_gen.pipeline.worker import make_shard
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.sources.image.decode import decode
from unprocess_gen.sources.names import decode_name, encode_name

MAX_PIXELS = 2**26
MAX_SECONDS = 10
MAX_BYTES = 1.5e9

Rows = dict[str, dict[str, str]]


class Run(NamedTuple):
    """How a run over a folder ended, and the rows that it wrote."""

    done: subprocess.CompletedProcess[str]
    rows: Rows


def run(root: Path, out: Path, *overrides: str, timeout_s: float = 120) -> Run:
    done = run_process(COMMAND, f"source.root={root}", f"out={out}", *overrides, timeout=timeout_s)
    assert (out / "manifest.csv").exists(), done.stderr
    return Run(done, {decode_name(row["source"]): row for row in text_rows(out)})


def no_trouble(made: Run) -> bool:
    return made.done.returncode == 3 and "Traceback" not in made.done.stderr and "died" not in made.done.stderr


def undocumented(rows: Rows) -> dict[str, str]:
    """The rows that are neither ok nor failed for a documented reason."""
    allowed = {("ok", "")} | {("failed", reason) for reason in REASONS if reason != "worker_died"}
    return {path: row["reason"] for path, row in rows.items() if (row["status"], row["reason"]) not in allowed}


# Damaged generated photographs ----------------------------------------------------------------------------------------


def encoded(kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels(len(kind), 48, 64)).save(stream, kind, **options)
    return stream.getvalue()


OURS = {
    "baseline.jpg": encoded("JPEG", quality=95),
    "progressive.jpg": encoded("JPEG", quality=95, progressive=True),
    "restarts.jpg": encoded("JPEG", restart_marker_blocks=2),
    "8.png": encoded("PNG"),
    "16.png": cv2.imencode(".png", pixels(16, 48, 64, np.uint16))[1].tobytes(),
    "plain.tif": encoded("TIFF"),
    "deflated.tif": encoded("TIFF", compression="tiff_deflate"),
    "lossy.webp": encoded("WEBP"),
    "lossless.webp": encoded("WEBP", lossless=True),
    "24.bmp": encoded("BMP"),
}
KINDS = {"jpg": "jpeg", "png": "png", "tif": "tiff", "webp": "webp", "bmp": "bmp"}


def test_damaged_photographs_are_pairs_or_have_a_reason(tmp_path: Path, figure: Figure) -> None:
    """Run over `OURS`, intact and damaged in every way: ``good-8.png``, ``cut-0-8.png``, …, some 200 files."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, data in OURS.items():
        (photos / f"good-{name}").write_bytes(data)
        for damage, make in DAMAGES.items():
            generator = random.Random(f"{damage} {name}")
            for number, bad in enumerate(make(data, KINDS[name.rpartition(".")[2]], generator)):
                (photos / f"{damage}-{number}-{name}").write_bytes(bad)
    limits = ("source.max_pixels=16777216", "output.pairs_per_shard=32", "n_jobs=1")
    made = run(photos, tmp_path / "ds", *limits)
    assert no_trouble(made), made.done.stderr
    assert sorted(made.rows) == sorted(os.listdir(photos))
    assert undocumented(made.rows) == {}
    assert {made.rows[f"good-{name}"]["status"] for name in OURS} == {"ok"}
    figure("hostile-files", f"{len(made.rows)} of {len(os.listdir(photos))} damaged files have a row")


# Headers that claim more than there is --------------------------------------------------------------------------------


def png_head(width: int, height: int, bits: int = 8, colour: int = 2) -> bytes:
    head = b"IHDR" + struct.pack(">IIBB3x", width, height, bits, colour)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


PNG_END = b"\0\0\0\0IEND\xaeB`\x82"


def jpeg_head(frame: int) -> bytes:
    size = struct.pack(">BHHBBBBBBBBBB", 8, 65535, 65535, 3, 1, 17, 0, 2, 17, 0, 3, 17, 0)
    return b"\xff\xd8\xff" + bytes([frame]) + struct.pack(">H", len(size) + 2) + size + b"\xff\xd9"


def tiff_head(width: int, height: int, *, compression: int = 8) -> bytes:
    """A TIFF of one strip that would take one byte, and has it."""
    tags = ((256, width), (257, height), (258, 8), (259, compression), (262, 1), (273, 8), (278, height), (279, 1))
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4)


def webp_head(kind: bytes, payload: bytes) -> bytes:
    chunk = kind + struct.pack("<I", len(payload)) + payload + bytes(len(payload) % 2)
    return b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk


def bmp_head(width: int, height: int) -> bytes:
    return struct.pack("<2sIHHIIiiHHIIiiII", b"BM", 54, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)


# A file of pixels that are not compressed, or a strip of no byte, shows that it is short before its size matters.
CLAIMS = {
    "png of 2^32 - 1 a side": (png_head(2**32 - 1, 2**32 - 1) + PNG_END, "too_large"),
    "png, 16 bits, alpha": (png_head(65535, 65535, 16, 6) + PNG_END, "too_large"),
    "png of one row": (png_head(2**26 + 1, 1, 1, 0) + PNG_END, "too_large"),
    "jpeg of 65535 a side": (jpeg_head(0xC0), "too_large"),
    "tiff of 2^32 - 1 a side": (tiff_head(2**32 - 1, 2**32 - 1), "too_large"),
    "tiff, not compressed": (tiff_head(2**32 - 1, 2**32 - 1, compression=1), "corrupt"),
    "webp of 2^24 a side": (webp_head(b"VP8X", bytes(4) + b"\xff" * 6), "corrupt"),
    "webp, lossy": (webp_head(b"VP8 ", b"\x10\0\0\x9d\x01\x2a\xff\x3f\xff\x3f"), "corrupt"),
    "bmp of 2^31 - 1 a side": (bmp_head(2**31 - 1, 2**31 - 1), "truncated"),
}


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pixel is decoded while a test runs."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("pixels were decoded"))


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("claim", CLAIMS)
def test_false_size_is_refused_from_the_header_within_50_ms_and_100_kb(claim: str) -> None:
    data, reason = CLAIMS[claim]
    start = time.process_time()
    with pytest.raises(SourceError) as caught:
        decode(data, max_pixels=MAX_PIXELS, icc="ignore")
    assert time.process_time() - start < 0.05
    tracemalloc.start()
    with contextlib.suppress(SourceError):
        decode(data, max_pixels=MAX_PIXELS, icc="ignore")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000
    assert (len(data) < 200, caught.value.reason) == (True, reason)


# Folder entries that are not files ------------------------------------------------------------------------------------


def bind_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound, contextlib.chdir(path.parent):  # the name has 108 bytes at most
        bound.bind(path.name)


ENTRIES: dict[str, tuple[Callable[[Path], object], str]] = {
    "socket.jpg": (bind_socket, "not_a_file"),
    "pipe.jpg": (os.mkfifo, "not_a_file"),
    "endless.jpg": (lambda path: path.symlink_to("/dev/zero"), "not_a_file"),
    "terminal.jpg": (lambda path: path.symlink_to("/dev/tty"), "not_a_file"),
    "memory.jpg": (lambda path: path.symlink_to("/proc/self/mem"), "empty"),
    "dangling.jpg": (lambda path: path.symlink_to("nowhere"), "unreadable"),
    "itself.jpg": (lambda path: path.symlink_to(path.name), "unreadable"),
    "through.jpg": (lambda path: path.symlink_to("/dev/null/x"), "unreadable"),
    "round.jpg": (lambda path: path.symlink_to("about.jpg"), "unreadable"),
    "about.jpg": (lambda path: path.symlink_to("round.jpg"), "unreadable"),
    "nothing.jpg": (Path.touch, "empty"),
}


def test_entry_other_than_a_file_has_a_row_with_reason(tmp_path: Path) -> None:
    """A hang would end the run after a minute."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "good.png").write_bytes(OURS["8.png"])
    for name, (make, _) in ENTRIES.items():
        make(tmp_path / "photos" / name)
    made = run(tmp_path / "photos", tmp_path / "ds", "n_jobs=1", timeout_s=60)
    assert no_trouble(made), made.done.stderr
    wanted = {"good.png": ""} | {name: reason for name, (_, reason) in ENTRIES.items()}
    assert {path: row["reason"] for path, row in made.rows.items()} == wanted


# What one file takes --------------------------------------------------------------------------------------------------


class Weight(NamedTuple):
    """What became of one file, and what it took from its first byte to its pair in a shard.

    ``seconds`` are of the processors, of all threads; ``peak_bytes`` is the resident memory of the process.
    """

    outcome: str
    seconds: float
    peak_bytes: int


def peak_bytes() -> int:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return 1024 * int(found[1])


def compile_kernels(config: Config) -> None:
    for dtype in (np.uint8, np.uint16):
        make_pair(np.zeros((4, 4, 3), dtype), plan_image(config, "0" * 64, 0))


def weigh_file(config: Config, folder: Path, path: Path) -> Weight:
    """Make a shard of a file, and return what it took. The source folder of ``config`` is the root."""
    source = Source(0, encode_name(path.name), str(path.relative_to("/")), path.stat().st_size)
    Path("/proc/self/clear_refs").write_text("5")  # sets the high-water mark back
    start = time.process_time()
    made = make_shard(RunContext(PairSettings(config), str(folder), os.getpid()), ShardTask(0, (source,)))
    seconds = time.process_time() - start
    if made.path is not None:
        Path(made.path).unlink()
    return Weight(str(made.rows[0]["reason"] or "ok"), seconds, peak_bytes())


Weigh = Callable[[Path], Weight]


@pytest.fixture(scope="module")
def weigh(settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Weigh]:
    """Return a function that weighs a file in a process of its own, whose hang or death is a `TimeoutError`."""
    config, folder = settings("source.root=/"), tmp_path_factory.mktemp("weighed")
    with multiprocessing.get_context("spawn").Pool(1, compile_kernels, (config,)) as pool:
        yield lambda path: pool.apply_async(weigh_file, (config, folder, path)).get(60)


def zlib_zeros(count: int) -> bytes:
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(min(2**20, count - at))) for at in range(0, count, 2**20)) + packer.flush()


def png_bomb(bits: int, colour: int, row_bytes: int) -> bytes:
    """8192 x 8192 pixels of zeros, opaque ones where the colour type has an alpha."""
    body = zlib_zeros(8192 * (1 + row_bytes))
    data = struct.pack(">I", len(body)) + b"IDAT" + body + struct.pack(">I", zlib.crc32(b"IDAT" + body))
    return png_head(8192, 8192, bits, colour) + data + PNG_END


def tiff_bomb() -> bytes:
    """8192 x 8192 pixels of zeros, RGB, deflated in one strip."""
    body = zlib_zeros(3 * 2**26)
    tags = {256: 8192, 257: 8192, 258: 8, 259: 8, 262: 2, 273: 200, 277: 3, 278: 8192, 279: len(body)}
    return tiff_of({tag: (1, value) for tag, value in tags.items()}, body)


def pillow_bomb(kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    Image.new("RGB", (8192, 8192), (200, 30, 90)).save(stream, kind, **options)
    return stream.getvalue()


BOMBS: dict[str, tuple[Callable[[], bytes], str]] = {
    "rgb, one strip.tif": (tiff_bomb, "ok"),
    "rgba, 16 bits.png": (lambda: png_bomb(16, 6, 8 * 8192), "alpha"),
    "rgb, baseline.jpg": (lambda: pillow_bomb("JPEG"), "ok"),
    "rgb, progressive.jpg": (lambda: pillow_bomb("JPEG", progressive=True, subsampling=0), "ok"),
    "rgb.webp": (lambda: pillow_bomb("WEBP", lossless=True, method=0), "ok"),
}


@pytest.mark.parametrize("name", slow_except((), BOMBS))
def test_small_file_of_maximum_pixels_stays_within_bounds(
    name: str, tmp_path: Path, weigh: Weigh, figure: Figure
) -> None:
    make, outcome = BOMBS[name]
    (tmp_path / name).write_bytes(make())
    assert (tmp_path / name).stat().st_size < MAX_PIXELS / 20, "no bomb"
    weight = weigh(tmp_path / name)
    assert weight.outcome == outcome
    assert weight.seconds < MAX_SECONDS
    assert weight.peak_bytes < MAX_BYTES
    figure("hostile-files", f"largest pictures: {weight.seconds:.1f} s, {weight.peak_bytes / 1e9:.2f} GB")


# The corpus -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hostile pictures of others: the folder that CORPUS names, or one that is filled now."""
    if "CORPUS" in os.environ:
        return Path(os.environ["CORPUS"])
    folder = tmp_path_factory.mktemp("corpus") / "pictures"
    subprocess.run([sys.executable, corpus_module.__file__, folder], check=True, timeout=3600)
    return folder


@pytest.fixture(scope="module")
def corpus_run(corpus: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run over all of the corpus."""
    # the headers of many files announce more pixels than they have, so the estimated space is far too large
    return run(corpus, tmp_path_factory.mktemp("made") / "ds", "check_disk=false", timeout_s=3600)


def matched_files(folder: Path) -> list[str]:
    found = (path for path in folder.rglob("*") if path.is_file() and path.name.lower().endswith(MATCHED))
    return sorted(str(path.relative_to(folder)) for path in found)


@pytest.mark.slow
def test_files_of_the_corpus_are_pairs_or_have_a_reason(corpus: Path, corpus_run: Run, figure: Figure) -> None:
    assert no_trouble(corpus_run), corpus_run.done.stderr[-2000:]
    assert sorted(corpus_run.rows) == matched_files(corpus)
    assert len(corpus_run.rows) >= 3000
    assert undocumented(corpus_run.rows) == {}
    figure("hostile-files", f"{len(corpus_run.rows)} of {len(matched_files(corpus))} files of the corpus have a row")


@pytest.mark.slow
def test_cut_files_of_the_corpus_are_truncated_or_corrupt(corpus: Path, corpus_run: Run) -> None:
    def is_jpeg_or_png(path: str) -> bool:
        with (corpus / path).open("rb") as file:
            return file.read(4).startswith((b"\xff\xd8\xff", b"\x89PNG"))

    rows = {path: row for path, row in corpus_run.rows.items() if path.startswith("derived/cut/")}
    cut = {path: row["reason"] for path, row in rows.items() if is_jpeg_or_png(path)}
    assert len(cut) >= 500
    assert {path: reason for path, reason in cut.items() if reason not in ("truncated", "corrupt")} == {}


@pytest.mark.slow
def test_corpus_files_take_at_most_10_s_and_1500_mb(corpus: Path, weigh: Weigh, figure: Figure) -> None:
    weights = {path: weigh(corpus / path) for path in matched_files(corpus)}
    over = {path: w for path, w in weights.items() if w.seconds > MAX_SECONDS or w.peak_bytes > MAX_BYTES}
    assert over == {}
    seconds, gigabytes = (
        max(one) for one in zip(*((w.seconds, w.peak_bytes / 1e9) for w in weights.values()), strict=True)
    )
    figure("hostile-files", f"{len(weights)} files of the corpus: at most {seconds:.1f} s and {gigabytes:.2f} GB each")


# Small files of much work ---------------------------------------------------------------------------------------------


def overlapping_directories(entries: int = 4000) -> bytes:
    """A TIFF of 64 directories that begin six bytes after each other and share their entries."""
    data = bytearray(8 + 6 * 64 + 12 * entries + 64)
    struct.pack_into("<2sHI", data, 0, b"II", 42, 8)
    for at in range(8, 8 + 6 * 64, 6):
        struct.pack_into("<H", data, at, entries)
    for at in range(8, 8 + 6 * 63, 6):
        struct.pack_into("<I", data, at + 2 + 12 * entries, at + 6)
    return bytes(data)


def tiff_of(tags: dict[int, tuple[int, int]], rest: bytes) -> bytes:
    """A TIFF of 32-bit tags, each a count and a value or the place of its values; ``rest`` begins at byte 200."""
    entries = b"".join(struct.pack("<HHII", tag, 4, count, value) for tag, (count, value) in tags.items())
    return (struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries).ljust(200, b"\0") + rest


def strips(width: int, height: int, count: int, rest: bytes) -> bytes:
    """A deflated gray TIFF whose lists of strips begin at byte 200, places first."""
    sizes = {256: (1, width), 257: (1, height), 258: (1, 8), 259: (1, 8), 262: (1, 1)}
    return tiff_of(sizes | {273: (count, 200), 277: (1, 1), 278: (1, 1), 279: (count, 200 + 4 * count)}, rest)


def shared_strips(rows: int = 200_000, size_bytes: int = 10**6) -> bytes:
    """Every row is a strip of a megabyte, and all of them are the same one."""
    lists = struct.pack("<I", 200 + 8 * rows) * rows + struct.pack("<I", size_bytes) * rows
    return strips(64, rows, rows, lists + zlib.compress(bytes(64)).ljust(size_bytes, b"\0"))


def segment(marker: int, payload: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(payload) + 2) + payload


def empty_scans(count: int = 2000) -> bytes:
    """A progressive gray JPEG of 8192 x 8192 pixels with scans that say in 32 symbols: nothing here."""
    blocks = 1024 * 1024
    head = segment(0xDB, b"\0" + bytes([1] * 64)) + segment(0xC2, struct.pack(">BHHBBBB", 8, 8192, 8192, 1, 1, 17, 0))
    tables = segment(0xC4, b"\0\1" + bytes(16)) + segment(0xC4, b"\x10\1" + bytes(15) + b"\xe0")
    first = segment(0xDA, bytes([1, 1, 0, 0, 0, 0])) + bytes(blocks // 8)
    run = "0" + "1" * 14  # the end of a band, 32,767 blocks long
    bits = run * -(-blocks // 32767)
    bits += "1" * (-len(bits) % 8)
    body = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    scan = segment(0xDA, bytes([1, 1, 0, 1, 63, 0])) + body
    return b"\xff\xd8" + head + tables + first + scan * count + b"\xff\xd9"


LABOURS: dict[str, Callable[[], bytes]] = {
    "tiff of directories that overlap": overlapping_directories,
    "tiff of rows that share a strip": shared_strips,
    "tiff of a million depths": lambda: tiff_of({258: (10**6, 200)}, bytes(4 * 10**6)),
    "jpeg of four million segments": lambda: b"\xff\xd8" + b"\xff\xe5\0\2" * 4 * 10**6 + b"\xff\xd9",
    "jpeg of 2000 empty scans": empty_scans,
    "png of two million chunks": lambda: png_head(8, 8) + b"\0\0\0\0abCd\0\0\0\0" * 2 * 10**6 + PNG_END,
    "webp of four million chunks": lambda: webp_head(b"abcd", b"") + b"abcd\0\0\0\0" * 4 * 10**6,
}


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("labour", LABOURS)
def test_expensive_hostile_file_is_refused_within_2_s(labour: str) -> None:
    data = LABOURS[labour]()
    start = time.process_time()
    with pytest.raises(SourceError, match=r"^(corrupt|unsupported)") as caught:
        decode(data, max_pixels=MAX_PIXELS, icc="ignore")
    assert (time.process_time() - start < 2, len(str(caught.value)) < 300) == (True, True)


def test_impossible_number_of_strips_is_not_read() -> None:
    data = strips(10, 10, 5 * 10**6, b"\1\2\3\4" * 10**7)
    tracemalloc.start()
    with pytest.raises(SourceError, match=r"^corrupt"):
        decode(data, max_pixels=MAX_PIXELS, icc="ignore")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10**6


# Damage reported by rare codec messages -------------------------------------------------------------------------------


def cut_at_a_restart() -> bytes:
    data = encoded("JPEG", restart_marker_blocks=1)
    restarts = [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data)]
    return data[: restarts[len(restarts) // 2]] + b"\xff\xd9"


def rows_lost_between_restarts() -> bytes:
    data = encoded("JPEG", restart_marker_blocks=1)
    restarts = [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data)]
    return data[: restarts[2]] + data[restarts[-3] :]


def half_behind(word: Callable[[bytes], bytes]) -> bytes:
    """A JPEG without its second half, where the codec's one word is spent on something harmless."""
    data = word(encoded("JPEG"))
    return data[: 2 * len(data) // 3] + b"\xff\xd9"


def jpeg_in_tiff_of_height(height: int) -> bytes:
    return retagged(encoded("TIFF", compression="jpeg"), {257: height, 278: height})


TOLD_OTHERWISE: dict[str, Callable[[], bytes]] = {
    "jpeg cut at a restart": cut_at_a_restart,
    "jpeg that lost rows between restarts": rows_lost_between_restarts,
    "half a jpeg of a strange version": lambda: half_behind(lambda data: data.replace(b"JFIF\0\1", b"JFIF\0\5", 1)),
    "half a jpeg with bytes between segments": lambda: half_behind(lambda data: data[:20] + b"\0\0\0" + data[20:]),
    "jpeg in tiff, of more rows than it has": lambda: jpeg_in_tiff_of_height(512),
}


@pytest.mark.parametrize("kind", TOLD_OTHERWISE)
def test_damage_reported_by_rare_codec_messages_is_corrupt(kind: str) -> None:
    with pytest.raises(SourceError, match=r"^corrupt"):
        decode(TOLD_OTHERWISE[kind](), max_pixels=MAX_PIXELS, icc="ignore")
