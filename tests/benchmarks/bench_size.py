"""Test whether cost grows with pixels alone: run over images of 1 to 1000 megapixels, at least 30 in total each.

    python tests/benchmarks/bench_size.py [--megapixels 1 10 100] [--to FOLDER]

The images are JPEGs tiled from a synthetic scene. For each size, one worker makes a dataset in a new process, with
compiled kernels. The table lists milliseconds per megapixel from the start of the shard to its commit: elapsed time,
processor time of the program and of the system, and the peak memory of the process. A thousand megapixels need 12 GB of
memory and 5 GB of disk.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np

from unprocess_gen.sources.scenes import synthetic

RUN = """
import json, os, resource, sys, time
from unprocess_gen.cli import main as cli
from unprocess_gen.pipeline import workspace
from unprocess_gen.pipeline.executors import local
from unprocess_gen.simulation import self_test as selftest
selftest.check("gaussian")
spent = {}
make = local.make_shard
def timed(*given, **more):
    spent["start"] = time.perf_counter(), *os.times()[:2]
    return make(*given, **more)
local.make_shard = timed
commit = workspace.Workspace.commit
def commit_timed(self, result):
    commit(self, result)
    spent["end"] = time.perf_counter(), *os.times()[:2]
workspace.Workspace.commit = commit_timed
sys.argv = ["gen-dataset", *sys.argv[1:]]
code = cli.main()
seconds, user, system = (b - a for a, b in zip(spent["start"], spent["end"]))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({"code": code, "seconds": seconds, "user": user, "system": system, "peak": peak}))
"""


def picture(megapixels: float) -> np.ndarray:
    """Return a square picture tiled from a synthetic scene, uint8 ``[side, side, 3]``."""
    side = round(math.sqrt(megapixels * 1e6))
    tile = synthetic.scene(synthetic.NAMES[0])
    times = -(-side // min(tile.shape[:2]))
    return np.ascontiguousarray(np.tile(tile, (times, times, 1))[:side, :side])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megapixels", nargs="+", type=float, default=[1, 10, 100])
    parser.add_argument("--to", type=Path, default=Path("bench_size"))
    options = parser.parse_args()
    print("| megapixels | images | ms per megapixel | program | system | peak, MB | bytes per pixel above 200 MB |")
    print("|--:|--:|--:|--:|--:|--:|--:|")
    for megapixels in options.megapixels:
        source, out = options.to / "source", options.to / "out"
        source.mkdir(parents=True)
        content = cv2.imencode(".jpg", picture(megapixels))[1].tobytes()
        images = max(1, round(30 / megapixels))
        for image in range(images):
            (source / f"{image:03d}.jpg").write_bytes(content)
        settings = (f"source.root={source}", f"out={out}", "n_jobs=1", "source.max_pixels=2000000000")
        command = [sys.executable, "-c", RUN, *settings, f"output.pairs_per_shard={images}"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        measured = json.loads(done.stdout.splitlines()[-1])
        assert measured["code"] == 0, done.stderr
        shutil.rmtree(options.to)
        made, above = megapixels * images, measured["peak"] - 200e6
        print(
            f"| {megapixels:g} | {images} | {1e3 * measured['seconds'] / made:.1f} "
            f"| {1e3 * measured['user'] / made:.1f} | {1e3 * measured['system'] / made:.1f} "
            f"| {measured['peak'] / 1e6:,.0f} | {max(above, 0) / (megapixels * 1e6):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
