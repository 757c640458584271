"""Experiment 4: train one network on four kinds of noise, and judge it on real pairs.

    python docs/experiments/training.py PAIRS [--raw CAPTURES] [--photos FOLDER] [--to RESULTS.json]

Needs PyTorch. PAIRS is a folder of PolyU, SIDD, SID or ELD; CAPTURES is one that ``gen-dataset calibrate`` reads.
Protocol: protocol.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import torch
from common import Level, Sensor, arguments, halves, interval, write
from real_pairs import real_pairs
from torch import nn

import unprocess_gen as ug

WIDTH, SIDE, BATCH, STEPS, RATE, SEEDS = 24, 48, 8, 400, 0.002, (0, 1, 2)
NOISE = ["noise=canon_5d4", "scene.iso=[log_uniform, 800, 6400]"]
SCENES = {"srgb": "low_light", "srgb_daylight": "daylight"}
SRGB = ("awgn", "signal_dependent", "two_numbers", "physical")
RAW = ("awgn", "two_numbers", "physical")
TWO = ["effects.all=off", "effects.shot=on", "effects.read=on"]


def network(channels: int) -> nn.Sequential:
    """Return the untrained network."""
    sizes = [channels, WIDTH, WIDTH, WIDTH, WIDTH, channels]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def photographs(folder: Path | None) -> list[Any]:
    """Return training photographs, halved in size, which also reduces their own noise."""
    if folder is None:
        from skimage import data

        pictures = [data.astronaut(), data.chelsea(), data.coffee(), data.rocket()]
    else:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png"))
        pictures = [cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1] for file in files]
    half = [cv2.resize(np.ascontiguousarray(p), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for p in pictures]
    return [picture for picture in half if min(picture.shape[:2]) >= SIDE]


def crops(pictures: Sequence[Any], seed: int) -> Iterator[tuple[int, Any]]:
    """Yield the number and the pixels of random crops, the same for all models."""
    random = np.random.default_rng(seed)
    for number in range(STEPS * BATCH):
        picture = pictures[random.integers(len(pictures))]
        y, x = (random.integers(side - SIDE + 1) for side in picture.shape[:2])
        yield number, np.ascontiguousarray(picture[y : y + SIDE, x : x + SIDE])


def noise_by_level(noisy: Any, clean: Any) -> Any:
    """Return the standard deviation of the noise of each pixel, from that of its band of levels."""
    bands, std = clean // 32, np.empty(clean.shape)
    for channel in range(3):
        for band in np.unique(bands[..., channel]):
            where = bands[..., channel] == band
            std[..., channel][where] = np.sqrt(np.mean((noisy[..., channel][where] - clean[..., channel][where]) ** 2))
    return std


def camera_patches(settings: Sequence[str], pictures: Sequence[Any], seed: int) -> list[tuple[Any, Any]]:
    """Return clean and noisy patches of `CameraNoise`."""
    camera = ug.CameraNoise(settings, seed=seed)
    return [camera(crop, index=number) for number, crop in crops(pictures, seed)]


def srgb_patches(model: str, patches: Sequence[tuple[Any, Any]], seed: int) -> Iterator[tuple[Any, Any]]:
    """Yield noisy and clean patches of a model; white models have the strength of the two-number ``patches``."""
    random = np.random.default_rng(100 + seed)
    for pair in patches:
        clean, noisy = (picture.astype(np.float64) for picture in pair)
        if model in ("awgn", "signal_dependent"):
            std = np.std(noisy - clean) if model == "awgn" else noise_by_level(noisy, clean)
            noisy = np.clip(np.rint(clean + random.normal(0, 1, clean.shape) * std), 0, 255)
        yield noisy / 255, clean / 255


def raw_patches(model: str, pictures: Sequence[Any], seed: int, sensor: Sensor) -> Iterator[tuple[Any, Any]]:
    """Yield noisy and clean raw patches of a sensor, of one channel; their exposure is drawn."""
    span, random = sensor.white - sensor.black, np.random.default_rng(200 + seed)
    for number, crop in crops(pictures, seed):
        light = (crop.mean(axis=2) / 255) ** 2.2 * np.exp(random.uniform(np.log(0.02), 0))
        clean = sensor.black + light * span
        noisy = sensor.simulate(model, clean, 10_000 * (seed + 1) + number)
        yield to_input(noisy, sensor)[..., None], to_input(clean, sensor)[..., None]


def to_input(dn: Any, sensor: Sensor) -> Any:
    """Return the square root of light, in which shot noise has about the same deviation at all levels."""
    light = (np.asarray(dn, np.float64) - sensor.black) / (sensor.white - sensor.black)
    return np.sign(light) * np.sqrt(np.abs(light))


def from_input(values: Any, sensor: Sensor) -> Any:
    """Return DN above black from values of the network."""
    return np.sign(values) * values**2 * (sensor.white - sensor.black)


def to_tensor(images: Sequence[Any]) -> Any:
    """Stack images [H, W, C] as a batch."""
    return torch.from_numpy(np.stack(images).astype(np.float32)).permute(0, 3, 1, 2)


def trained(patches: Iterator[tuple[Any, Any]], channels: int, seed: int) -> nn.Sequential:
    """Train a network on patches of one model."""
    torch.manual_seed(seed)
    model = network(channels)
    optimiser = torch.optim.Adam(model.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        noisy, clean = (to_tensor(images) for images in zip(*(next(patches) for _ in range(BATCH)), strict=True))
        loss = nn.functional.mse_loss(noisy - model(noisy), clean)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model


def denoised(model: nn.Sequential, image: Any) -> Any:
    """Denoise one image [H, W, C]."""
    with torch.no_grad():
        noisy = to_tensor([image])
        return (noisy - model(noisy))[0].permute(1, 2, 0).numpy().astype(np.float64)


def quality(image: Any, clean: Any) -> tuple[float, float]:
    """Return PSNR in dB and SSIM of an image in [0, 1]."""
    from skimage.metrics import structural_similarity

    image = np.clip(image, 0, 1)
    similar = structural_similarity(clean, image, channel_axis=2, data_range=1)
    return float(-10 * np.log10(np.mean((image - clean) ** 2))), float(similar)


def by_scene(scenes: Sequence[str], values: Any) -> Any:
    """Return the mean of the values of each scene."""
    return np.array([np.mean(values[[scene == other for other in scenes]], axis=0) for scene in sorted(set(scenes))])


def by_seed(scores: Callable[..., dict[str, Any]], *given: Any) -> list[dict[str, Any]]:
    """Return what a function gives for each seed, each in its own process with one thread."""
    return list(joblib.Parallel(n_jobs=len(SEEDS))(joblib.delayed(scores)(seed, *given) for seed in SEEDS))


def srgb_scores(
    seed: int, pairs: Sequence[tuple[str, Any, Any]], pictures: Sequence[Any], settings: Sequence[str]
) -> dict[str, Any]:
    """Train all models with a seed; return PSNR and SSIM of each pair."""
    prepare()
    two, scores = camera_patches([*settings, *TWO], pictures, seed), {}
    for model in SRGB:
        patches = camera_patches(settings, pictures, seed) if model == "physical" else two
        net = trained(srgb_patches(model, patches, seed), 3, seed)
        scores[model] = [quality(denoised(net, noisy), clean) for _, noisy, clean in pairs]
        print(model, seed, np.mean(scores[model], axis=0), flush=True)
    return scores


def raw_scores(seed: int, judged: Sequence[Level], sensor: Sensor, pictures: Sequence[Any]) -> dict[str, Any]:
    """Train all models of raw noise with a seed; return the error of each level."""
    prepare()
    scores = {}
    for model in RAW:
        net = trained(raw_patches(model, pictures, seed, sensor), 1, seed)
        scores[model] = [
            shares(lambda dn, net=net: denoised(net, to_input(dn, sensor)[..., None]), level, sensor)
            for level in judged
        ]
        print(model, seed, np.median(scores[model]), flush=True)
    return scores


def prepare() -> None:
    """Make PyTorch repeatable."""
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)


def noise_codes(pairs: Iterator[tuple[Any, Any]]) -> float:
    """Return the median over pictures of the standard deviation of their noise, codes of 8 bits."""
    return float(np.median([np.std(noisy - clean) for noisy, clean in pairs]) * 255)


def judge_srgb(folder: Path, pictures: Sequence[Any], scene: str) -> dict[str, Any]:
    """Train on all models, and compare them on real sRGB pairs."""
    settings = [*NOISE, f"scene={scene}"]
    pairs = [(pair.scene, pair.noisy / 255, pair.clean / 255) for pair in real_pairs(folder)]
    if not pairs:
        raise SystemExit(f"{folder}: no pairs; expected files named as in PolyU, SIDD, SID or ELD")
    scenes = [scene for scene, _, _ in pairs]
    scores = {"noisy": np.array([quality(noisy, clean) for _, noisy, clean in pairs])}
    seeds = by_seed(srgb_scores, pairs, pictures, settings)
    trained_on = srgb_patches("two_numbers", camera_patches([*settings, *TWO], pictures, 0), 0)
    for model in SRGB:
        scores[model] = np.mean([found[model] for found in seeds], axis=0)
        scores[f"{model}_seeds"] = np.mean([found[model] for found in seeds], axis=1)[:, 0]
    means = {model: by_scene(scenes, scores[model]) for model in ("noisy", *SRGB)}
    differences = [("two_numbers", "awgn"), ("two_numbers", "signal_dependent"), ("physical", "two_numbers")]
    return {
        "pairs": len(pairs),
        "noise_codes": {"trained": noise_codes(trained_on), "judged": noise_codes(pair[1:] for pair in pairs)},
        "scenes": len(means["noisy"]),
        "parameters": sum(p.numel() for p in network(3).parameters()),
        "psnr_db": {model: interval(means[model][:, 0], np.mean) for model in means},
        "ssim": {model: interval(means[model][:, 1], np.mean) for model in means},
        "psnr_db_by_seed": {model: scores[f"{model}_seeds"] for model in SRGB},
        "psnr_difference_db": {
            f"{first} - {second}": interval(means[first][:, 0] - means[second][:, 0], np.mean)
            for first, second in differences
        },
        "ssim_difference": {
            f"{first} - {second}": interval(means[first][:, 1] - means[second][:, 1], np.mean)
            for first, second in differences
        },
    }


def judge_raw(folder: Path, pictures: Sequence[Any]) -> dict[str, Any]:
    """Train on all models, and compare them on pairs of raw frames without clean ones."""
    calibrating, judged = halves(folder)
    sensor = Sensor(calibrating)
    seeds = by_seed(raw_scores, judged, sensor, pictures)
    errors = {model: np.mean([found[model] for found in seeds], axis=0) for model in RAW}
    return {
        "judged_levels": len(judged),
        "error_to_noise": {model: interval(errors[model]) for model in RAW},
        "error_ratio": {
            f"{first} / {second}": interval(errors[first] / errors[second])
            for first, second in (("two_numbers", "awgn"), ("physical", "two_numbers"))
        },
        "by_level": [
            {"kind": level.kind, "mean_dn": level.mean_dn, **{model: float(errors[model][n]) for model in RAW}}
            for n, level in enumerate(judged)
        ],
    }


def shares(denoise: Callable[[Any], Any], level: Any, sensor: Sensor) -> float:
    """Return the squared error of a denoised frame divided by the variance of its noise, without a clean frame."""
    first, second = (np.asarray(frame, np.float64) for frame in level.frames[:2])
    variance = np.mean((first - second - np.mean(first - second)) ** 2) / 2
    predicted = sensor.black + from_input(denoise(first)[..., 0], sensor)
    return float((np.mean((predicted - second) ** 2) - variance) / variance)


def main() -> None:
    """Run the experiment."""
    options = arguments(__doc__, "training", "folder of PolyU, SIDD, SID or ELD")
    pictures = photographs(options.photos)
    results: dict[str, Any] = {"photographs": len(pictures), "steps": STEPS, "seeds": len(SEEDS)}
    for name, scene in SCENES.items():
        results[name] = judge_srgb(options.data, pictures, scene)
        write(results, options.to)
    if options.raw:
        results["raw"] = judge_raw(options.raw, pictures)
    write(results, options.to)


if __name__ == "__main__":
    main()
