"""Videos as clips of a dataset: rows, shards, resumed runs and repair."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers.commands import RunMain
from helpers.datasets import Make, Settings, text_rows
from helpers.photographs import pixels
from helpers.videos import encode, film, scene, settings_of, write_jpeg
from PIL import Image

from unprocess_gen.config.schema import replaced
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.dataset.manifest import read_rows
from unprocess_gen.pipeline.replay import replay
from unprocess_gen.pipeline.verify import verify
from unprocess_gen.sources import loader as photographs
from unprocess_gen.sources.loader import list_photographs, load_source

av = pytest.importorskip("av")
from unprocess_gen.sources.video.decode import CODECS  # noqa: E402


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three videos, two of them the same, a folder of frames and a photograph."""
    folder = tmp_path_factory.mktemp("films")
    encode(folder, "h264", 20)
    film(folder / "sub" / "one.mkv", "ffv1", "yuv420p10le", scene(7, 33, 17, seed=3), {"g": "3"})
    shutil.copy(folder / "sub" / "one.mkv", folder / "sub" / "two.mkv")
    for frame in range(3):
        (folder / "stills").mkdir(exist_ok=True)
        Image.fromarray(pixels(frame, 20, 24)).save(folder / "stills" / f"{frame}.png")
    Image.fromarray(pixels(7, 12, 16)).save(folder / "alone.png")
    return folder


CLIPS = ("source.clips=true", "noise=nikon_d850", "noise.iso=3200", "effects.prnu=on")


@pytest.fixture(scope="module")
def filmed(films: Path, make: Make) -> Path:
    make(films, films.parent / "films_made", *CLIPS)
    return films.parent / "films_made"


def test_every_frame_is_a_row_with_its_clip_and_number(filmed: Path, films: Path) -> None:
    assert [(row["source"], row["clip"], row["frame"]) for row in text_rows(filmed)] == [
        ("alone.png", ".", "0"),
        *(("h264.mp4", "h264.mp4", str(frame)) for frame in range(20)),
        *((f"stills/{frame}.png", "stills", str(frame)) for frame in range(3)),
        *(("sub/one.mkv", "sub/one.mkv", str(frame)) for frame in range(7)),
        *(("sub/two.mkv", "sub/two.mkv", str(frame)) for frame in range(7)),
    ]
    assert [row["key"] for row in text_rows(filmed)] == [f"{index:08d}" for index in range(38)]


def test_frames_of_a_video_have_its_digest_and_size(filmed: Path, films: Path) -> None:
    import hashlib

    content = (films / "h264.mp4").read_bytes()
    recorded = {(row["source_sha256"], row["source_bytes"]) for row in text_rows(filmed) if row["source"] == "h264.mp4"}
    assert recorded == {(hashlib.sha256(content).hexdigest(), str(len(content)))}


def test_frames_share_their_draws_and_identical_videos_do_not(filmed: Path) -> None:
    by_clip: dict[str, set[tuple[str, ...]]] = {}
    for row in text_rows(filmed):
        by_clip.setdefault(row["clip"], set()).add((row["stream_key"], row["red_gain"], row["body_key"]))
    assert [len(draws) for draws in by_clip.values()] == [1] * 5
    assert len(set.union(*by_clip.values())) == 5


def test_shard_size_leaves_frames_unchanged(films: Path, filmed: Path, make: Make, tmp_path: Path) -> None:
    make(films, tmp_path / "ds", *CLIPS, "output.pairs_per_shard=5")
    assert {key(row) for row in text_rows(tmp_path / "ds")} == {key(row) for row in text_rows(filmed)}


def key(row: dict[str, str]) -> tuple[str, ...]:
    return row["source"], row["frame"], row["clean_xxh3"], row["noisy_xxh3"]


def test_removing_a_video_leaves_others_unchanged(films: Path, filmed: Path, make: Make, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(films, tmp_path / "films"))
    (copy / "h264.mp4").unlink()
    make(copy, tmp_path / "ds", *CLIPS)
    kept = {key(row) for row in text_rows(filmed) if row["source"] != "h264.mp4"}
    assert {key(row) for row in text_rows(tmp_path / "ds")} == kept


def test_frame_is_regenerated_from_its_row(filmed: Path, films: Path) -> None:
    assert verify(filmed) == []
    replayed = list(replay(read_rows(filmed / "manifest.csv"), str(films)))
    assert len(replayed) == 38
    assert [one for one in replayed if one.complaint] == []


def test_another_video_of_the_same_name_and_size_is_noticed(
    films: Path, filmed: Path, make: Make, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(films, tmp_path / "films"))
    out = Path(shutil.copytree(filmed, tmp_path / "ds"))
    content = bytearray((copy / "h264.mp4").read_bytes())
    content[content.index(b"mdat") + 900] ^= 1
    (copy / "h264.mp4").write_bytes(content)
    with pytest.raises(ConfigError, match=r"h264\.mp4 has other bytes than it had"):
        make(copy, out, *CLIPS)


def test_video_that_changes_during_a_run_stops_it(films: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(films / "h264.mp4", tmp_path / "a.mp4"))
    config = settings_of(tmp_path)
    first, second, *_ = list_photographs(config).sources
    load_source(config, first)
    content = bytearray(copy.read_bytes())
    content[-1] ^= 1
    copy.write_bytes(content)
    with pytest.raises((MachineError, SourceError), match="changed"):
        load_source(config, second)


def test_the_file_is_opened_and_hashed_once(films: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photographs._open_video.cache_clear()
    config = settings_of(films, include=["none"], video=["*.mp4"])
    for source in list_photographs(config).sources:
        load_source(config, source)
    assert photographs._open_video.cache_info().misses == 1


def test_a_limit_counts_frames(films: Path) -> None:
    listed = list_photographs(settings_of(films, limit=5)).sources
    assert [(source.name, source.frame) for source in listed] == [
        ("alone.png", 0),
        *(("h264.mp4", frame) for frame in range(4)),
    ]


def test_downscale_and_dither_apply_to_frames(films: Path, make: Make, tmp_path: Path) -> None:
    make(films, tmp_path / "ds", "source.clips=true", "source.downscale=2", "source.dequantize=dither")
    assert {row["status"] for row in text_rows(tmp_path / "ds")} == {"ok"}
    assert [one for one in replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(films)) if one.complaint] == []


def test_without_clips_videos_are_left_out_and_counted(films: Path) -> None:
    listing = list_photographs(settings_of(films, clips=False))
    assert {source.name for source in listing.sources} == {"alone.png", *(f"stills/{frame}.png" for frame in range(3))}
    assert listing.not_matched == 3


def test_photograph_named_like_a_video_is_read_without_clips(make: Make, tmp_path: Path) -> None:
    """Its row records this: a replay does not look at the name."""
    (tmp_path / "in").mkdir()
    write_jpeg(tmp_path / "in" / "a.mp4")
    make(tmp_path / "in", tmp_path / "ds", "source.include=['*.mp4']")
    assert [one.complaint for one in replay(read_rows(tmp_path / "ds" / "manifest.csv"), str(tmp_path / "in"))] == [""]


def test_without_pyav_a_video_is_refused_with_advice(
    films: Path, run_main: RunMain, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("unprocess_gen.core.libraries.find_spec", lambda name: None)
    done = run_main(f"source.root={films}", "source.clips=true")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "h264.mp4 is a video, which needs PyAV; in the source folder, run: pip install '.[video]'" in done.err
    assert not (tmp_path / "ds").exists()
    assert run_main(f"source.root={films}", "source.clips=true", "source.video=[]", "n_jobs=1").code == 0


def test_a_folder_of_videos_alone_needs_no_other_globs(films: Path, settings: Settings) -> None:
    from unprocess_gen.config.validation import validate_config

    config = settings("source.clips=true", "source.include=[]")
    config = replaced(config, {"source.root": str(films)})
    validate_config(config)
    assert len(list_photographs(config.source).sources) == 34


def test_ffmpeg_knows_every_accepted_codec() -> None:
    assert [name for name in CODECS if av.Codec(name, "r").canonical_name != name] == []
