"""Draw ``docs/reference/effects.png``: each effect of a physical profile by itself, amplified.

``python docs/draw_effects.py``. A picture is the noisy minus the clean frame of a synthetic scene with one effect on.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import unprocess_gen as ug
from unprocess_gen.config.schema import Config
from unprocess_gen.simulation.effects import PHYSICAL_EFFECTS as EFFECTS
from unprocess_gen.sources.scenes.synthetic import scene

FIGURE = Path(__file__).parent / "reference" / "effects.png"
SIDE, LABEL, COLUMNS = 160, 20, 5
PROFILE = ("noise=nikon_d850", "sensor=generic_14bit", "scene=long_exposure", "effects.all=off")
CHANGES = {
    "hot_pixels": {"hot_pixel_share": 2e-3},
    "dead_pixels": {"dead_pixel_share": 1e-3},
    "full_well": {"full_well_e": 4000.0},
}
"""Numbers raised so that a picture of 160 x 160 pixels shows the effect."""


def difference(effect: str) -> NDArray[np.float64]:
    """Return noisy minus clean with one effect on, DN; for the full well, the light that both frames lose."""
    config = ug.load_config([*PROFILE, f"effects.{effect}=on", "output.dtype=float32", "sensor.clip=none"])
    config = replace(config, noise=replace(config.noise, **CHANGES.get(effect, {})))
    srgb = np.ascontiguousarray(scene("dead_leaves-0")[:SIDE, :SIDE])
    pair = ug.make_pair(srgb, config)
    if effect == "full_well":
        return np.asarray(pair.clean, dtype=np.float64) - ug.make_pair(srgb, without(config)).clean
    return np.asarray(pair.noisy, dtype=np.float64) - pair.clean


def without(config: Config) -> Config:
    """Return a config without a full well."""
    return replace(
        config, noise=replace(config.noise, full_well_e=None), effects=replace(config.effects, full_well=None)
    )


def panel(effect: str) -> NDArray[np.uint8]:
    """Return a picture with its label; grey is no difference, black and white are three standard deviations."""
    shown = difference(effect)
    scale = 3 * shown.std() or 1.0
    grey = np.clip(np.rint(128 + 127 * shown / scale), 0, 255).astype(np.uint8)
    label = np.full((LABEL, SIDE), 255, dtype=np.uint8)
    cv2.putText(label, effect, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 0, 1, cv2.LINE_AA)
    return np.vstack([label, grey])


def draw() -> NDArray[np.uint8]:
    """Return the pictures of all effects, in rows."""
    panels = [panel(effect) for effect in EFFECTS if effect != "quantise"]
    blank = np.full_like(panels[0], 255)
    panels += [blank] * (-len(panels) % COLUMNS)
    return np.vstack([np.hstack(panels[at : at + COLUMNS]) for at in range(0, len(panels), COLUMNS)])


if __name__ == "__main__":
    cv2.imwrite(str(FIGURE), draw())
    print(f"{FIGURE}: {FIGURE.stat().st_size} bytes")
