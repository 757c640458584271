"""Time complete runs against a lower bound: every file decoded once, the same bytes hashed, written and synced.

    python tests/benchmarks/bench_run.py PHOTO [PHOTO ...] [--copies 10] [--rounds 3] [--to FOLDER]

The benchmark copies the photographs under other names. It alternates between making datasets of them and the lower
bound: `cv2.imdecode`, one SHA-256, one write and one fdatasync of as many bytes, in one thread. Times last from the
first pair to the last; ratios are medians over the rounds. It prints a Markdown table: one worker with a core to spare,
one worker on one core, and two workers and five noise levels compared with that. The last column is the ratio of
processor times, which depends less on other programs; it is empty for two workers, which are processes of their own.
Below the table are the peak memory of a worker, and the shortest of several starts: from the start of the process to
the first bytes in a shard.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

STARTS = 7

RUN = """
import json, os, resource, sys, time
cores = json.loads(sys.argv[1])
if cores:
    os.sched_setaffinity(0, cores)
from unprocess_gen.cli import main as cli
from unprocess_gen.pipeline import workspace
committed = []
commit = workspace.Workspace.commit
def commit_timed(self, result):
    commit(self, result)
    committed.append((time.time(), time.process_time()))
workspace.Workspace.commit = commit_timed
begin = workspace.Workspace.begin
def begin_timed(self, sources):
    begin(self, sources)
    committed.append((time.time(), time.process_time()))
workspace.Workspace.begin = begin_timed
sys.argv = ["gen-dataset", *sys.argv[2:]]
code = cli.main()
peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
seconds, processor_s = (last - first for first, last in zip(committed[0], committed[-1]))
print(json.dumps({"code": code, "seconds": seconds, "processor_s": processor_s, "kib": peak}))
"""

FLOOR = """
import hashlib, json, os, sys, time
import cv2
cv2.setNumThreads(1)
os.sched_setaffinity(0, json.loads(sys.argv[1]))
out, names = sys.argv[2], json.load(open(sys.argv[3]))
started, started_cpu = time.time(), time.process_time()
with open(out, "wb", buffering=0) as file:
    for at, name in enumerate(names):
        pixels = cv2.imdecode(__import__("numpy").fromfile(name, dtype="uint8"), cv2.IMREAD_COLOR)
        content = memoryview(bytearray(4 * pixels.shape[0] * pixels.shape[1]))
        hashlib.sha256(content).digest()
        while content:
            content = content[file.write(content):]
        if at % 8 == 7:
            os.fdatasync(file.fileno())
    os.fdatasync(file.fileno())
print(json.dumps({"seconds": time.time() - started, "processor_s": time.process_time() - started_cpu}))
"""


def run(cores: Sequence[int], *arguments: str) -> dict[str, float]:
    """Time one run of the tool in a process of its own."""
    command = [sys.executable, "-c", RUN, json.dumps(list(cores)), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    assert measured["code"] == 0, done.stderr
    return measured


def has_pair(out: Path) -> bool:
    """Return whether a shard has bytes."""
    try:
        return any(path.stat().st_size for path in out.glob(".work/*/shard-*.tar.*"))
    except FileNotFoundError:
        return True  # it was committed just now


def start(cores: Sequence[int], out: Path, *arguments: str) -> float:
    """Time a process of the tool from its start to its first pair, and wait for its end."""
    pin = f"import os; os.sched_setaffinity(0, {list(cores)}); from unprocess_gen.cli import main; main.main()"
    started = time.perf_counter()
    command = [sys.executable, "-c", pin, *arguments, f"out={out}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not has_pair(out) and process.poll() is None:
        time.sleep(0.001)
    seconds = time.perf_counter() - started
    assert process.wait() == 0
    shutil.rmtree(out)
    return seconds


def floor(names: Path, to: Path) -> dict[str, float]:
    """Time the lower bound on one core."""
    command = [sys.executable, "-c", FLOOR, json.dumps(sorted(os.sched_getaffinity(0))[-1:]), str(to), str(names)]
    measured: dict[str, float] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", type=Path)
    parser.add_argument("--copies", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--to", type=Path, default=Path("bench_run"))
    options = parser.parse_args()
    source, out = options.to / "source", options.to / "out"
    source.mkdir(parents=True)
    files = []
    for copy in range(options.copies):
        for photo in options.photos:
            files.append(shutil.copy(photo, source / f"{copy:02d}_{photo.name}"))
    names = options.to / "names.json"
    names.write_text(json.dumps([os.path.abspath(name) for name in sorted(files)]))
    settings = (f"source.root={source}", f"out={out}")
    all_cores = sorted(os.sched_getaffinity(0))
    levels = "noise.levels=5"
    runs: dict[str, tuple[list[int], tuple[str, ...]]] = {
        "core to spare": (all_cores, ("n_jobs=1",)),
        "one core": (all_cores[-1:], ("n_jobs=1",)),
        "two workers": (all_cores[:2], ("n_jobs=2",)),
        "five levels": (all_cores[-1:], ("n_jobs=1", levels)),
    }
    against = {"core to spare": "", "one core": "", "two workers": "one core", "five levels": "one core"}
    run(all_cores, "source.limit=1", f"out={options.to / 'warm'}", settings[0], "n_jobs=1")
    times: dict[str, list[dict[str, float]]] = {name: [] for name in runs}
    floors: dict[str, list[dict[str, float]]] = {name: [] for name, other in against.items() if not other}
    for _ in range(options.rounds):
        for name, (cores, more) in runs.items():
            around = [] if against[name] else [floor(names, options.to / "floor.bin")]
            times[name].append(run(cores, *settings, *more))
            shutil.rmtree(out)
            if around:
                around.append(floor(names, options.to / "floor.bin"))
                floors[name].append({what: statistics.mean(one[what] for one in around) for what in around[0]})
    print("| run | seconds | ratio | to | ratio of processor times |\n|---|--:|--:|---|--:|")
    print(f"| floor | {statistics.median(one['seconds'] for one in itertools.chain(*floors.values())):.2f} | | | |")
    for name, other in against.items():
        compared = times[other] if other else floors[name]
        ratio, processor_ratio = (
            statistics.median(a[what] / b[what] for a, b in zip(times[name], compared, strict=True))
            for what in ("seconds", "processor_s")
        )
        seconds = statistics.median(one["seconds"] for one in times[name])
        shown = "" if name == "two workers" else f"{processor_ratio:.3f}"
        print(f"| {name} | {seconds:.2f} | {ratio:.3f} | {other or 'floor'} | {shown} |")
    peak = max(one["kib"] for one in times["one core"])
    print(f"\npeak of a process {peak:.0f} KiB; from the start to the first pair:")
    small = (settings[0], "source.limit=2", "output.pairs_per_shard=1")
    for name in ("core to spare", "one core", "two workers"):
        cores, more = runs[name]
        least = min(start(cores, out, *small, *more) for _ in range(STARTS))
        print(f"{name} {least:.2f} s")


if __name__ == "__main__":
    main()
