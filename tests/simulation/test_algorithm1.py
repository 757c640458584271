"""Clean frames of a dataset, compared with an independent implementation of Algorithm 1."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import algorithm1
from helpers.datasets import text_rows
from helpers.promise_report import Figure

from unprocess_gen import RawPairs
from unprocess_gen.config.schema import (
    CameraConfig,
    Config,
    GainsConfig,
    IspConfig,
    NoiseConfig,
    SensorConfig,
    SourceConfig,
)
from unprocess_gen.core.files import array_xxh3
from unprocess_gen.pipeline.generate import generate
from unprocess_gen.sources import synthetic

NOISE = NoiseConfig("imx385_iso3200", "dn", "subtracted", 12, 240, 4095, 6.955588, 38.117816)
BROOKS = (["uniform", 1.9, 2.4], ["uniform", 1.5, 1.9], ["truncated_normal", 0.8, 0.1, 0.5, 1.1])

SETTINGS = {
    "default": {},
    "brooks": {"gains": GainsConfig(*BROOKS, highlight="gray_mean"), "camera": CameraConfig("choice", "choice")},
    "bright": {"gains": GainsConfig(2.4, 1.9, 2.05), "sensor": SensorConfig(14, 1024, 16383, "BGGR")},
    "literal": {
        "gains": GainsConfig(*BROOKS[:2], ["inverse_truncated_normal", 0.8, 0.1, 0.5, 1.1]),
        "sensor": SensorConfig(16, 4096, 65535, "GRBG"),
    },
    "plain": {
        "gains": GainsConfig(1.0, 1.0, 1.0, highlight="none"),
        "camera": CameraConfig("identity", "identity"),
        "isp": IspConfig("none", "srgb"),
        "sensor": SensorConfig(10, 64, 1023, "GBRG"),
    },
    "linear": {"isp": IspConfig("none", 1), "camera": CameraConfig("nexus_6p", "fixed")},
}


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes as JPEG and PNG, every corner of the cube, all gray codes, and a 16-bit PNG."""
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("dead_leaves-1", "highlights-0", "colour_chart-0"):
        cv2.imwrite(str(folder / f"{name}.jpg"), synthetic.picture(name)[..., ::-1])
    corners = np.array(np.meshgrid([0, 128, 254, 255], [0, 128, 254, 255], [0, 128, 254, 255])).T.reshape(1, -1, 3)
    grays = np.repeat(np.arange(256)[None, :, None], 3, axis=2)
    cv2.imwrite(str(folder / "corners.png"), np.repeat(corners, 2, axis=0).astype(np.uint8))
    cv2.imwrite(str(folder / "grays.png"), np.repeat(grays, 3, axis=0).astype(np.uint8))
    deep = np.random.Generator(np.random.Philox(key=3)).integers(0, 65536, (61, 47, 3)).astype(np.uint16)
    cv2.imwrite(str(folder / "deep.png"), deep)
    return folder


def assert_clean_frames_agree(root: Path, dataset: Path) -> int:
    rows = {row["key"]: row for row in text_rows(dataset)}
    pairs = RawPairs(dataset)
    for clean, noisy, facts in pairs:
        row = rows[str(facts["key"])]
        expected = algorithm1.to_dn(algorithm1.unprocess(algorithm1.read_srgb(root / row["source"]), row), 65535)
        np.testing.assert_array_equal(clean, expected, err_msg=row["source"])
        assert array_xxh3(clean) == row["clean_xxh3"]
        assert array_xxh3(noisy) == row["noisy_xxh3"]
        assert int(row["saturated"]) == (expected == int(row["white_level_dn"])).sum()
    return len(pairs)


@pytest.mark.parametrize("name", SETTINGS)
def test_every_clean_dn_follows_from_row_and_source(
    photographs: Path, tmp_path: Path, name: str, figure: Figure
) -> None:
    given = {"gains": GainsConfig(*BROOKS), "noise": NOISE, **SETTINGS[name]}
    source = SourceConfig(str(photographs), include=["*.jpg", "*.png"])

    generate(Config(source=source, out=str(tmp_path / "ds"), n_jobs=1, **given))

    agreeing = assert_clean_frames_agree(photographs, tmp_path / "ds")
    assert agreeing == 6
    figure("clean-frame", f"all DN of {agreeing} of 6 frames equal")


@pytest.mark.slow
@pytest.mark.skipif("PHOTOS" not in os.environ, reason="set PHOTOS to a folder of photographs")
def test_every_clean_dn_of_real_photographs(tmp_path: Path, figure: Figure) -> None:
    root = Path(os.environ["PHOTOS"])
    source = SourceConfig(str(root), include=["*.jpg"])

    summary = generate(Config(source=source, gains=GainsConfig(*BROOKS), noise=NOISE, out=str(tmp_path / "ds")))

    assert summary.failed == {}
    agreeing = assert_clean_frames_agree(root, tmp_path / "ds")
    assert agreeing == summary.pairs
    figure("clean-frame", f"all DN of {agreeing} of {summary.pairs} photographs equal")
