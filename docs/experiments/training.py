"""Experiment 4: train one network on several kinds of noise, and judge it on real pairs.

    python docs/experiments/training.py PAIRS [--raw CAPTURES] [--photos FOLDER] [--to RESULTS.json]

Needs PyTorch. PAIRS is a folder of PolyU, SIDD, patches of SIDD, SID or ELD, or of several of these, which are judged
apart; CAPTURES is one that ``gen-dataset calibrate`` reads. With FOLDER, which has more photographs, the results are a
part of their own. The scores of each training are added to RESULTS.jsonl, or RESULTS.photos.jsonl, and a training that
has a line there is not repeated. Protocol: protocol.md.
"""

from __future__ import annotations

import functools
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice, pairwise, product
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import torch
from common import Level, Sensor, arguments, halves, interval, run, write
from real_pairs import FORMS, PATCHES, RealPair, real_pairs
from torch import nn

import unprocess_gen as ug
from unprocess_gen.picture_isp import YCBCR

WIDTH, BATCH, RATE, SEEDS = 24, 8, 0.002, (0, 1, 2)
SIDE, STEPS, STEPS_PER_PICTURE = 32, 1600, 20 / 3
RAW_SIDE, RAW_STEPS, LARGEST = 48, 400, 256
DAYLIGHT = ["noise=canon_5d4", "scene.iso=[log_uniform, 800, 6400]", "scene=daylight"]
DAYLIGHT += ["effects.all=off", "effects.shot=on", "effects.read=on"]
PHONES = ["noise=heteroscedastic", "noise.a=[log_uniform, 3, 60]", "noise.b=[log_uniform, 60, 3000]"]
PHONES += ["noise.units=dn", "noise.black=subtracted"]
PHONES += ["noise.bits=12", "noise.black_level_dn=240", "noise.white_level_dn=4095"]
NOISE = {"SIDD": PHONES, "SIDD_patches": PHONES}
"""Two numbers for the pictures of a set; `DAYLIGHT` for all others."""
WHITE = {"awgn": 1.0, "awgn_1.6": 1.6, "awgn_2.5": 2.5}
"""White models, and their deviation in luma relative to that of `CameraNoise`."""
CAMERA = {"bilinear": "bilinear", "malvar": "malvar"}
FITTED: dict[str, dict[str, Any]] = {"fitted": {}, "fitted_isp": {"clean": "mean"}}
"""Fitted models, and their further arguments of `CameraNoise`."""
JPEG = {"PolyU": 75}
"""Quality of the JPEG pictures of a set, which `fitted_isp` knows."""
FITTED_PAIRS, STRENGTH = 6, ["log_uniform", 0.58, 1.73]
MODELS = (*WHITE, *CAMERA, *FITTED, "real")
DIFFERENCES = (
    ("malvar", "awgn"),
    ("malvar", "best_awgn"),
    ("bilinear", "awgn"),
    ("malvar", "bilinear"),
    ("fitted", "malvar"),
    ("fitted", "best_awgn"),
    ("fitted_isp", "fitted"),
    ("fitted_isp", "malvar"),
    ("fitted_isp", "best_awgn"),
    ("real", "best_awgn"),
)
LUMA = YCBCR[0].astype(np.float32)
RAW = ("awgn", "two_numbers", "physical")


def network(channels: int) -> nn.Sequential:
    """Return the untrained network."""
    sizes = [channels, WIDTH, WIDTH, WIDTH, WIDTH, channels]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


@functools.cache
def photographs(folder: Path | None) -> list[Any]:
    """Return training photographs, halved or with a shorter side of 256, which also reduces their own noise."""
    if folder is None:
        from skimage import data

        pictures = [data.astronaut(), data.chelsea(), data.coffee(), data.rocket()]
    else:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in (".jpg", ".jpeg", ".png"))
        pictures = [cv2.imread(str(file), cv2.IMREAD_COLOR)[..., ::-1] for file in files]
    scales = [min(0.5, LARGEST / min(picture.shape[:2])) for picture in pictures]
    reduced = [
        cv2.resize(np.ascontiguousarray(picture), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for picture, scale in zip(pictures, scales, strict=True)
    ]
    return [picture for picture in reduced if min(picture.shape[:2]) >= RAW_SIDE]


def crops(pictures: Sequence[Any], seed: int) -> Iterator[tuple[int, Any]]:
    """Yield the number and the pixels of random crops for raw frames, the same for all models."""
    random = np.random.default_rng(seed)
    for number in range(RAW_STEPS * BATCH):
        picture = pictures[random.integers(len(pictures))]
        y, x = (random.integers(side - RAW_SIDE + 1) for side in picture.shape[:2])
        yield number, np.ascontiguousarray(picture[y : y + RAW_SIDE, x : x + RAW_SIDE])


@dataclass(frozen=True, eq=False)
class RealSet:
    """Real pairs of one kind, which are judged together."""

    name: str
    pairs: list[RealPair]

    def half(self, half: int) -> list[int]:
        """Return the numbers of the pairs of one half of the scenes, which alternate in order."""
        scenes = sorted({pair.scene for pair in self.pairs})[half::2]
        return [number for number, pair in enumerate(self.pairs) if pair.scene in scenes]

    def by_group(self, values: Any) -> Any:
        """Return the mean of the values of each group: scene, and phone and ISO if they are known."""
        groups = [(pair.scene, pair.group) for pair in self.pairs]
        return np.array([np.mean(values[[own == group for own in groups]], axis=0) for group in sorted(set(groups))])


@dataclass(frozen=True)
class Training:
    """One training: the set whose pictures judge it, its noise, seed, steps, and the half of the scenes it has seen."""

    pictures: str
    model: str
    seed: int
    steps: int
    half: int | None = None


def trainings(sets: Sequence[str], photos: Path | None) -> Iterator[Training]:
    """Yield all trainings, those that need no fit first; real pairs need no photographs."""
    for seed, name, model in product(SEEDS, sets, (*WHITE, *CAMERA)):
        yield Training(name, model, seed, STEPS)
    for model, seed, name, half in product(FITTED, SEEDS, sets, (0, 1)):
        yield Training(name, model, seed, STEPS, half)
    for name, model in product(sets, (*CAMERA, *WHITE)):
        yield Training(name, model, SEEDS[0], 2 * STEPS)
    for name, half in product(sets if photos is None else (), (0, 1)):
        yield Training(name, "real", SEEDS[0], STEPS, half)


@functools.lru_cache(maxsize=2)
def camera_pictures(name: str, demosaic: str, seed: int, steps: int, photos: Path | None) -> list[tuple[Any, Any]]:
    """Return noisy and clean pictures of `CameraNoise`, which takes the photographs in turn."""
    camera, pictures = ug.CameraNoise(NOISE.get(name, DAYLIGHT), demosaic=demosaic, seed=seed), photographs(photos)
    count = round(steps / STEPS_PER_PICTURE)
    return [camera(pictures[number % len(pictures)], index=number)[::-1] for number in range(count)]


@functools.cache
def fits_of(judged_on: RealSet, half: int, jpeg: int | None) -> dict[str, Any]:
    """Fit `CameraNoise` to the pairs of one half, for each phone or camera and ISO apart."""
    groups: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
    for pair in (judged_on.pairs[number] for number in judged_on.half(half)):
        device_and_iso = pair.group or "_".join(pair.name.split("_")[0:4:3])
        groups[device_and_iso].append((pair.noisy, pair.clean))
    return {group: ug.CameraNoise.fit(groups[group][:FITTED_PAIRS], jpeg=jpeg) for group in sorted(groups)}


def fitted_pictures(training: Training, fits: Sequence[Any], photos: Path | None) -> list[tuple[Any, Any]]:
    """Return noisy and clean pictures of fits; each round of the photographs has one of them."""
    cameras = [fit.noise(seed=training.seed, strength=STRENGTH, **FITTED[training.model]) for fit in fits]
    pictures, made = photographs(photos), []
    for number in range(round(training.steps / STEPS_PER_PICTURE)):
        turn, picture = divmod(number, len(pictures))
        made.append(cameras[turn % len(cameras)](pictures[picture], index=number)[::-1])
    return made


def cuts(pictures: Sequence[tuple[Any, Any]], seed: int, steps: int) -> Iterator[tuple[Any, Any]]:
    """Yield noisy and clean patches, at the same places for all models with pictures of the same shapes."""
    random = np.random.default_rng(seed)
    for _ in range(steps * BATCH):
        noisy, clean = pictures[random.integers(len(pictures))]
        y, x = (random.integers(side - SIDE + 1) for side in clean.shape[:2])
        yield tuple(picture[y : y + SIDE, x : x + SIDE].astype(np.float32) for picture in (noisy, clean))


def whitened(patches: Iterator[tuple[Any, Any]], strength: float, seed: int) -> Iterator[tuple[Any, Any]]:
    """Replace the noise of patches by white noise, whose deviation in luma is ``strength`` times theirs."""
    random = np.random.default_rng(100 + seed)
    for noisy, clean in patches:
        std = strength * np.std((noisy - clean) @ LUMA) / np.sqrt(LUMA @ LUMA)
        drawn = random.standard_normal(clean.shape, np.float32) * np.float32(std)
        yield np.clip(np.rint(clean + drawn), 0, 255), clean


def patches_of(training: Training, judged_on: RealSet, photos: Path | None) -> Iterator[tuple[Any, Any]]:
    """Return the patches of a training, noisy and clean, in codes of 8 bits."""
    model, half, seed, steps = training.model, training.half, training.seed, training.steps
    if half is None:
        pictures = camera_pictures(judged_on.name, CAMERA.get(model, "malvar"), seed, steps, photos)
    elif model in FITTED:
        pictures = fitted_pictures(training, list(fits_of(judged_on, half, jpeg_of(training)).values()), photos)
    else:
        seen = (judged_on.pairs[number] for number in judged_on.half(half))
        pictures = [(pair.noisy, pair.clean) for pair in seen]
    patches = cuts(pictures, seed, steps)
    return whitened(patches, WHITE[model], seed) if model in WHITE else patches


def jpeg_of(training: Training) -> int | None:
    """Return the quality of the JPEG pictures that the noise of a training has."""
    return JPEG.get(training.pictures) if training.model == "fitted_isp" else None


def noise_facts(pairs: Sequence[tuple[Any, Any]]) -> dict[str, float]:
    """Return the median deviation of the luma of noise, in codes, and its median correlation of red and green."""
    noises = [np.subtract(noisy, clean, dtype=np.float64) for noisy, clean in pairs]
    cross = [np.corrcoef(n[..., 0].ravel(), n[..., 1].ravel())[0, 1] for n in noises if n[..., :2].std((0, 1)).all()]
    return {"luma_codes": float(np.median([np.std(n @ LUMA) for n in noises])), "red_green": float(np.median(cross))}


def raw_patches(model: str, pictures: Sequence[Any], seed: int, sensor: Sensor) -> Iterator[tuple[Any, Any]]:
    """Yield noisy and clean raw patches of a sensor, of one channel; their exposure is drawn."""
    span, random = sensor.white - sensor.black, np.random.default_rng(200 + seed)
    for number, crop in crops(pictures, seed):
        light = (crop.mean(axis=2) / 255) ** 2.2 * np.exp(random.uniform(np.log(0.02), 0))
        clean = sensor.black + light * span
        # each patch is another place of the sensor, with a fixed pattern of its own
        noisy = sensor.simulate(model, clean, 10_000 * (seed + 1) + number, "sensor.units=image")
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


def trained(patches: Iterator[tuple[Any, Any]], channels: int, seed: int, steps: int) -> nn.Sequential:
    """Train a network on patches of one model."""
    torch.manual_seed(seed)
    model = network(channels)
    optimiser = torch.optim.Adam(model.parameters(), RATE, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
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


def by_seed(scores: Callable[..., dict[str, Any]], *given: Any) -> list[dict[str, Any]]:
    """Return what a function gives for each seed, each in its own process with one thread."""
    return list(joblib.Parallel(n_jobs=len(SEEDS))(joblib.delayed(scores)(seed, *given) for seed in SEEDS))


def raw_scores(seed: int, judged: Sequence[Level], sensor: Sensor, pictures: Sequence[Any]) -> dict[str, Any]:
    """Train all models of raw noise with a seed; return the error of each level."""
    prepare()
    scores = {}
    for model in RAW:
        net = trained(raw_patches(model, pictures, seed, sensor), 1, seed, RAW_STEPS)
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


def judged(training: Training, judged_on: RealSet, photos: Path | None) -> dict[str, Any]:
    """Train, and return PSNR and SSIM of the judged pairs by their numbers, with the facts of the training noise."""
    prepare()
    pairs, half = judged_on.pairs, training.half
    facts = noise_facts(list(islice(patches_of(training, judged_on, photos), 300)))
    patches = ((noisy / 255, clean / 255) for noisy, clean in patches_of(training, judged_on, photos))
    net = trained(patches, 3, training.seed, training.steps)
    numbers = range(len(pairs)) if half is None else judged_on.half(1 - half)
    scores = {n: quality(denoised(net, pairs[n].noisy / 255), pairs[n].clean / 255) for n in numbers}
    line = {"training": asdict(training), "scores": scores, **facts}
    if half is not None and training.model in FITTED:
        fits = fits_of(judged_on, half, jpeg_of(training))
        line["fits"] = {group: [*fit.overrides, *map(str, fit.options.items())] for group, fit in fits.items()}
    return line


def scores_of_all(sets: Sequence[RealSet], file: Path, photos: Path | None) -> dict[Training, dict[str, Any]]:
    """Return the scores of all trainings: those in the file, and the others, which are added to it."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    found = {Training(**line["training"]): line for line in map(json.loads, lines)}
    by_name = {judged_on.name: judged_on for judged_on in sets}
    for training in trainings(list(by_name), photos):
        if training not in found:
            line = json.dumps(judged(training, by_name[training.pictures], photos))
            with file.open("a", encoding="utf-8") as stream:
                stream.write(line + "\n")
            found[training] = json.loads(line)
            print(training, np.mean(list(found[training]["scores"].values()), axis=0), flush=True)
    return found


def quality_of(found: Iterable[dict[str, Any]], count: int) -> Any:
    """Return PSNR and SSIM of the pairs of a set after one training, or after those of both halves: [pairs, 2]."""
    values = np.full((count, 2), np.nan)
    for scores in found:
        for number, score in scores["scores"].items():
            values[int(number)] = score
    return values


def summary(judged_on: RealSet, found: dict[Training, dict[str, Any]]) -> dict[str, Any]:
    """Compare the models on the pairs of a set."""
    pairs, by_group = judged_on.pairs, judged_on.by_group
    lines: dict[tuple[str, int, int], list[dict[str, Any]]] = defaultdict(list)
    for training, line in found.items():
        if training.pictures == judged_on.name:
            lines[training.model, training.seed, training.steps].append(line)
    by_pair = {key: quality_of(line, len(pairs)) for key, line in lines.items()}
    seeds = {model: SEEDS[:1] if model == "real" else SEEDS for model in MODELS}
    models = [m for m in MODELS if all(np.isfinite(by_pair.get((m, s, STEPS), np.nan)).all() for s in seeds[m])]
    groups = {"noisy": by_group(np.array([quality(pair.noisy / 255, pair.clean / 255) for pair in pairs]))}
    for model in models:
        groups[model] = by_group(np.mean([by_pair[model, s, STEPS] for s in seeds[model]], axis=0))
    best = max((model for model in WHITE if model in groups), key=lambda model: np.mean(groups[model][:, 0]))
    compared = {**groups, "best_awgn": groups[best]}
    differences = [pair for pair in DIFFERENCES if pair[0] in compared and pair[1] in compared]
    noise = {"judged": noise_facts([(pair.noisy, pair.clean) for pair in pairs])}
    for model in models:
        trained_on = [line for s in seeds[model] for line in lines[model, s, STEPS]]
        noise[model] = {fact: float(np.median([line[fact] for line in trained_on])) for fact in noise["judged"]}
    measures = {"psnr": 0, "ssim": 1}
    return {
        "pairs": len(pairs),
        "groups": len(groups["noisy"]),
        "not_run": [model for model in MODELS if model not in models],
        "best_awgn": best,
        "noise": noise,
        **{f: {model: interval(groups[model][:, n], np.mean) for model in groups} for f, n in measures.items()},
        **{
            f"{measure}_difference": {
                f"{first} - {second}": interval(compared[first][:, n] - compared[second][:, n], np.mean)
                for first, second in differences
            }
            for measure, n in measures.items()
        },
        "psnr_by_seed": {
            model: [float(np.mean(by_group(by_pair[model, s, STEPS])[:, 0])) for s in seeds[model]] for model in models
        },
        "psnr_of_longer_training": {
            model: float(np.mean(by_group(by_pair[model, SEEDS[0], 2 * STEPS])[:, 0]))
            for model in models
            if (model, SEEDS[0], 2 * STEPS) in by_pair
        },
        "fits": [
            {"model": training.model, "half": training.half, **line["fits"]}
            for training, line in found.items()
            if training.pictures == judged_on.name and training.seed == SEEDS[0] and "fits" in line
        ],
        "psnr_by_group": {model: values[:, 0] for model, values in groups.items()},
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
    forms = {**FORMS, **PATCHES}
    sets = [RealSet(name, list(real_pairs(options.data, {name: form}))) for name, form in forms.items()]
    sets = [judged_on for judged_on in sets if judged_on.pairs]
    if not sets:
        raise SystemExit(f"{options.data}: no pairs; expected files named as in PolyU, SIDD, SID or ELD")
    found = scores_of_all(sets, options.to.with_suffix(".photos.jsonl" if options.photos else ".jsonl"), options.photos)
    pictures = photographs(options.photos)
    part = {"photographs": len(pictures), "sets": {judged_on.name: summary(judged_on, found) for judged_on in sets}}
    parameters = sum(p.numel() for p in network(3).parameters())
    results = json.loads(options.to.read_text(encoding="utf-8")) if options.to.exists() else {}
    results |= {"steps": STEPS, "seeds": len(SEEDS), "parameters": parameters}
    results |= {"more_photographs": part} if options.photos else part
    if options.raw:
        results["raw"] = judge_raw(options.raw, pictures)
    write(results, options.to)


if __name__ == "__main__":
    run(main)
