"""Draw the pictures of the atlas of effects, ``docs/reference/effects/NAME.jpg``: ``python docs/draw_effects.py``.

`effect_page` says what each picture shows; names after the command select effects.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from effect_page import OTHER_PROFILE, PICTURES, PROFILE, SENSOR, Picture
from numpy.typing import NDArray

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.core.arrays import Float
from unprocess_gen.dataset.reader import mosaic_dn
from unprocess_gen.sources import synthetic

FOLDER = Path(__file__).parent / "reference" / "effects"
SIDE, GAP, JPEG_QUALITY = 128, 8, 75


def config_of(picture: Picture, switches: dict[str, str | None], *overrides: str) -> Config:
    """Return the settings of a picture, with the numbers that it needs, and switches of effects."""
    light = [f"scene.exposure_ratio={picture.ratio}"] if picture.ratio else []
    config = ug.load_config([f"noise={PROFILE}", f"sensor={SENSOR}", f"scene={picture.scene}", *light, *overrides])
    own = {name: value for name, value in picture.numbers.items() if hasattr(config.noise, name)}
    branch = {name: value for name, value in picture.numbers.items() if name not in own}
    branches = [replace(one, **branch) for one in config.noise.branches]
    noise, effects = replace(config.noise, **own, branches=branches), replace(config.effects, **switches)
    return replace(config, noise=noise, effects=effects)


def frames_dn(config: Config) -> tuple[Float, Float]:
    """Return the clean and the noisy frame of a part of a synthetic picture."""
    pair = ug.make_pair(np.ascontiguousarray(synthetic.picture("dead_leaves-0")[:SIDE, :SIDE]), config)
    clean, noisy = (mosaic_dn(frame, pair.row).astype(np.float64) for frame in (pair.clean, pair.noisy))
    return clean, noisy


def alone(effect: str) -> Float:
    """Return the frame with one effect minus the frame without, DN."""
    picture, exact = PICTURES[effect], ("output.dtype=float32", "sensor.clip=none")
    if effect == "heteroscedastic":
        clean, noisy = frames_dn(ug.load_config([OTHER_PROFILE, f"sensor={SENSOR}", *exact]))
        return noisy - clean
    rounded = config_of(picture, {"all": "off"})
    on = config_of(picture, {"all": "off", **dict.fromkeys((effect, *picture.also_on), "on")}, *exact)
    without = config_of(picture, {"all": "off"}, *exact)
    return frames_dn(rounded if effect == "quantise" else on)[1] - frames_dn(without)[1]


def in_scene(effect: str) -> list[Float]:
    """Return the noise of the scene with all effects that it calls for, and without one."""
    pairs = [frames_dn(config_of(PICTURES[effect], {effect: switch})) for switch in ("on", "off")]
    return [noisy - clean for clean, noisy in pairs]


def panel(values: Float, limit_dn: float) -> NDArray[np.uint8]:
    """Return grey for 0, black and white for the limit."""
    return np.clip(np.rint(128 + 127 * values / limit_dn), 0, 255).astype(np.uint8)


def draw(effect: str) -> NDArray[np.uint8]:
    """Return the panels of an effect, side by side."""
    panels = [panel(alone(effect), PICTURES[effect].limit_dn)]
    if PICTURES[effect].in_scene:
        both = in_scene(effect)
        panels += [panel(noise, 3 * both[0].std()) for noise in both]
    gap = np.full((SIDE, GAP), 255, np.uint8)
    return np.hstack([part for one in panels for part in (one, gap)][:-1])


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PICTURES:
        drawn = alone(name)
        print(f"{name}: mean {drawn.mean():.3g}, std {drawn.std():.3g}, at most {np.abs(drawn).max():.3g} DN")
        cv2.imwrite(str(FOLDER / f"{name}.jpg"), draw(name), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
