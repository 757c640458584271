"""Experiment 2: let a small network tell real from simulated tiles of a sensor.

    python docs/experiments/classifier.py CAPTURES [--to RESULTS.json]

Needs PyTorch. CAPTURES is a folder that ``gen-dataset calibrate`` reads. Protocol: protocol.md.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from common import Level, Sensor, arguments, halves, interval, run, smooth, write
from torch import nn

SIDE, STEPS, BATCH, SEEDS = 64, 600, 32, (0, 1, 2)
SIZES = ((5, 5), (1, 31), (31, 1))
MODELS = {"dark": ("awgn", "two_numbers", "physical", "dark_frames"), "flat": ("awgn", "two_numbers", "physical")}


class Classifier(nn.Module):
    """Energies of filters that see grain, rows and columns; then two linear layers.

    The mean square of a filter w over a tile is w·C·w, where C is the mean product of pairs of sites below the filter.
    C is computed once for each tile and size, which takes a hundredth of the time of filtering in each step.
    """

    def __init__(self) -> None:
        super().__init__()
        self.filters = nn.ModuleList(nn.Conv2d(1, 8, size, bias=False) for size in SIZES)
        self.decide = nn.Sequential(nn.LayerNorm(24), nn.Linear(24, 16), nn.ReLU(), nn.Linear(16, 1))

    def forward(self, products: Any) -> Any:
        """Return the log odds that each tile is real, from its products of `products_of`."""
        weights = [filtered.weight.flatten(1) for filtered in self.filters]
        energies = [((c @ w.T) * w.T).sum(1) for c, w in zip(products, weights, strict=True)]
        return self.decide(torch.log(torch.cat(energies, 1) + 1e-4))[:, 0]


def products_of(frame: Any, scale: float) -> list[Any]:
    """Cut a frame into tiles without their means, divided by ``scale``; return their C of each size, [N, k, k]."""
    height, width = (side // SIDE for side in frame.shape)
    cut = frame[: height * SIDE, : width * SIDE].astype(np.float32).reshape(height, SIDE, width, SIDE)
    tiles = torch.from_numpy(cut.swapaxes(1, 2).reshape(-1, SIDE, SIDE))
    tiles = (tiles - tiles.mean((1, 2), keepdim=True)) / scale
    products = []
    for height, width in SIZES:
        below = tiles.unfold(1, height, 1).unfold(2, width, 1).flatten(3).flatten(1, 2)
        products.append(below.transpose(1, 2) @ below / below.shape[1])
    return products


def simulated(sensor: Sensor, levels: list[Level], model: str, first: int, folder: str, scale: float) -> list[Any]:
    """Return the products of a frame that is simulated for each frame of the levels."""
    extra = (f"noise.dark_frames={folder}", "effects.all=auto") if model == "dark_frames" else ()
    name = "physical" if model == "dark_frames" else model
    cleans = [clean for level in levels for clean in [smooth(level)] * len(level.frames)]
    frames = (sensor.simulate(name, clean, first + number, *extra) for number, clean in enumerate(cleans))
    return [products_of(frame, scale) for frame in frames]


def recorded(levels: list[Level], scale: float) -> list[Any]:
    """Return the products of each frame of the levels."""
    return [products_of(frame, scale) for level in levels for frame in level.frames]


def trained(pairs: list[tuple[Any, Any]], seed: int) -> Classifier:
    """Train a classifier on pairs of real and simulated tiles."""
    torch.manual_seed(seed)
    real, made = ([torch.cat(sizes) for sizes in zip(*side, strict=True)] for side in zip(*pairs, strict=True))
    classifier, labels = Classifier(), torch.cat((torch.ones(BATCH), torch.zeros(BATCH)))
    optimiser = torch.optim.Adam(classifier.parameters(), 0.003)
    for _ in range(STEPS):
        places = [torch.randint(len(side[0]), (BATCH,)) for side in (real, made)]
        chosen = [torch.cat((a[places[0]], b[places[1]])) for a, b in zip(real, made, strict=True)]
        loss = nn.functional.binary_cross_entropy_with_logits(classifier(chosen), labels)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return classifier


def accuracies(classifier: Classifier, pairs: list[tuple[Any, Any]]) -> list[float]:
    """Return the share of right answers for each judged frame and its simulation."""
    with torch.no_grad():
        return [
            float(((classifier(real) > 0).float().mean() + (classifier(made) <= 0).float().mean()) / 2)
            for real, made in pairs
        ]


def dark_folder(sensor: Sensor, levels: list[Level]) -> str:
    """Write the calibrating darks as NPY, and return their folder."""
    folder = sensor.folder / "darks"
    folder.mkdir()
    for number, frame in enumerate(frame for level in levels for frame in level.frames):
        np.save(folder / f"{number:03d}.npy", frame)
    return str(folder)


def main() -> None:
    """Run the experiment."""
    options = arguments(__doc__, "classifier", "captures of a sensor: EMVA data, captures.csv, or raw darks and flats")
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)
    calibrating, judged = halves(options.data)
    sensor = Sensor(calibrating)
    results: dict[str, Any] = {"tile": SIDE, "parameters": sum(p.numel() for p in Classifier().parameters())}
    for kind, models in MODELS.items():
        train, test = ([level for level in half if level.kind == kind] for half in (calibrating, judged))
        folder = dark_folder(sensor, train) if kind == "dark" else ""
        scale = float(np.sqrt(np.mean([np.subtract(*map(float_of, level.frames[:2])).var() / 2 for level in train])))
        results[kind], real = {}, [recorded(levels, scale) for levels in (train, test)]
        for model in models:
            made = [simulated(sensor, *half, folder, scale) for half in ((train, model, 10_000), (test, model, 20_000))]
            training, testing = (list(zip(*half, strict=True)) for half in zip(real, made, strict=True))
            scores = [accuracies(trained(training, seed), testing) for seed in SEEDS]
            by_frame = np.mean(scores, axis=0)
            results[kind][model] = {
                "accuracy": interval(by_frame, np.mean),
                "by_seed": [float(np.mean(score)) for score in scores],
                "judged_frames": len(by_frame),
                "judged_tiles": 2 * sum(len(real[0]) for real, _ in testing),
            }
            print(kind, model, results[kind][model], flush=True)
    write(results, options.to)


def float_of(frame: Any) -> Any:
    """Convert a frame to float64."""
    return frame.astype(np.float64)


if __name__ == "__main__":
    run(main)
