"""Every effect, body and noise profile of the package satisfies the laws that `unprocess_gen.testing` states."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from helpers.cases import slow_except

from unprocess_gen.config.option_files import group_options
from unprocess_gen.simulation.effects import EFFECTS, REPLACED
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.plan import DarkFramePlan
from unprocess_gen.testing import BodyTests, EffectTests

LINES = 2**17
"""Lines of a flat field whose offsets are tested."""

PREDICTED: dict[str, dict[str, Any]] = {
    "shot": {},
    "dark_current": {"dark_e": 7.0},
    "read": {"read_std_dn": 30.0},
    "row": {"row_std_dn": 30.0},
    "column": {"column_std_dn": 30.0},
    "column_temporal": {"column_temporal_std_dn": 30.0},
    "dsnu": {"dsnu_std_e": 40.0},
}
"""Numbers of effects whose prediction is their exact variance."""
SHAPES = {"row": (LINES, 2), "column": (2, LINES), "column_temporal": (2, LINES)}


class TestPredictedEffects(EffectTests):
    @pytest.fixture(autouse=True, params=PREDICTED)
    def _effect(self, request: pytest.FixtureRequest) -> None:
        self.effect, self.numbers = request.param, PREDICTED[request.param]
        self.shape = SHAPES.get(self.effect, (1024, 1024))


class OfPixels(EffectTests):
    """Effect of which independent pixels have a mean and a variance."""

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        raise NotImplementedError

    def stated(self, frame: FrameFacts, signal_dn: float) -> tuple[float, tuple[float, ...]]:
        mean, variance = self.moments(frame.physics.dn_per_e, signal_dn)
        return mean, (variance, variance / self.shape[1], variance / self.shape[0])


class TestHeteroscedastic(OfPixels):
    effect, physics, numbers = "heteroscedastic", None, {"a_dn": 3.0, "b_dn2": 50.0}

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        return 0.0, 3.0 * signal_dn + 50.0


class TestPrnu(OfPixels):
    effect, numbers = "prnu", {"prnu_std": 0.02}

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        return 0.0, (0.02 * signal_dn) ** 2


class TestHotPixels(OfPixels):
    effect, numbers = "hot_pixels", {"hot_pixel_share": 0.02, "hot_pixel_e": 200.0}

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        mean = 0.02 * k * 200
        return mean, 0.02 * k**2 * (200 + 2 * 200**2) - mean**2


class TestDeadPixels(OfPixels):
    effect, numbers = "dead_pixels", {"dead_pixel_share": 0.02, "dead_pixel_level": 0.5}

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        depth = signal_dn + 2048
        return -0.02 * depth, 0.02 * 0.98 * depth**2


class TestGainByColour(OfPixels):
    effect, numbers, needs = "gain_by_colour", {"gain_by_colour": (0.5, 1.0, 2.0)}, ("shot",)

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        return 0.0, k * signal_dn * (0.5 + 1 + 1 + 2) / 4


class TestFullWell(OfPixels):
    effect, numbers, needs, in_clean = "full_well", {"full_well_e": 2000.0}, ("shot",), True

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        """Light is limited first; of the counts, those below the well remain."""
        if signal_dn < 2000 * k:
            return 0.0, k * signal_dn
        return -k * math.sqrt(2000 / (2 * math.pi)), k**2 * 2000 * (1 / 2 - 1 / (2 * math.pi))


class TestLensShading(EffectTests):
    effect, numbers = "lens_shading", {"lens_shading": (-0.3, 0.1, -0.2), "frame_size": (1024, 1024)}


class TestBlackError(EffectTests):
    effect, numbers = "black_error", {"black_error_dn": (1.0, -2.0, 3.0, -4.0)}

    def stated(self, frame: FrameFacts, signal_dn: float) -> tuple[float, tuple[float, ...]]:
        return -0.5, (7.25, 0.0, 6.25)


class Gray:
    """Dark frames whose pixels are 32 DN."""

    def frame(self, sha256: str) -> np.ndarray:
        return np.full((64, 64), 32, np.uint16)


class TestDarkFrame(OfPixels):
    """Only its dither is random: uniform in a DN of the dark frame."""

    effect, dark_pixels, numbers = "dark_frame", Gray(), {"dark": DarkFramePlan("0" * 64, (0, 0), 31.5, 2.0)}

    def others(self, only: set[str] | None = None) -> list[str]:
        return [name for name in super().others(only) if name not in REPLACED]

    def moments(self, k: float, signal_dn: float) -> tuple[float, float]:
        return 2 * 0.5, 2.0**2 / 12


def test_every_effect_has_its_laws() -> None:
    classes = [*EffectTests.__subclasses__(), *OfPixels.__subclasses__()]
    tested = {*PREDICTED, *(one.effect for one in classes if hasattr(one, "effect"))}
    assert tested == {effect.name for effect in EFFECTS} - {"quantise"}


NEEDS = {"imx385": ("noise.iso=1600",), "heteroscedastic": ("noise.a=2", "noise.b=9")}
PROFILES = [name for name in group_options("noise") if name not in ("none", "imx385_rvdd", *group_options("body"))]
"""Profiles of two numbers; that of RVDD is a list of two levels, of which `imx385_iso3200_rvdd` is the first."""


class TestBodies(BodyTests):
    @pytest.fixture(autouse=True, params=slow_except(("imx385",), group_options("body")))
    def _body(self, request: pytest.FixtureRequest) -> None:
        self.body, self.overrides = request.param, NEEDS.get(request.param, ())


class TestProfiles(BodyTests):
    @pytest.fixture(autouse=True, params=slow_except(("imx385_iso3200_rvdd",), PROFILES))
    def _noise(self, request: pytest.FixtureRequest) -> None:
        self.noise, self.overrides = request.param, NEEDS.get(request.param, ())
