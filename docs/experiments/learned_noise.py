"""Experiment 3: compare simulated and learned noise with the real noise of phones, on the same patches.

    python docs/experiments/learned_noise.py PATCHES [--to RESULTS.json]

PATCHES has folders LIGHT/ISO/PHONE/KIND, as `sample_imgs_per_ISO_lighting_camera` of synt_noise_GANs has; KIND is
samples_noisy, samples_gts, GAN, samples_noisyNF, samples_gtsNF or samples_noiseflowNF. Or it is a folder of SIDD, which
has no learned noise. Protocol: protocol.md.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import arguments, colour, divergence, interval, write
from real_pairs import real_pairs
from scipy.optimize import nnls

import unprocess_gen as ug
from unprocess_gen.simulation.reference.colour import CAMERAS
from unprocess_gen.simulation.reference.light import camera_gains, planckian_xy

CAMERA, CURVES = "nexus_6p", ("smoothstep_gamma22", "gamma22", "srgb")
BAND, WIDTH, GOAL = 16, 4, 0.02
FIRST = (20.0, 100.0)
"""Numbers from which the fit starts: a (DN) and b (DN²) at 12 bits."""
STEPS = 3
LEARNED = {"GAN": ("GAN", "samples_gts"), "noise_flow": ("samples_noiseflowNF", "samples_gtsNF")}
RATIOS = ("luma_std", "chroma_to_luma")
"""Statistics of colour that are divided by the real ones; of correlations the difference is taken."""
NAME = re.compile(r"\d{4}_(?P<scene>\d{3})_(?P<phone>\w+?)_(?P<iso>\d{5})_(?P<speed>\d{5})_(?P<kelvin>\d{4})_[NLH]")
"""Names of SIDD: scene, phone, ISO, reciprocal of the exposure time in seconds, colour temperature."""


@dataclass(frozen=True, eq=False)
class Patch:
    """Hold the pictures of a patch by kind, and what its name states."""

    number: int
    scene: str
    phone: str
    iso: int
    speed: int
    kelvin: int
    kinds: dict[str, Any]

    @property
    def group(self) -> str:
        """Scene, phone and ISO."""
        return f"{self.scene}_{self.phone}_{self.iso}"

    @property
    def clean(self) -> Any:
        """The real clean picture."""
        return self.kinds["samples_gts"]

    @property
    def real(self) -> Any:
        """The real noise."""
        return self.noise("samples_noisy", "samples_gts")

    def noise(self, noisy: str, clean: str) -> Any:
        """Return the difference of two pictures of the patch."""
        return self.kinds[noisy].astype(int) - self.kinds[clean]


@dataclass(frozen=True)
class Form:
    """State which other patches a judged patch is fitted on, and what the light and the exposure decide."""

    fits: Callable[[Patch, Patch], bool]
    strength: Callable[[Patch], float]
    by_light: bool = True


def same_phone(patch: Patch, other: Patch) -> bool:
    """Return whether two patches have the same phone and ISO."""
    return other is not patch and (other.phone, other.iso) == (patch.phone, patch.iso)


FORMS = {
    "camera_noise": Form(same_phone, lambda patch: 1.0),
    "by_exposure": Form(same_phone, lambda patch: patch.speed / 1000),
    "fixed_gains": Form(same_phone, lambda patch: 1.0, by_light=False),
    "other_phone": Form(lambda patch, other: other.phone != patch.phone, lambda patch: patch.iso / 1000),
}
"""a is proportional to the strength of a patch, b to its square."""


def patches_of(folder: Path) -> list[Patch]:
    """Read all patches below a folder that have the real pair; of larger pictures, the centre."""
    found = []
    for noisy in sorted(folder.rglob("samples_noisy/*.png")):
        place = noisy.parents[1]
        files = {kind.name: kind / noisy.name for kind in place.iterdir() if kind.is_dir()}
        files["GAN"] = place / "GAN" / f"{noisy.stem}_fake_B.png"
        found.append((noisy.stem, {kind: read(file) for kind, file in files.items() if file.exists()}))
    found += [(pair.name, {"samples_noisy": pair.noisy, "samples_gts": pair.clean}) for pair in real_pairs(folder)]
    return [patch for number, (name, kinds) in enumerate(found) if (patch := patch_of(number, name, kinds))]


def patch_of(number: int, name: str, kinds: dict[str, Any]) -> Patch | None:
    """Return a patch; None if a channel has no noise, as where it is saturated."""
    facts = NAME.search(name)
    if facts is None or "samples_gts" not in kinds:
        raise SystemExit(
            f"{name}: no real pair of SIDD; expected a name as 0001_001_S6_00100_00060_3200_L, and a clean one"
        )
    iso, speed, kelvin = (int(facts[key]) for key in ("iso", "speed", "kelvin"))
    patch = Patch(number, facts["scene"], facts["phone"], iso, speed, kelvin, kinds)
    if patch.real.std(axis=(0, 1)).all():
        return patch
    print(f"{name}: a channel without noise; not judged")
    return None


def read(file: Path) -> Any:
    """Read a picture as R, G, B."""
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if pixels is None:
        raise SystemExit(f"{file}: unreadable; expected a PNG; unpack the patches again")
    return np.ascontiguousarray(pixels[..., ::-1])


def by_level(noise: Any, clean: Any) -> tuple[Any, Any]:
    """Return variance and number of the pixels of each channel in each band of levels, [48]; rare levels have none."""
    cells = (clean // BAND + 256 // BAND * np.arange(3)).ravel()
    values = noise.ravel().astype(float)
    counts, sums, squares = (np.bincount(cells, weights, 768 // BAND) for weights in (None, values, values * values))
    counts[counts <= 50] = 0
    number = np.maximum(counts, 1)
    return np.where(counts > 0, squares / number - (sums / number) ** 2, 0), counts


@functools.cache
def settings(curve: str, kelvin: int | None) -> ug.Config:
    """Return the settings of a curve and a light."""
    overrides = ["noise=heteroscedastic", "noise.units=dn", "noise.black=subtracted", "noise.bits=12"]
    overrides += [f"noise.a={FIRST[0]}", f"noise.b={FIRST[1]}", "noise.black_level_dn=240", "noise.white_level_dn=4095"]
    overrides += [f"isp={curve}", f"camera={CAMERA}", "gains=fixed"]
    if kelvin is not None:
        red, blue = camera_gains(CAMERAS[CAMERA], planckian_xy(kelvin))
        overrides += [f"gains.red={red}", f"gains.blue={blue}"]
    return ug.load_config(overrides)


def camera_noise(curve: str, kelvin: int | None, a: float, b: float) -> ug.CameraNoise:
    """Return the camera noise of a curve, a light and two numbers."""
    config = settings(curve, kelvin)
    return ug.CameraNoise(replace(config, noise=replace(config.noise, a=a, b=b)), demosaic="malvar")


def simulate(form: Form, fit: tuple[str, float, float], patch: Patch, stage: int) -> Any:
    """Simulate the noise of a fit on the clean picture of a patch; each stage has other random values."""
    curve, a, b = fit
    strength = form.strength(patch)
    model = camera_noise(curve, patch.kelvin if form.by_light else None, a * strength, b * strength**2)
    clean, noisy = model(patch.clean, index=1000 * stage + patch.number)
    return noisy.astype(int) - clean


@functools.cache
def equations(form: Form, fit: tuple[str, float, float], patch: Patch) -> tuple[Any, Any]:
    """Return the equations for a and b, linear about a fit: their effect on the variance by level, and what it lacks.

    Both are divided by the real variance.
    """
    curve, *numbers = fit
    real, counts = by_level(patch.real, patch.clean)
    weights = np.sqrt(counts) / np.maximum(real, 1)
    steps = 0.1 * np.array(numbers) + 0.01 * np.array(FIRST)
    points = [numbers, *(np.array(numbers) + np.diag(steps))]
    base, *moved = (by_level(simulate(form, (curve, *point), patch, 0), patch.clean)[0] for point in points)
    slopes = np.stack([(one - base) / step for one, step in zip(moved, steps, strict=True)], axis=1)
    return slopes * weights[:, None], (real - base + slopes @ numbers) * weights


def fitted(form: Form, curve: str, patches: Sequence[Patch]) -> tuple[str, float, float]:
    """Fit a and b to the variance by level: least squares relative to it, then one step of scale."""
    a, b = FIRST
    for _ in range(STEPS):
        rows, targets = zip(*(equations(form, (curve, a, b), patch) for patch in patches), strict=True)
        a, b = (max(float(number), 1e-3) for number in nnls(np.concatenate(rows), np.concatenate(targets))[0])
    scale = float(np.median([p.real.var() / simulate(form, (curve, a, b), p, 1).var() for p in patches]))
    return curve, a * scale, b * scale


@functools.cache
def chosen(form: Form, patches: tuple[Patch, ...]) -> tuple[str, float, float]:
    """Return curve and numbers with the smallest mean divergence on the patches that are fitted."""
    fits = [fitted(form, curve, patches) for curve in CURVES]
    return min(fits, key=lambda fit: np.mean([divergence(p.real, simulate(form, fit, p, 2), WIDTH) for p in patches]))


def white(noise: Any, clean: Any, seed: int) -> Any:
    """Draw white Gaussian noise with the standard deviation of other noise at each level."""
    std = np.sqrt(by_level(noise, clean)[0])[clean // BAND + 256 // BAND * np.arange(3)]
    drawn = np.random.default_rng(seed).normal(0, 1, clean.shape) * std
    return np.clip(np.rint(clean + drawn), 0, 255).astype(int) - clean


def judge(patch: Patch, patches: Sequence[Patch]) -> dict[str, Any]:
    """Compare all models with the real noise of a patch."""
    found: dict[str, Any] = {"group": patch.group}
    for name, form in FORMS.items():
        others = tuple(other for other in patches if form.fits(patch, other))
        if others:
            fit = chosen(form, others)
            noise = simulate(form, fit, patch, 3)
            levels = level_error(noise, patch)
            found[name] = {"fit": fit, "fitted_patches": len(others), **levels, **compared(noise, patch.real)}
            if name == "camera_noise":
                found["camera_fit"] = by_camera_fit(patch, others)
    found["white_oracle"] = compared(white(patch.real, patch.clean, patch.number), patch.real)
    for name, (noisy, clean) in LEARNED.items():
        if noisy in patch.kinds and clean in patch.kinds:
            real = patch.real if name == "GAN" else patch.noise("samples_noisyNF", clean)
            found[name] = compared(patch.noise(noisy, clean), real)
    return found


def by_camera_fit(patch: Patch, others: Sequence[Patch]) -> dict[str, Any]:
    """Compare the noise of `CameraNoise.fit`, with its chroma and luma reduction, on the same other patches."""
    pairs = [(other.kinds["samples_noisy"], other.clean) for other in others]
    fit = ug.CameraNoise.fit(pairs, [f"camera={CAMERA}", "gains=fixed"])
    clean, noisy = fit.noise()(patch.clean, index=3000 + patch.number)
    noise = noisy.astype(int) - clean
    numbers = {name: number.value for name, number in fit.numbers.items()}
    return {"fit": [*fit.choice, numbers], **level_error(noise, patch), **compared(noise, patch.real)}


def compared(noise: Any, real: Any) -> dict[str, Any]:
    """Compare noise with real noise: divergence, strength, and both statistics of colour."""
    both = zip(colour(noise).items(), colour(real).values(), strict=True)
    pairs = {name: [value, truth] for (name, value), truth in both}
    return {"divergence": divergence(real, noise, WIDTH), "std_to_real": float(noise.std() / real.std()), **pairs}


def level_error(noise: Any, patch: Patch) -> dict[str, float]:
    """Return the median error of the variance by level."""
    (model, counts), (truth, _) = by_level(noise, patch.clean), by_level(patch.real, patch.clean)
    filled = (counts > 500) & (truth > 0)
    return {"variance_by_level_error": float(np.median(np.abs(model[filled] / truth[filled] - 1)))}


def summary(name: str, judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return medians and intervals of a model over the groups of the patches."""
    patches = [patch for patch in judged if name in patch]
    groups = np.array([patch["group"] for patch in patches])

    def over_groups(values: Any) -> list[float]:
        return interval([np.median(values[groups == group]) for group in sorted(set(groups))])

    found: dict[str, Any] = {"patches": len(patches), "groups": len(set(groups))}
    found["above_goal"] = sum(patch[name]["divergence"] > GOAL for patch in patches)
    for key in sorted(patches[0][name].keys() - {"fit", "fitted_patches"}):
        values = np.array([patch[name][key] for patch in patches])
        if values.ndim == 1:
            found[key] = over_groups(values)
        else:
            model, real = values.T
            ratio = {"to_real": over_groups(model / real)}
            found[key] = ratio if key in RATIOS else {"difference": over_groups(np.abs(model - real))}
            found[key] |= {"model": over_groups(model)[0], "real": over_groups(real)[0]}
    return found


def main() -> None:
    """Run the experiment."""
    options = arguments(__doc__, "learned_noise", "folder of SIDD patches")
    patches = patches_of(options.data)
    judged = [judge(patch, patches) for patch in patches]
    if not any("camera_noise" in patch for patch in judged):
        raise SystemExit(f"{options.data}: no two patches of one phone and ISO; expected LIGHT/ISO/PHONE/samples_noisy")
    with_partner = [patch for patch in judged if "camera_noise" in patch]
    models = (*FORMS, "camera_fit", *LEARNED, "white_oracle")
    write(
        {
            "patches": len(patches),
            "judged": len(with_partner),
            "models": {
                name: summary(name, judged if name == "other_phone" else with_partner)
                for name in models
                if any(name in patch for patch in with_partner)
            },
            "by_patch": judged,
        },
        options.to,
    )


if __name__ == "__main__":
    main()
