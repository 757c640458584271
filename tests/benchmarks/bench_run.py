"""Time complete runs against a lower bound: every file decoded once, the same bytes hashed, written and synced.

    python tests/benchmarks/bench_run.py PHOTO [PHOTO ...] [--rounds 3] [--to FOLDER]

In turns, the benchmark makes datasets of them and measures the lower
bound: `cv2.imdecode`, one SHA-256, one write and one fdatasync of as many bytes, in one thread. Each run is the second
in a process of its own. The Markdown table has the medians of the ratios of elapsed and of processor times, which
depend less on other programs, and the peak memory.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from unprocess_gen.reports.timing import measure_in_turns

Times = dict[str, float]

RUN = """
import json, os, resource, shutil, sys, time
os.sched_setaffinity(0, json.loads(sys.argv[1]))
import unprocess_gen as ug
config = ug.load_config(sys.argv[2:])
ug.generate(config)
shutil.rmtree(config.out)
started, started_cpu = time.time(), time.process_time()
ug.generate(config)
peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
print(json.dumps({"s": time.time() - started, "cpu_s": time.process_time() - started_cpu, "peak_mb": peak / 1000}))
"""

FLOOR = """
import hashlib, json, os, sys, time
import cv2, numpy
cv2.setNumThreads(1)
os.sched_setaffinity(0, json.loads(sys.argv[1]))
folder, out = sys.argv[2:]
started, started_cpu = time.time(), time.process_time()
with open(out, "wb", buffering=0) as file:
    for index, name in enumerate(sorted(os.listdir(folder))):
        pixels = cv2.imdecode(numpy.fromfile(os.path.join(folder, name), dtype="uint8"), cv2.IMREAD_COLOR)
        content = memoryview(bytearray(4 * pixels.shape[0] * pixels.shape[1]))
        hashlib.sha256(content).digest()
        while content:
            content = content[file.write(content):]
        if index % 8 == 7:
            os.fdatasync(file.fileno())
    os.fdatasync(file.fileno())
os.remove(out)
print(json.dumps({"s": time.time() - started, "cpu_s": time.process_time() - started_cpu}))
"""


def measured(script: str, cores: Sequence[int], *arguments: str) -> Times:
    """What a script prints, run in a process of its own."""
    command = [sys.executable, "-c", script, json.dumps(list(cores)), *arguments]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    times: Times = json.loads(done.stdout.splitlines()[-1])
    return times


def compare(source: Path, folder: Path, rounds: int) -> None:
    """Print the table of runs of the photographs in ``source``."""
    cores = sorted(os.sched_getaffinity(0))

    def run(cores: Sequence[int], *settings: str) -> Times:
        out = folder / "out"
        times = measured(RUN, cores, f"source.root={source}", f"out={out}", *settings)
        shutil.rmtree(out)
        return times

    calls: dict[str, Callable[[int], Times]] = {
        "floor": lambda _: measured(FLOOR, cores[-1:], str(source), str(folder / "floor.bin")),
        "core to spare": lambda _: run(cores, "n_jobs=1"),
        "one core": lambda _: run(cores[-1:], "n_jobs=1"),
        "two workers": lambda _: run(cores[:2], "n_jobs=2"),
        "five levels": lambda _: run(cores[-1:], "n_jobs=1", "noise.levels=5"),
    }
    times = measure_in_turns(calls, rounds)
    compared = {"two workers": "one core", "five levels": "one core"}
    print("| run | seconds | compared with | ratio | ratio of processor times |\n|---|--:|---|--:|--:|")
    for name, runs in times.items():
        other = compared.get(name, "floor")
        both = list(zip(runs, times[other], strict=True))
        ratios = [f"{statistics.median(a[what] / b[what] for a, b in both):.3f}" for what in ("s", "cpu_s")]
        print(f"| {name} | {statistics.median(a['s'] for a in runs):.2f} | {other} | {' | '.join(ratios)} |")
    print(f"\npeak {max(one_core['peak_mb'] for one_core in times['one core']):.0f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=Path("bench_run"))
    options = parser.parse_args()
    source = options.to / "source"
    source.mkdir(parents=True)
    for photo in options.photos:
        shutil.copy(photo, source)
    compare(source, options.to, options.rounds)


if __name__ == "__main__":
    main()
