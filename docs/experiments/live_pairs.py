"""Measure what a training gains in time from live pairs: the experiment of docs/experiments/live_pairs.md.

    python docs/experiments/live_pairs.py --out FOLDER [--photos FOLDER] [--rounds 9] [--only goals]

Processor time of one thread, all sides in turns. Results go to live_pairs.json in ``--out``, and as Markdown tables to
standard output. Without photographs, the sources are JPEG files of synthetic pictures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from live_pairs_numpy import NumpyPairs, brooks_colours

import unprocess_gen as ug
from unprocess_gen.reports.timing import measure_in_turns
from unprocess_gen.simulation.reference.colour import CAMERAS, RGB2XYZ
from unprocess_gen.sources import synthetic

SIDE, PATCHES, BATCH, REPEATS = 128, 16, 16, 6
TWO, FAST = ("noise=imx385_iso3200",), ("noise=imx385_iso3200", "accuracy=fast")
NIGHT, DAYLIGHT = ("noise=sony_a7s2", "scene=night"), ("noise=sony_a7s2", "scene=daylight")
GOALS = {
    "two numbers": (TWO, "noise", 10),
    "two numbers, accuracy=fast": (FAST, "noise", 10),
    "two numbers, redraw=all": (TWO, "all", 10),
    "physical, night": (NIGHT, "noise", 8),
    "physical, daylight": (DAYLIGHT, "noise", 8),
}
"""Settings, ``redraw``, and the least ratio of the time of plain NumPy to that of live pairs."""
DECODE_GOAL = 1.2
DRAWN_ISO = ("noise=canon_70d", "scene=night", "scene.iso=[log_uniform,200,6400]")
REDRAWS: dict[str, tuple[tuple[str, ...], float | None]] = {
    "two numbers": (TWO, 1.7), "physical, night": (NIGHT, 1.9), "physical, drawn ISO": (DRAWN_ISO, None)
}  # fmt: skip
"""Settings, and the largest ratio of the time with ``redraw="all"`` to that with ``"noise"``."""


def median_ratio(times: Sequence[float], reference: Sequence[float]) -> float:
    """Return the median of the ratios within rounds."""
    return statistics.median(time / other for time, other in zip(times, reference, strict=True))


def write_scenes(folder: Path, count: int = 16) -> None:
    """Write JPEG files of 2048 x 2304 pixels, each of twelve synthetic pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for name in synthetic.NAMES if name not in synthetic.SIZES][:count]
    scenes = [synthetic.picture(name) for name in names]
    for number in range(count):
        parts = [scenes[(number + n) % len(scenes)] for n in range(12)]
        picture = np.vstack([np.hstack(parts[n : n + 3]) for n in range(0, 12, 3)])
        cv2.imwrite(str(folder / f"{number:03}.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])


def dataset(out: Path, photos: Path, settings: tuple[str, ...]) -> Path:
    """Generate the dataset of some settings, or find it finished."""
    folder = out / "-".join(setting.replace("=", "_") for setting in settings)
    ug.generate(ug.load_config([*settings, f"source.root={photos}", f"out={folder}"]))
    return folder


def numpy_pairs(folder: Path, cache: Path, redraw: str) -> NumpyPairs:
    """Return the same pairs in plain NumPy, from the same cached pixels."""
    live, stored = ug.LivePairs(folder, cache=cache, targets=["srgb"]), ug.RawPairs(folder)
    rows = [stored[number].row for number in range(len(stored))]
    for number in range(len(live)):
        _ = live[number]
    pixels = [np.load(cache / f"{row['source_sha256']}-0-1.npy", mmap_mode="r") for row in rows]
    rgb2xyz = np.reshape(RGB2XYZ, (3, 3))
    matrices = np.stack([np.reshape(xyz2cam, (3, 3)) @ rgb2xyz for xyz2cam in CAMERAS.values()])
    draw = (lambda rng: brooks_colours(rng, matrices)) if redraw == "all" else None
    return NumpyPairs(rows, pixels.__getitem__, SIDE, draw)


def us_per_item(pairs: Any, epoch: int, repeats: int = 1) -> float:
    """Processor time of an item in this thread, µs, over epochs from ``repeats * epoch`` on."""
    start = time.thread_time()
    for item in itertools.product(range(repeats * epoch, repeats * (epoch + 1)), range(len(pairs))):
        _ = pairs[item]
    return (time.thread_time() - start) / len(pairs) / repeats * 1e6


def summary(times: dict[str, list[float]], side: str, against: str, goal: float) -> dict[str, Any]:
    """Return the median times of two sides, their ratios within rounds, and the goal of the ratio."""
    ratios = [other / own for own, other in zip(times[side], times[against], strict=True)]
    both = {name: round(statistics.median(times[name]), 1) for name in (side, against)}
    spread = {"lowest": round(min(ratios), 2), "highest": round(max(ratios), 2)}
    return {**both, "ratio": round(median_ratio(times[against], times[side]), 2), **spread, "goal": goal}


def measure_goals(out: Path, photos: Path, cache: Path, rounds: int) -> dict[str, Any]:
    """Compare crops from the cache with plain NumPy."""
    results = {}
    for name, (settings, redraw, goal) in GOALS.items():
        folder = dataset(out, photos, settings)
        live = ug.LivePairs(folder, redraw=redraw, cache=cache, patch=SIDE)
        sides = {"live": live, "numpy": numpy_pairs(folder, cache, redraw)}
        for pairs in sides.values():
            us_per_item(pairs, 0)  # compiles kernels and maps files
        calls = {side: lambda n, pairs=pairs: us_per_item(pairs, n + 1, REPEATS) for side, pairs in sides.items()}
        results[name] = summary(measure_in_turns(calls, rounds), "live", "numpy", goal)
    return results


def measure_redraws(out: Path, photos: Path, cache: Path, rounds: int) -> dict[str, Any]:
    """Compare crops of which everything is drawn again with crops of new noise only."""
    results = {}
    for name, (settings, goal) in REDRAWS.items():
        folder = dataset(out, photos, settings)
        sides = {redraw: ug.LivePairs(folder, redraw=redraw, cache=cache, patch=SIDE) for redraw in ("all", "noise")}
        for pairs in sides.values():
            us_per_item(pairs, 0, REPEATS)
        calls = {side: lambda n, pairs=pairs: us_per_item(pairs, n + 1, REPEATS) for side, pairs in sides.items()}
        times = measure_in_turns(calls, rounds)
        both = {side: round(statistics.median(values), 1) for side, values in times.items()}
        results[name] = {**both, "ratio": round(median_ratio(times["all"], times["noise"]), 2), "goal": goal}
    return results


def measure_decoding(out: Path, photos: Path, rounds: int) -> dict[str, Any]:
    """Compare 16 patches of each file, without a cache, with bare decoding of its bytes."""
    folder = dataset(out, photos, TWO)
    live = ug.LivePairs(folder, patch=SIDE, patches=PATCHES)
    files = [photos / row.row["source"] for row in ug.RawPairs(folder)]

    def decode(_: int) -> float:
        start = time.thread_time()
        for file in files:
            cv2.imdecode(np.frombuffer(file.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
        return (time.thread_time() - start) / len(files) * 1e6

    us_per_item(live, 0)
    times = measure_in_turns({"live": lambda n: us_per_item(live, n + 1) * PATCHES, "decode": decode}, rounds)
    ratio = median_ratio(times["live"], times["decode"])
    both = {name: round(statistics.median(values), 1) for name, values in times.items()}
    return {**both, "ratio": round(ratio, 3), "goal": DECODE_GOAL}


def measure_training(out: Path, photos: Path, cache: Path, rounds: int) -> dict[str, Any]:
    """Compare sources of items, and the time of a training step of the tutorial's network for each item."""
    results: dict[str, Any] = {}
    for name, settings in (("two numbers", TWO), ("physical, night", NIGHT)):
        folder = dataset(out, photos, settings)
        sources = {
            "files": ug.RawPairs(folder, patch=SIDE),
            "live, cache": ug.LivePairs(folder, cache=cache, patch=SIDE),
            "live, 16 patches a decode": ug.LivePairs(folder, patch=SIDE, patches=PATCHES),
            "live, a decode each": ug.LivePairs(folder, patch=SIDE),
            "NumPy, cache": numpy_pairs(folder, cache, "noise"),
        }
        calls = {source: lambda n, pairs=pairs: us_per_item(pairs, n) for source, pairs in sources.items()}
        times = measure_in_turns(calls | step_of_network(), rounds)
        results[name] = {source: round(statistics.median(values[1:]), 1) for source, values in times.items()}
    return results


def step_of_network() -> dict[str, Callable[[int], float]]:
    """Return the measurement of a training step, µs for each item of a batch; empty without PyTorch."""
    try:
        import torch
    except ImportError:
        return {}
    import sys

    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from train_denoiser import Denoiser

    torch.set_num_threads(1)
    model = Denoiser()
    optimiser = torch.optim.Adam(model.parameters())
    planes = torch.rand(BATCH, 4, SIDE // 2, SIDE // 2)

    def step(_: int) -> float:
        start = time.thread_time()
        loss = (model(planes, planes) - planes).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        return (time.thread_time() - start) / BATCH * 1e6

    return {"training step": step}


def table(rows: list[list[Any]], head: list[str]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in [head, ["---"] * len(head), *rows]]
    return "\n".join(lines) + "\n"


def tables(results: dict[str, Any]) -> str:
    """Return the results as Markdown."""
    rows = [
        [name, row["live"], row["numpy"], f"{row['ratio']} ({row['lowest']} to {row['highest']})", row["goal"]]
        for name, row in results["goals"].items()
    ]
    text = table(rows, ["128² from the cache", "live, µs", "NumPy, µs", "ratio", "goal, at least"])
    rows = [[name, *row.values()] for name, row in results["redraws"].items()]
    text += "\n" + table(rows, ["128² from the cache", "redraw=all, µs", "redraw=noise, µs", "ratio", "goal, at most"])
    if "decode" in results:
        row = results["decode"]
        cells = [row["live"], row["decode"], row["ratio"], row["goal"]]
        text += "\n" + table([cells], ["16 patches a file, µs", "bare decoding, µs", "ratio", "goal, at most"])
        for name, times in results["training"].items():
            rows = [[source, us, round(1e6 / us)] for source, us in times.items()]
            text += "\n" + table(rows, [name, "µs an item", "items a second, one core"])
    return text


def main() -> None:
    """Measure, write the results and print them."""
    parser = argparse.ArgumentParser(description="Measure what a training gains in time from live pairs.")
    parser.add_argument("--out", type=Path, required=True, help="folder for datasets, cache and results")
    parser.add_argument("--photos", type=Path, help="folder of photographs; by default synthetic pictures as JPEG")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", choices=["goals"], help="leave out decoding and training")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    photos, cache = options.photos or options.out / "photos", options.out / "cache"
    if options.photos is None:
        write_scenes(photos)
    results: dict[str, Any] = {"goals": measure_goals(options.out, photos, cache, options.rounds)}
    results["redraws"] = measure_redraws(options.out, photos, cache, options.rounds)
    if options.only is None:
        results["decode"] = measure_decoding(options.out, photos, options.rounds)
        results["training"] = measure_training(options.out, photos, cache, max(options.rounds // 2, 2))
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    results |= {
        "sources": "photographs" if options.photos else "synthetic pictures",
        "rounds": options.rounds,
        **machine,
    }
    results |= {"load": [round(value, 1) for value in os.getloadavg()], "numpy": np.__version__}
    (options.out / "live_pairs.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(tables(results))


if __name__ == "__main__":
    main()
