"""Measure what a tier of accuracy costs in a complete run: processor time from file to committed shard.

    python tests/benchmarks/bench_tiers.py PHOTO [PHOTO ...] [--rounds 3] [--tiers fast exact]

For each noise profile, the benchmark alternates between runs of the tiers, one worker each. Processor time includes
all threads. It is taken from the commit of the first photograph to that of the last, so that tables and compilation
do not count. "Decode" is `cv2.imdecode` of the same files, "hash and write" one SHA-256 and one write of as many
bytes. It prints a Markdown table of medians.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

PROFILES = {
    "two-parameter (`imx385_iso3200`)": ("noise=imx385_iso3200",),
    "physical (`sony_a7s2`)": ("noise=sony_a7s2",),
}

RUN = """
import sys, time
from unprocess_gen.cli import main as cli
from unprocess_gen.pipeline import workspace
times, commit = [], workspace.Workspace.commit
def timed(self, result):
    commit(self, result)
    times.append(time.process_time())
workspace.Workspace.commit = timed
sys.argv = ["gen-dataset", *sys.argv[1:]]
assert cli.main() == 0
print(times[-1] - times[0])
"""


def run(out: Path, *arguments: str) -> float:
    """Return the processor seconds of one run of the tool in its own process."""
    command = [sys.executable, "-c", RUN, *arguments, f"out={out}", "n_jobs=1", "output.pairs_per_shard=1"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    shutil.rmtree(out)
    return float(done.stdout.splitlines()[-1])


def decode(photos: list[Path]) -> tuple[float, int]:
    """Return the processor seconds of decoding, and the number of pixels."""
    cv2.setNumThreads(1)
    started, pixels = time.process_time(), 0
    for photo in photos:
        height, width = cv2.imdecode(np.fromfile(photo, dtype=np.uint8), cv2.IMREAD_COLOR).shape[:2]
        pixels += height * width
    return time.process_time() - started, pixels


def write(pixels: int, path: Path) -> float:
    """Return the processor seconds of hashing and writing two uint16 frames."""
    content = bytes(4 * pixels)
    started = time.process_time()
    hashlib.sha256(content).digest()
    with path.open("wb") as file:
        file.write(content)
        os.fsync(file.fileno())
    return time.process_time() - started


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tiers", nargs="+", default=["fast", "exact"], help="the reference takes minutes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "source").mkdir()
        photos = [Path(shutil.copy(photo, folder / "source")) for photo in options.photos]
        for more in PROFILES.values():  # compile
            for tier in options.tiers:
                run(folder / "out", f"source.root={folder}/source", "source.limit=1", f"accuracy={tier}", *more)
        times: dict[tuple[str, str], list[float]] = {}
        for _ in range(options.rounds):
            seconds, pixels = decode(sorted(photos)[1:])
            times.setdefault(("any", "decode"), []).append(seconds)
            times.setdefault(("any", "hash and write"), []).append(write(pixels, folder / "bytes"))
            for profile, more in PROFILES.items():
                for tier in options.tiers:
                    arguments = (f"source.root={folder}/source", f"accuracy={tier}", *more)
                    times.setdefault((profile, tier), []).append(run(folder / "out", *arguments))
    print(f"{len(photos)} photographs, {pixels / 1e6:.0f} megapixels\n")
    print("| noise | run | processor time, ns per pixel | of `exact` |\n|---|---|--:|--:|")
    for (profile, part), found in times.items():
        exact = times.get((profile, "exact"))
        ratio = statistics.median(a / b for a, b in zip(found, exact, strict=True)) if exact else None
        shown = "" if ratio is None else f"{ratio:.2f}"
        print(f"| {profile} | {part} | {statistics.median(found) / pixels * 1e9:.1f} | {shown} |")


if __name__ == "__main__":
    main()
