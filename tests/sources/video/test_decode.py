"""Decoding videos: the same frame in any order of reading, and a reason for what cannot be decoded."""

from __future__ import annotations

import functools
import itertools
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.cases import slow_except
from helpers.datasets import Make, text_rows
from helpers.promise_report import Figure
from helpers.videos import ENCODED, encode, film, opened, rgb, scene, settings_of, write_jpeg

from unprocess_gen.core.errors import SourceError
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources.loader import list_photographs, load_source

av = pytest.importorskip("av")
from unprocess_gen.sources.video.decode import Video  # noqa: E402


@pytest.fixture(scope="module")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that returns a film of 30 frames, encoded once for all tests, which leave it as it is."""
    folder = tmp_path_factory.mktemp("encoded")

    @functools.cache
    def path_of(kind: str) -> Path:
        return encode(folder, kind)

    return path_of


# Frames ---------------------------------------------------------------------------------------------------------------


def plain(path: Path) -> list[np.ndarray]:
    """All frames in turn, as PyAV decodes them by itself from the first to the last; the luma plane."""
    frames = []
    with av.open(str(path)) as container:
        container.streams.video[0].codec_context.options = {"idct": "simple"}
        for frame in container.decode(video=0):
            lines = np.frombuffer(frame.planes[0], np.uint8).reshape(-1, frame.planes[0].line_size)
            frames.append(lines[: frame.height, : frame.width].copy())
    return frames


@pytest.mark.parametrize("kind", slow_except(tuple(ENCODED)[::2], ENCODED))
def test_frame_is_the_same_in_any_order_of_reading(kind: str, encoded: Callable[[str], Path], figure: Figure) -> None:
    path = encoded(kind)
    video = opened(path)
    in_turn = [rgb(video, number) for number in range(len(video))]
    numbers = list(range(30)) * 2
    random.Random(1).shuffle(numbers)
    assert len(video) == 30
    assert all(np.array_equal(rgb(video, number), in_turn[number]) for number in numbers)
    assert all(np.array_equal(rgb(opened(path), number), in_turn[number]) for number in (29, 13, 0))
    assert len({frame.tobytes() for frame in in_turn}) == 30
    figure("video", f"{len(numbers)} reads of {len(in_turn)} frames in any order are equal")


@pytest.mark.parametrize("kind", [kind for kind in ENCODED if kind not in ("prores", "dnxhd")])
def test_frames_and_their_order_are_those_of_a_player(kind: str, encoded: Callable[[str], Path]) -> None:
    path = encoded(kind)
    video, shown = opened(path), plain(path)
    assert len(shown) == len(video)
    for number, luma in enumerate(shown):
        wanted = np.clip((luma.astype(float) - 16) / 219 if kind != "mjpeg" else luma / 255, 0, 1) * 255
        found = rgb(video, number) @ [0.299, 0.587, 0.114]
        inside = ((rgb(video, number) > 0) & (rgb(video, number) < 255)).all(-1)
        assert np.abs(found - wanted)[inside].max() < 1


def test_times_of_any_spacing_make_frames_in_their_order(tmp_path: Path) -> None:
    wanted = scene(6)
    path = film(tmp_path / "a.mkv", "ffv1", "bgr0", wanted, times=[0, 1, 2, 30, 31, 90])
    video = opened(path)
    assert len(video) == 6
    assert all(np.array_equal(rgb(video, number), wanted[number]) for number in (5, 0, 3, 1, 2, 4))


def test_a_video_of_one_frame_has_one(tmp_path: Path) -> None:
    video = opened(film(tmp_path / "a.mp4", "libx264", "yuv420p", scene(1), {"x264-params": "log-level=none"}))
    assert len(video) == 1
    assert rgb(video, 0).shape == (48, 64, 3)


def test_pixels_that_the_codec_crops_are_absent(tmp_path: Path) -> None:
    """H.264 codes squares of 16 pixels; 34 x 18 are cut out of 48 x 32."""
    path = film(tmp_path / "a.mp4", "libx264", "yuv420p", scene(3, 34, 18), {"x264-params": "qp=0:log-level=none"})
    found = rgb(opened(path), 2)
    assert found.shape == (18, 34, 3)
    assert np.abs(found.astype(int) - scene(3, 34, 18)[2]).mean() < 20
    assert np.abs(found[:, ::-1].astype(int) - scene(3, 34, 18)[2]).mean() > 40


EVERY_FRAME = """
import ctypes, glob, hashlib, sys
import av
from pathlib import Path
if sys.argv[2] != "all":
    ctypes.CDLL(glob.glob(str(Path(av.__path__[0]).parent / "av.libs" / "libavutil*"))[0]).av_force_cpu_flags(0)
from unprocess_gen.sources.video.decode import Video
for path in sorted(Path(sys.argv[1]).iterdir()):
    video = Video(path.open("rb", buffering=0))
    found = hashlib.sha256(b"".join(video.frame(n, 2**40, "ignore")[0].tobytes() for n in range(len(video))))
    with av.open(str(path)) as container:
        converted = [frame.to_ndarray(format="rgb24").tobytes() for frame in container.decode(video=0)]
    print(path.name, found.hexdigest(), hashlib.sha256(b"".join(converted)).hexdigest())
"""


@pytest.mark.slow
def test_processors_with_and_without_simd_give_the_same_frames(tmp_path: Path) -> None:
    """And FFmpeg's own conversion does not: so the switch was thrown, and that is why it is not used."""
    libraries = Path(av.__path__[0]).parent / "av.libs"
    if not list(libraries.glob("libavutil*")):
        pytest.skip("this PyAV was built on the system's FFmpeg")
    for kind in ENCODED:
        encode(tmp_path / "videos", kind, 9)
    called = [sys.executable, "-c", EVERY_FRAME, str(tmp_path / "videos")]
    with_simd, without = (
        [line.split() for line in subprocess.check_output([*called, flags], text=True).splitlines()]
        for flags in ("all", "none")
    )
    assert [line[:2] for line in with_simd] == [line[:2] for line in without]
    assert len(with_simd) == len(ENCODED)
    assert [line[2] for line in with_simd] != [line[2] for line in without]


# What cannot be used --------------------------------------------------------------------------------------------------


X264 = {"x264-params": "log-level=none:keyint=5"}


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def audio(path: Path) -> None:
    with av.open(str(path), "w") as output:
        stream = output.add_stream("aac", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.rate = 8000
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


def no_frames(path: Path) -> None:
    """Return a film with one packet that declares another track."""
    film(path, "ffv1", "bgr0", scene(1))
    content = bytearray(path.read_bytes())
    at = content.index(b"\xa3", content.index(b"\x1fC\xb6u"))
    content[at] = 0xEC  # a Void in place of the SimpleBlock
    path.write_bytes(content)


UNUSABLE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no bytes": ("a.mp4", lambda path: path.touch(), "empty"),
    "index at the end cut off": (
        "a.mp4",
        lambda path: cut(film(path, "libx264", "yuv420p", scene(9), X264), 0.8),
        "truncated",
    ),
    "index at the front": (
        "a.mp4",
        lambda path: cut(film(path, "libx264", "yuv420p", scene(9), X264, container={"movflags": "faststart"}), 0.8),
        "truncated",
    ),
    "Matroska cut off": ("a.mkv", lambda path: cut(film(path, "ffv1", "bgr0", scene(9)), 0.8), "truncated"),
    "AVI cut off": ("a.avi", lambda path: cut(film(path, "mjpeg", "yuvj420p", scene(9)), 0.8), "truncated"),
    "sound alone": ("a.mp4", audio, "unsupported"),
    "JPEG by another name": ("a.mp4", write_jpeg, "unsupported"),
    "text": ("a.mov", lambda path: path.write_text("#EXTM3U\nhttp://example.org/a.ts\n"), "unsupported"),
    "no frames": ("a.mkv", no_frames, "empty"),
    "nonsense in a box": (
        "a.mp4",
        lambda path: path.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0" + b"\0" * 99),
        "truncated",
    ),
    "nonsense in the index": (
        "a.mp4",
        lambda path: path.write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0\0\0\0\x28moov" + b"\xff" * 32),
        "unsupported",
    ),
    "alpha": ("a.mkv", lambda path: film(path, "ffv1", "bgra", scene(2)), "alpha"),
    "separate alpha": ("a.webm", lambda path: film(path, "libvpx-vp9", "yuva420p", scene(2)), "alpha"),
    "12 bits": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p12le", scene(2)), "unsupported"),
    "PQ": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p10le", scene(2), color_trc=16), "unsupported"),
    "HLG": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p10le", scene(2), color_trc=18), "unsupported"),
    "YCgCo": ("a.mkv", lambda path: film(path, "ffv1", "yuv420p", scene(2), colorspace=8), "unsupported"),
    "another codec": ("a.mov", lambda path: film(path, "qtrle", "rgb24", scene(2)), "unsupported"),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_an_unusable_video_is_one_failed_row_with_its_reason(kind: str, make: Make, tmp_path: Path) -> None:
    name, write, reason = UNUSABLE[kind]
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / name)
    make(tmp_path / "in", tmp_path / "ds", "source.clips=true")
    (row,) = text_rows(tmp_path / "ds")
    assert (row["source"], row["status"], row["reason"], row["frame"]) == (name, "failed", reason, "0")
    assert (row["source_sha256"] == "") == (kind == "no bytes")
    assert verify(tmp_path / "ds") == []


def test_a_video_with_too_many_pixels_is_one_failed_row(tmp_path: Path) -> None:
    film(tmp_path / "a.mkv", "ffv1", "bgr0", scene(3))
    config = settings_of(tmp_path, max_pixels=64 * 48 - 1)
    (source,) = list_photographs(config).sources
    with pytest.raises(SourceError, match=r"^too_large: 64 x 48 pixels are 3072"):
        load_source(config, source)


def test_other_primaries_are_refused_under_icc_refuse(tmp_path: Path) -> None:
    film(tmp_path / "a.mkv", "ffv1", "yuv420p", scene(3), color_primaries=9)
    assert len(list_photographs(settings_of(tmp_path)).sources) == 3
    config = settings_of(tmp_path, icc="refuse")
    (source,) = list_photographs(config).sources
    with pytest.raises(SourceError, match=r"^icc: the primaries have code 9"):
        load_source(config, source)


def damaged(folder: Path) -> tuple[Path, Path]:
    """A film of closed groups of five frames, and a copy with bytes of frame 7's packet overwritten."""
    intact = film(folder / "intact.mkv", "ffv1", "yuv420p", scene(20), {"g": "5", "slicecrc": "1", "level": "3"})
    with av.open(str(intact)) as container:
        packet = next(itertools.islice(container.demux(video=0), 7, 8))
        content = bytes(packet)
    data = bytearray(intact.read_bytes())
    at = data.index(content)
    data[at + 40 : at + 60] = bytes(20)
    broken = folder / "broken.mkv"
    broken.write_bytes(data)
    return intact, broken


def reason_of(video: Video, number: int) -> str:
    try:
        rgb(video, number)
    except SourceError as error:
        return error.reason
    return ""


def test_damage_affects_its_frame_and_dependent_ones(tmp_path: Path) -> None:
    intact, broken = map(opened, damaged(tmp_path))
    wanted = [""] * 7 + ["corrupt"] * 3 + [""] * 10
    assert [reason_of(broken, number) for number in range(20)] == wanted
    numbers = list(range(20)) * 2
    random.Random(2).shuffle(numbers)
    for number in numbers:
        assert reason_of(broken, number) == wanted[number]
        if not wanted[number]:
            np.testing.assert_array_equal(rgb(broken, number), rgb(intact, number))


@pytest.mark.parametrize("kind", slow_except(tuple(ENCODED)[1::2], (kind for kind in ENCODED if kind != "av1")))
def test_damage_is_the_same_in_any_order_of_reading(kind: str, encoded: Callable[[str], Path], tmp_path: Path) -> None:
    """Frames before the damage are intact; later ones are the same each time, whether the decoder finds it or not."""
    path = Path(shutil.copy(encoded(kind), tmp_path))
    video = opened(path)
    intact = [outcome(video, number) for number in range(30)]
    with av.open(str(path)) as container:
        content = bytes(next(itertools.islice(container.demux(video=0), 10, 11)))
    data = bytearray(path.read_bytes())
    at = data.index(content) + len(content) * 3 // 4
    data[at : at + 8] = bytes(one ^ 0x55 for one in data[at : at + 8])
    path.write_bytes(data)
    broken = opened(path)
    in_turn = [outcome(broken, number) for number in range(30)]
    numbers = list(range(30))
    random.Random(3).shuffle(numbers)
    assert [outcome(broken, number) for number in numbers] == [in_turn[number] for number in numbers]
    assert in_turn[:7] == intact[:7]
    assert in_turn != intact


def outcome(video: Video, number: int) -> bytes | str:
    return reason_of(video, number) or rgb(video, number).tobytes()


def test_frames_that_fail_are_rows_and_the_others_pairs(make: Make, tmp_path: Path) -> None:
    _, broken = damaged(tmp_path / "in")
    (tmp_path / "in" / "intact.mkv").unlink()
    made = {per: tmp_path / f"ds{per}" for per in (3, 8)}
    for per, out in made.items():
        make(tmp_path / "in", out, "source.clips=true", f"output.pairs_per_shard={per}")
    found = text_rows(made[3])
    assert [row["frame"] for row in found if row["status"] == "failed"] == ["7", "8", "9"]
    assert {row["clip"] for row in found} == {broken.name}
    assert [row["noisy_xxh3"] for row in found] == [row["noisy_xxh3"] for row in text_rows(made[8])]
