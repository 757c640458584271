"""Time `CameraNoise` relative to the raw pair of the same crop plus the demosaicking of both frames.

    python tests/benchmarks/bench_camera_noise.py [PHOTO ...] [--rounds 40]

The crop has 256 x 256 pixels, from the middle of each photograph, or from a synthetic scene. In turns, in one thread,
the benchmark measures processor times; it prints the median of the ratios of the rounds.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path
from time import thread_time_ns

import cv2
import numpy as np

import unprocess_gen as ug

CALLS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="*", type=Path)
    parser.add_argument("--rounds", type=int, default=40)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for photo in arguments.photos or [None]:
        print(f"{photo or 'synthetic'}: {ratio(crop(photo), arguments.rounds):.2f}")


def crop(photo: Path | None) -> np.ndarray:
    if photo is None:
        waves = np.sin(np.arange(256) / 9)[:, None, None] * np.cos(np.arange(256) / [[7], [8], [9]]).T
        return np.rint(110 + 80 * waves).astype(np.uint8)
    pixels = cv2.imread(str(photo), cv2.IMREAD_COLOR)[..., ::-1]
    y, x = (side // 2 - 128 for side in pixels.shape[:2])
    return np.ascontiguousarray(pixels[y : y + 256, x : x + 256])


def ratio(picture: np.ndarray, rounds: int) -> float:
    """Return the median over rounds of the time of a call divided by that of pair and demosaicking."""
    config = ug.load_config(["noise=imx385_iso3200"])
    noise = ug.CameraNoise(config)
    frame = ug.make_pair(picture, config).noisy

    def call() -> None:
        for index in range(CALLS):
            noise(picture, index=index)

    def parts() -> None:
        for index in range(CALLS):
            ug.make_pair(picture, config, key=index)
            for _ in range(2):
                cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2RGB)

    call(), parts()
    return statistics.median(duration(call) / duration(parts) for _ in range(rounds))


def duration(work: Callable[[], None]) -> int:
    started = thread_time_ns()
    work()
    return thread_time_ns() - started


if __name__ == "__main__":
    main()
