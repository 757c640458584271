"""Whether cost grows with pixels alone: runs over images of 1, 10, 100 and 1000 megapixels, some 30 at least in all.

    python tests/bench_size.py [--megapixels 1 10 100] [--to FOLDER]

The images are JPEGs tiled from a synthetic scene. For each size a dataset is made by one worker in a process of its
own, warm. Printed are milliseconds a megapixel from the start of the shard to its commit (decoding to bytes on disk),
by the clock and of the processor, for the program and for the system (which hands out memory and writes), and the peak
memory of the process. A thousand megapixels need 12 GB of memory and 5 GB of disk.
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
from unprocess_gen.pipeline import generate as runner, workspace
from unprocess_gen.simulation import self_test as selftest
selftest.check("one_normal")
spent = {}
make = runner.make_shard
def timed(*given, **more):
    spent["start"] = time.perf_counter(), *os.times()[:2]
    return make(*given, **more)
runner.make_shard = timed
commit = workspace.Workspace.commit
def told(self, made):
    commit(self, made)
    spent["end"] = time.perf_counter(), *os.times()[:2]
workspace.Workspace.commit = told
sys.argv = ["gen-dataset", *sys.argv[1:]]
code = cli.main()
seconds, user, system = (b - a for a, b in zip(spent["start"], spent["end"]))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({"code": code, "seconds": seconds, "user": user, "system": system, "peak": peak}))
"""


def picture(megapixels: float) -> np.ndarray:
    """A square picture of so many megapixels, tiled from a synthetic scene, uint8 ``[side, side, 3]``."""
    side = round(math.sqrt(megapixels * 1e6))
    tile = synthetic.scene(synthetic.NAMES[0])
    times = -(-side // min(tile.shape[:2]))
    return np.ascontiguousarray(np.tile(tile, (times, times, 1))[:side, :side])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megapixels", nargs="+", type=float, default=[1, 10, 100])
    parser.add_argument("--to", type=Path, default=Path("bench_size"))
    options = parser.parse_args()
    print("| megapixels | images | ms a megapixel | program | system | peak, MB | bytes a pixel above 200 MB |")
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
        told = json.loads(done.stdout.splitlines()[-1])
        assert told["code"] == 0, done.stderr
        shutil.rmtree(options.to)
        made, above = megapixels * images, told["peak"] - 200e6
        print(
            f"| {megapixels:g} | {images} | {1e3 * told['seconds'] / made:.1f} "
            f"| {1e3 * told['user'] / made:.1f} | {1e3 * told['system'] / made:.1f} "
            f"| {told['peak'] / 1e6:,.0f} | {max(above, 0) / (megapixels * 1e6):.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
