"""Test classes to inherit, for an effect and for a camera body or noise profile.

A subclass names what it tests, and pytest runs the inherited tests. Statistical tolerances follow from the sample size.
Random numbers are those of the simulation, so a test always has the same result.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from unprocess_gen import api
from unprocess_gen.config.composition import load_config
from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.schema import PHYSICAL_NUMBERS, Config, NoiseConfig, replaced
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.arrays import FLOAT32, UINT16, Float, Srgb
from unprocess_gen.dataset.manifest import csv_lines, read_rows, write_manifest
from unprocess_gen.dataset.row import COLUMN_NAMES, plan_from_row
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.effects import BY_NAME, PHYSICAL_EFFECTS
from unprocess_gen.simulation.effects.prediction import FrameFacts
from unprocess_gen.simulation.facts import DarkPixels, Facts
from unprocess_gen.simulation.frames import Pair
from unprocess_gen.simulation.pair import make_pair, reference_pair
from unprocess_gen.simulation.plan import CameraPlan, IspPlan, Physics, Plan, SensorPlan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference.colour import IDENTITY

STANDARD_ERRORS = 6
"""Largest distance from an expected value, in standard errors: one false alarm in 5·10⁸ for a normal distribution."""

FLAT = self_test.GOLDEN_PLAN.replace(
    camera=CameraPlan(camera="identity", weights=(0.0,) * 4, rgb2cam=IDENTITY, red_gain=1.0, blue_gain=1.0,
    inverse_rgb_gain=1.0), isp=IspPlan("none", 1.0, "none"), sensor=SensorPlan("RGGB", 16, 4096, 65535, "none"),
    dtype=FLOAT32,
)  # fmt: skip
"""Plan whose light is the code divided by 65535, and whose frames are neither rounded nor clipped."""

PHYSICS = self_test.GOLDEN_PHYSICS.replace(
    column_temporal_std_dn=1.5, dsnu_std_e=0.5, gain_by_colour=(0.9, 1.0, 1.1), lens_shading=(-0.3, 0.0, 0.0),
    frame_size=(2**18, 2**18), full_well_e=1e5,
)  # fmt: skip
"""Numbers with which every effect is visible."""

ROUNDED = 0.01
"""Largest error of moments by float32 frames, DN and DN²."""

SUMMED = {"light_stream", "uniform", "bright", "noise", "rows", "fixed_columns", "columns", "planes_dn", "sites_dn"}
"""Slots whose contribution does not depend on that of others."""

RAMP = np.linspace(0, 65535, 24 * 150 * 3).astype(np.uint16).reshape(24, 150, 3)


def distinct(values: Float) -> Float:
    """Drop copies of equal columns and of equal rows, [H, W]."""
    values = values[:, :1] if (values == values[:, :1]).all() else values
    return values[:1] if (values == values[:1]).all() else values


def assert_equal(found: Pair, expected: Pair, part: Any = np.s_[:]) -> None:
    """Compare two pairs byte for byte, or the first with a part of the second."""
    for frame, of in ((found.noisy, expected.noisy), (found.clean, expected.clean)):
        assert frame.tobytes() == of[part].tobytes(), f"{int((frame != of[part]).sum())} of {frame.size} sites differ"


class EffectTests:
    """Test an effect of the sensor.

    Attributes
    ----------
    effect : str
        Name of the effect.
    numbers : mapping of str to value
        Fields of `Plan` with which the effect is visible; by default those of `PHYSICS`.
    needs : sequence of str
        Other effects without which the effect changes nothing.
    in_clean : bool
        Whether the clean frame has the effect too.
    physics : Physics or None
        Other numbers of the profile; None for noise with two numbers.
    levels : sequence of int
        Codes of the flat fields whose moments are tested, 0 to 65535.
    shape : tuple of int
        Height and width of the flat fields; offsets of rows need many rows.
    dark_pixels : DarkPixels or None
        Access to the dark frame of the plan.

    Examples
    --------
    >>> from unprocess_gen.testing import EffectTests
    >>> class TestDsnu(EffectTests):
    ...     effect = "dsnu"
    ...     numbers = {"dsnu_std_e": 40.0}
    >>> TestDsnu().test_flats_have_the_stated_moments()
    """

    effect: str
    numbers: Mapping[str, Any] = {}
    needs: Sequence[str] = ()
    in_clean: bool = False
    physics: Physics | None = PHYSICS
    levels: Sequence[int] = (0, 300, 5000, 40000)
    shape: tuple[int, int] = (1024, 1024)
    dark_pixels: DarkPixels | None = None

    def stated(self, frame: FrameFacts, signal_dn: float) -> tuple[float, Sequence[float]]:
        """State the moments of noisy minus clean; by default those that the effect predicts.

        Parameters
        ----------
        frame : FrameFacts
            Numbers and size of the flat field.
        signal_dn : float
            Signal above black, DN.

        Returns
        -------
        tuple of float and sequence of float
            Mean, DN, and variances of pixels, row means and column means, DN².
        """
        return 0.0, BY_NAME[self.effect].contribution(frame, signal_dn, math.inf).variances

    def plan(self, on: Sequence[str], **changes: Any) -> Plan:
        """Return the plan of a frame with the effects ``on``; ``changes`` are other fields."""
        effects = tuple(name for name in BY_NAME if name in on)
        return FLAT.replace(**{"physics": self.physics, "effects": effects, **self.numbers, **changes})

    def pair(self, plan: Plan, srgb: Srgb = RAMP, make: Callable[..., Pair] = make_pair, **options: Any) -> Pair:
        """Simulate a pair."""
        return make(srgb, plan, dark_pixels=self.dark_pixels, **options)

    def difference(self, code: int, on: Sequence[str], **changes: Any) -> Float:
        """Simulate a flat field, and return noisy minus clean without rounding, [H, W] DN."""
        pair = self.pair(self.plan([*on, *self.needs], **changes), np.full((*self.shape, 3), code, dtype=np.uint16))
        return (pair.noisy.astype(np.float64) - pair.clean) * FLAT.sensor.span_dn

    def others(self, only: set[str] | None = None) -> list[str]:
        """List the effects that fill no slot of this effect, and no slots except ``only``."""
        filled = {name: {*BY_NAME[name].slots(self.plan([]))} for name in PHYSICAL_EFFECTS if self.physics}
        own = BY_NAME[self.effect].slots(self.plan([])).keys()
        return [name for name, slots in filled.items() if not slots & own and (only is None or slots <= only)]

    def streams(self, effect: str = "") -> set[str]:
        """Find the numbers of the random streams in the slots that an effect fills."""
        return {*re.findall(r"stream\W+([1-9]\d*)", repr(BY_NAME[effect or self.effect].slots(self.plan([]))))}

    def cases(self) -> Iterator[Plan]:
        """Yield plans of the effect alone and with others, for frames of float32 and of uint16."""
        for others, (dtype, clip) in product((self.needs, self.others()), ((FLOAT32, "none"), (UINT16, "sensor"))):
            yield self.plan([self.effect, *others], dtype=dtype, sensor_clip=clip)

    def test_off_changes_nothing(self) -> None:
        """Numbers of the effect change bytes only if it is on; its switch turns it off."""
        off = self.plan(self.others())
        assert_equal(self.pair(off), self.pair(FLAT.replace(physics=self.physics, effects=off.noise.effects)))
        on = self.pair(self.plan([self.effect, *self.others()]))
        assert on.noisy.tobytes() != self.pair(off).noisy.tobytes(), f"{self.effect} changes nothing; give its numbers"
        if BY_NAME[self.effect].has_switch and self.physics:
            config = load_config(["body=sony_a7s2", "effects.all=on", f"effects.{self.effect}=off"])
            assert self.effect not in api.plan_image(np.zeros((2, 2, 3), np.uint8), config).noise.effects

    def test_stream_is_its_own(self) -> None:
        """The effect shares no random stream with other effects, and changes none of their slots and values."""
        if self.physics:
            own, others = BY_NAME[self.effect].slots(self.plan([])).keys(), self.others()
            frames = (slots_of(self.plan(on)) for on in (others, [self.effect, *others]))
            before, after = ({**slots._asdict(), **slots.patterns._asdict()} for slots in frames)
            changed = {name for name in before if before[name] != after[name]} - own - {"patterns"}
            assert not changed, f"{self.effect} changes the slots {changed} of other effects"
            shared = [name for name in {*PHYSICAL_EFFECTS} - {self.effect} if self.streams(name) & self.streams()]
            assert not shared, f"{self.effect} has the random stream of {shared}"
            if own <= SUMMED:
                on, code = self.others(only=SUMMED), self.levels[-1]
                moved = self.difference(code, [self.effect, *on]) - self.difference(code, on)
                np.testing.assert_allclose(moved, self.difference(code, [self.effect]), atol=0.05)

    def test_flats_have_the_stated_moments(self) -> None:
        """Check mean and variance of pixels, and of row and column means, at each level."""
        for code in self.levels:
            plan = self.plan([self.effect])
            facts = Facts(self.shape[1], self.shape[0], codes=65536, dark_code=0, bright_code=65535)
            frame = FrameFacts(plan.physics or PHYSICS, facts, float(plan.sensor.black_level_dn))
            mean, variances = self.stated(frame, code / 65535 * plan.sensor.span_dn)
            found = self.difference(code, [self.effect])
            means = found, found.mean(1, keepdims=True), found.mean(0, keepdims=True)
            for name, all_values, variance in zip(("pixels", "rows", "columns"), means, variances, strict=False):
                values = distinct(all_values)
                if name == "pixels" or values.size >= 100:  # the sample variance of a few lines says nothing
                    square, error = (values - mean) ** 2, STANDARD_ERRORS / math.sqrt(values.size)
                    off, excess = float(values.mean()) - mean, float(square.mean()) - variance
                    text = f"{self.effect}, {name} at code {code}: mean off by {off} DN, variance by {excess} DN²"
                    assert abs(off) <= error * math.sqrt(variance) + ROUNDED, text
                    assert abs(excess) <= error * float(square.std()) + ROUNDED, text

    def test_tiles_have_the_bytes_of_the_frame(self) -> None:
        """A tile or a single pixel equals its part of the frame, byte for byte."""
        for plan, (y, x, height, width) in product(self.cases(), ((0, 0, 1, 1), (5, 17, 9, 66), (3, 64, 20, 70))):
            part = np.s_[y : y + height, x : x + width]
            tile = self.pair(plan, np.ascontiguousarray(RAMP[part]), origin=(y, x))
            assert_equal(tile, self.pair(plan), part)

    def test_kernels_equal_the_reference(self) -> None:
        """The tiers ``exact`` and ``reference`` have the same frames and counts."""
        for plan in self.cases():
            exact, reference = self.pair(plan), self.pair(plan, make=reference_pair)
            assert_equal(exact, reference)
            assert exact.counts == reference.counts

    def test_clean_frame_has_shared_effects_only(self) -> None:
        """Clean frames have shared effects; with ``clean.includes_fixed_pattern``, fixed patterns too."""
        effect = BY_NAME[self.effect]
        for averaged in (False, True) if self.physics else (False,):
            changes = {"fixed_pattern_in_clean": True} if averaged else {}
            plans = (self.plan([*on, *self.needs], **changes) for on in ([self.effect], []))
            on, off = (self.pair(plan).clean for plan in plans)
            shared = self.in_clean or effect.in_both_frames or (averaged and effect.is_fixed)
            assert (on != off).any() == shared, f"{self.effect}, {averaged=}: expected in the clean frame: {shared}"

    def test_draws_are_new_unless_the_pattern_is_fixed(self) -> None:
        """Epochs, frames and images have independent draws; fixed patterns depend on the body alone."""
        fixed, code = BY_NAME[self.effect].is_fixed, self.levels[len(self.levels) // 2]
        first = distinct(self.difference(code, [self.effect]))
        for change in ({"epoch": 1}, {"frame": 1}, {"stream_key": 7}, *([{"body_key": 9}] if self.physics else [])):
            values = distinct(self.difference(code, [self.effect], **change))
            if np.ptp(first) > 1e-3:  # otherwise both frames have the effect
                correlation = float(np.corrcoef(first.ravel(), values.ravel())[0, 1])
                same = fixed == ("body_key" not in change) or (fixed and not self.streams())
                least, most = (0.9, 1.1) if same else (-1.1, STANDARD_ERRORS / math.sqrt(first.size))
                assert least <= correlation <= most, f"{self.effect}, {change}: correlation {correlation}"


LINEAR = ("camera=identity", "gains=unity", "isp=linear", "output.dtype=float32", "sensor.clip=none")
OFF = [f"effects.{name}=off" for name in PHYSICAL_EFFECTS if name not in ("shot", "dark_current", "read", "quantise")]
"""Overrides that turn off effects whose variance is in lines, in few pixels, or not linear in the signal."""


class BodyTests:
    """Test a camera body, or a noise profile.

    Attributes
    ----------
    body, noise : str
        Option to test; set one of the two.
    config_dir : path-like or None
        Folder of your own options, as with ``--config-dir``.
    overrides : sequence of str
        Settings that the option needs, such as ``noise.iso=1600``.

    Examples
    --------
    >>> from unprocess_gen.testing import BodyTests
    >>> class TestCamera(BodyTests):
    ...     body = "sony_a7s2"
    >>> TestCamera().test_levels_are_those_of_the_sensor()
    """

    body: str = ""
    noise: str = ""
    config_dir: str | os.PathLike[str] | None = None
    overrides: Sequence[str] = ()

    def config(self, *overrides: str) -> Config:
        """Compose the config of the option, and of further overrides."""
        chosen = f"body={self.body}" if self.body else f"noise={self.noise}"
        return load_config([chosen, *self.overrides, *overrides], self.config_dir)

    def at_each_iso(self, *overrides: str) -> Iterator[Config]:
        """Yield the config at the ends and the middle of each branch, and at every ISO of its tables."""
        config = self.config(*overrides)
        for branch in config.noise.branches:
            tables = (value for value in vars(branch).values() if isinstance(value, (list, tuple)))
            isos = {iso for table in tables if table[0] == "by_iso" for iso in table[1::2]}
            isos = {iso for iso in isos if branch.iso[0] <= iso <= branch.iso[1]}
            for iso in sorted({*isos, *branch.iso, math.sqrt(branch.iso[0] * branch.iso[1])}):
                here = replaced(config, {"noise.iso": float(iso)})
                validate_config(here)
                yield here
        if not config.noise.branches:
            yield config

    def flat(self, config: Config, code: int) -> api.RawPair:
        """Simulate the pair of a flat field of an 8-bit code."""
        return api.make_pair(np.full((512, 512, 3), code, dtype=np.uint8), config)

    def test_every_scene_can_be_planned(self) -> None:
        """All scenes compose and validate with the option, at its first ISO."""
        iso = next(self.at_each_iso()).noise.iso
        for scene in group_options("scene"):
            config = self.config(f"scene={scene}", *([] if iso is None else [f"noise.iso={iso}"]))
            assert api.plan_image(RAMP, config).scene.scene == scene

    def test_every_number_has_a_source(self) -> None:
        """Each number of a physical profile has a statement of provenance, or is named in ``assumed``."""
        noise, default = self.config().noise, vars(NoiseConfig())
        numbers = [vars(one).items() for one in noise.branches] + [[(n, vars(noise)[n]) for n in PHYSICAL_NUMBERS]]
        given = {name for one in numbers for name, value in one if value not in (None, 0.0, default.get(name, 0.0))}
        sourced = {*noise.assumed, *(name for one in noise.provenance for name in one.numbers), "iso", "read_law"}
        assert given <= sourced or not noise.branches, f"numbers without a source: {sorted(given - sourced)}"

    def test_variance_is_linear_in_the_signal(self) -> None:
        """The variance of single pixels is a·u + b at every ISO and level, with positive a and b of the row."""
        for config, code in product(self.at_each_iso(*LINEAR, *OFF), (0, 8, 60, 150)):
            pair, span_dn = self.flat(config, code), config.sensor.white_level_dn - config.sensor.black_level_dn
            noise_dn, signal_dn = (pair.noisy.astype(float) - pair.clean) * span_dn, float(pair.clean[0, 0]) * span_dn
            stated = pair.row["a_dn"] * signal_dn + pair.row["dark_variance_dn2"]
            square = (noise_dn - noise_dn.mean()) ** 2
            text = f"ISO {config.noise.iso}, code {code}: variance {square.mean()} DN², stated {stated}"
            assert pair.row["a_dn"] > 0, text
            limit = STANDARD_ERRORS * float(square.std()) / math.sqrt(square.size) + 1e-3
            assert abs(float(square.mean()) - max(0.0, stated)) <= limit, text

    def test_levels_are_those_of_the_sensor(self) -> None:
        """Clean frames reach from black to white, and noisy frames stay within the bits; a body's levels agree."""
        config = self.config(*LINEAR[:3], "effects.full_well=off")
        sensor, (dark, bright) = config.sensor, (self.flat(config, code) for code in (0, 255))
        assert (dark.clean == sensor.black_level_dn).all() and (bright.clean == sensor.white_level_dn).all()
        assert max(dark.noisy.max(), bright.noisy.max()) < 2**sensor.bits
        for key in ("bits", "black_level_dn", "white_level_dn") if self.body else ():
            assert getattr(sensor, key) == getattr(config.noise, key), f"{key} of sensor and noise differ"

    def test_row_survives_the_manifest(self, tmp_path: Path) -> None:
        """A row that is written and read back has the plan of its pair."""
        for number, config in enumerate(self.at_each_iso()):
            row, path = api.make_pair(RAMP, config).row, tmp_path / f"{number}.csv"
            write_manifest(path, COLUMN_NAMES, [csv_lines([dict.fromkeys(COLUMN_NAMES) | dict(row)], COLUMN_NAMES)])
            assert [*map(plan_from_row, read_rows(path))] == [api.plan_image(RAMP, config)]
