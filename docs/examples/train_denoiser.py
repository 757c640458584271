"""Train a small raw denoiser on pairs of unprocess_gen, and compare it with filters: the example of docs/tutorial.md.

``python train_denoiser.py`` uses the synthetic pictures; ``--photos FOLDER`` uses the photographs of a folder. It needs
PyTorch, and writes a dataset (``denoiser_scenes`` or ``denoiser_photos``) and the picture ``denoiser.jpg`` below
``--out``. A fifth of the photographs is not trained on; all figures come from it.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader

import unprocess_gen as ug
from unprocess_gen.torch import develop

NOISE = "imx385_iso12800"
PLANES = {"inputs": "packed", "noise_map": True}
"""Items: noisy planes, clean planes and noise map, float32 [4, H, W], 0 at black and 1 at white."""
CROP = 64
"""Side of a training crop, in sites of the mosaic; even."""
BATCH = 16
"""Crops of a batch, and crops of each image in an epoch."""
WIDTH = 32
"""Channels of the hidden layers."""


class Denoiser(nn.Module):
    """Estimate the noise of four planes, in units of its standard deviation, and subtract it: a small DnCNN."""

    def __init__(self, width: int = WIDTH, hidden_layers: int = 4) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(8, width, 3, padding=1), nn.ReLU()]
        for _ in range(hidden_layers):
            layers += [nn.Conv2d(width, width, 3, padding=1), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(width, 4, 3, padding=1))

    def forward(self, noisy: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
        """Return the denoised planes."""
        return noisy - std * self.layers(torch.cat([noisy, std], dim=1))


def train(model: Denoiser, crops: ug.LivePairs, steps: int, workers: int) -> None:
    """Minimise the mean error in units of the noise."""
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    sampler = ug.EpochSampler(len(crops))
    loader = DataLoader(crops, batch_size=BATCH, sampler=sampler, num_workers=workers, persistent_workers=workers > 0)
    epochs = itertools.chain.from_iterable(itertools.repeat(loader))
    start, losses = time.process_time(), []
    for step, batch in enumerate(itertools.islice(epochs, steps), start=1):
        std = batch["noise_std"]
        loss = ((model(batch["noisy"], std) - batch["clean"]).abs() / std).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        losses.append(loss.item())
        if step % 200 == 0 or step == steps:
            seconds = time.process_time() - start
            print(f"step {step:5}: mean error {np.mean(losses[-200:]):.3f} of the noise; {seconds:4.0f} s", flush=True)


Filter = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A denoiser: noisy planes and noise map to planes, float32 [4, H, W]."""


def gaussian(std_sites: float) -> Filter:
    """Return a Gaussian filter of each plane."""
    return lambda noisy, _: np.stack([cv2.GaussianBlur(plane, (0, 0), std_sites) for plane in noisy])


def bilateral(std_sites: float, std_range: float) -> Filter:
    """Return a bilateral filter of each plane; ``std_range`` is in units of the mean noise."""
    return lambda noisy, std: np.stack(
        [cv2.bilateralFilter(plane, -1, std_range * float(std.mean()), std_sites) for plane in noisy]
    )


def network(model: Denoiser) -> Filter:
    """Return the trained model as a filter."""

    def filtered(noisy: np.ndarray, std: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return model(torch.from_numpy(noisy)[None], torch.from_numpy(std)[None])[0].numpy()

    return filtered


def psnr(denoised: Filter, pairs: ug.RawPairs) -> float:
    """Return the mean PSNR of denoised frames in raw, dB; the peak is the white level above black."""
    values = []
    for pair in pairs:
        error = np.clip(denoised(pair["noisy"], pair["noise_std"]), 0, 1) - pair["clean"]
        values.append(-10 * np.log10(np.mean(error**2)))
    return float(np.mean(values))


def best(candidates: dict[str, Filter], pairs: ug.RawPairs) -> tuple[str, Filter]:
    """Return name and filter of the highest PSNR on ``pairs``."""
    name = max(candidates, key=lambda one: psnr(candidates[one], pairs))
    return name, candidates[name]


def draw(path: Path, denoised: Filter, pairs: ug.RawPairs) -> None:
    """Save crops of the noisy, the denoised and the clean frame of two pairs, developed to sRGB."""
    rows = []
    for pair in pairs:
        frames = np.stack([pair["noisy"], denoised(pair["noisy"], pair["noise_std"]), pair["clean"]])
        top, left = (frames.shape[2] - 80) // 2, (frames.shape[3] - 100) // 2
        crops = torch.from_numpy(frames[:, :, top : top + 80, left : left + 100].copy())
        rows.append(np.hstack(np.moveaxis(develop(crops, pair["development"]).numpy(), 1, -1)))
    image = np.rint(255 * np.vstack(rows)).astype(np.uint8)
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 92])


def main() -> None:
    """Generate the dataset, train, measure and draw."""
    parser = argparse.ArgumentParser(description="Train a small raw denoiser.")
    parser.add_argument("--photos", help="folder of photographs; by default 50 synthetic pictures")
    parser.add_argument("--scenes", type=int, default=50, help="number of synthetic pictures")
    parser.add_argument("--steps", type=int, default=2000, help="training steps")
    parser.add_argument("--workers", type=int, default=0, help="processes that load crops")
    parser.add_argument("--out", type=Path, default=Path(), help="folder to write to")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)  # convolutions this small are slower with several threads

    name, source = (
        ("photos", f"source.root={options.photos}") if options.photos else ("scenes", f"source.limit={options.scenes}")
    )
    data = options.out / f"denoiser_{name}"
    try:
        ug.generate(ug.load_config([source, f"noise={NOISE}", "split={train: 0.8, test: 0.2}", f"out={data}"]))
        crops = ug.LivePairs(data, split="train", cache="memory", patch=CROP, patches=BATCH, **PLANES)
        known, new = (ug.RawPairs(data, split=part, **PLANES) for part in ("train", "test"))
    except ug.UnprocessGenError as error:
        raise SystemExit(f"{parser.prog}: {error}") from error
    model = Denoiser()
    size = sum(parameter.numel() for parameter in model.parameters())
    print(f"{len(known)} pairs to train on, {len(new)} held out; {size:,} parameters")

    train(model, crops, options.steps, options.workers)

    few = known[:: max(len(known) // 8, 1)]
    gaussians = {f"Gaussian, {std} sites": gaussian(std) for std in (0.4, 0.6, 0.8, 1.0, 1.3, 1.7)}
    bilaterals = {
        f"bilateral, {std} sites, {width} sigma": bilateral(std, width)
        for std in (1.0, 1.5, 2.5)
        for width in (2, 3, 5)
    }
    print("PSNR of held-out frames, raw DN:")
    results = {"noisy frame": lambda noisy, _: noisy}
    results |= dict([best(gaussians, few), best(bilaterals, few)]) | {"network": network(model)}
    for name, one in results.items():
        print(f"  {name:32} {psnr(one, new):5.2f} dB")
    draw(options.out / "denoiser.jpg", network(model), new[:: max(len(new) // 2, 1)][:2])


if __name__ == "__main__":
    main()
