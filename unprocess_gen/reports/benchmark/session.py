"""Hold the photographs, configs and budgets of one benchmark, and the pairs that several measurements share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from unprocess_gen.config.accuracy import METHODS, Budget, Method, choose_methods
from unprocess_gen.config.interpretation import accuracy_budget, is_physical
from unprocess_gen.config.schema import (
    AccuracyConfig,
    CleanConfig,
    Config,
    EffectsConfig,
    NoiseConfig,
    SceneConfig,
    SensorConfig,
)
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import MOSAIC, Frame, Pair, Plan, Srgb
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.noise import EFFECTS
from unprocess_gen.simulation.reference.poisson import gaussian_from
from unprocess_gen.sources.loader import list_photographs, load_source

REFERENCE, EXACT = "reference", "exact"
"""The tier that defines results, and the tier in which the error of a single method is measured."""

TWO_PARAMETER, PHYSICAL, GIVEN = "two_parameter", "physical", "given"
"""Names of the configs of a session: 14 bits with two-parameter noise, 14 bits with physical noise, the user's own."""

TWO_PARAMETER_RUN = "two_parameter_noise"
"""Name of the setting of complete runs that has the user's sensor with two-parameter noise."""

FALLBACK_ISO = 1600
"""ISO of the physical profile if it is not calibrated at the ISO of the scene."""


@dataclass(frozen=True, slots=True)
class BenchmarkProfiles:
    """Hold the options with which a user's config is compared.

    Attributes
    ----------
    tiers : dict of str to AccuracyConfig
        Every accuracy tier by name.
    two_parameter_noise, physical_noise : NoiseConfig
        A noise profile of each kind; replaces the user's profile of the other kind.
    sensor : SensorConfig
        A 14-bit sensor.
    scenes : dict of str to SceneConfig
        Scenes in which complete runs with physical noise are measured.
    """

    tiers: dict[str, AccuracyConfig]
    two_parameter_noise: NoiseConfig
    physical_noise: NoiseConfig
    sensor: SensorConfig
    scenes: dict[str, SceneConfig]


@dataclass(frozen=True, slots=True)
class SampleSizes:
    """Hold how much is measured; image sizes are the largest height and width.

    Attributes
    ----------
    photographs, rounds : int
        Number of photographs read, and of rounds of time measurements.
    sampled : (int, int)
        Size of the subsampled photograph used for errors.
    readable, compiled : (int, int)
        Size of the crop for times of NumPy methods and of kernels.
    flat : int
        Side of a flat field.
    positions : int
        Number of random words in each segment of the table of normal quantiles.
    run_files, run_pixels : int
        Largest number of photographs of a complete run, and of their pixels if it has more than one.
    """

    photographs: int = 8
    rounds: int = 7
    sampled: tuple[int, int] = (384, 512)
    readable: tuple[int, int] = (512, 768)
    compiled: tuple[int, int] = (1024, 1536)
    flat: int = 512
    positions: int = 64
    run_files: int = 16
    run_pixels: int = 20_000_000


@dataclass(frozen=True, slots=True)
class BenchmarkImage:
    """A photograph: its subsampled pixels for errors, and two crops of its centre for times."""

    name: str
    identity: tuple[str, int]
    sampled: Srgb
    readable: Srgb
    compiled: Srgb


# ------------------------------------------------------------------------------------------------------------ plans


def _with_shot(plan: Plan) -> Plan:
    return replace(plan, effects=tuple(effect for effect in EFFECTS if effect in plan.effects or effect == "shot"))


def _without_shot(plan: Plan) -> Plan:
    return replace(plan, effects=tuple(effect for effect in plan.effects if effect != "shot"))


def _without_effects(plan: Plan) -> Plan:
    return replace(plan, effects=("quantise",))


PLAN_EDITS: dict[str, Callable[[Plan], Plan]] = {
    "unchanged": lambda plan: plan,
    "with_shot": _with_shot,
    "without_shot": _without_shot,
    "without_effects": _without_effects,
}
"""Changes to the effects of a plan."""


@dataclass
class BenchmarkSession:
    """Hold the inputs of all measurements, and cache the pairs made for errors.

    Attributes
    ----------
    configs : dict of str to Config
        The configs `TWO_PARAMETER`, `PHYSICAL` and `GIVEN`.
    tiers : dict of str to AccuracyConfig
        Accuracy tiers by name.
    images : tuple of BenchmarkImage
        The photographs.
    sizes : SampleSizes
        How much is measured.
    run_configs : dict of str to Config
        The settings of complete runs; `GIVEN` is the first.
    """

    configs: dict[str, Config]
    tiers: dict[str, AccuracyConfig]
    images: tuple[BenchmarkImage, ...]
    sizes: SampleSizes
    run_configs: dict[str, Config] = field(default_factory=dict)
    _pairs: dict[object, list[tuple[Pair, Plan]]] = field(default_factory=dict)
    _flat_frames: dict[object, list[Frame]] = field(default_factory=dict)

    @property
    def all_configs(self) -> dict[str, Config]:
        """Every config by name; that of complete runs with the given settings is replaced by its mosaics."""
        return self.run_configs | self.configs

    def plan(
        self, config_name: str, accuracy: AccuracyConfig, image: BenchmarkImage, srgb: Srgb, edit: str = "unchanged"
    ) -> Plan:
        """Return the plan of some pixels of an image under a budget; ``edit`` is a key of `PLAN_EDITS`."""
        config = replace(self.all_configs[config_name], accuracy=accuracy)
        return PLAN_EDITS[edit](plan_image(config, *image.identity, facts_for(config, srgb)))

    def sampled_pairs(
        self, config_name: str, accuracy: AccuracyConfig, edit: str = "unchanged"
    ) -> list[tuple[Pair, Plan]]:
        """Return pairs and plans of all subsampled images under a budget."""
        key = (config_name, edit, _numbers(accuracy))
        if key not in self._pairs:
            plans = [self.plan(config_name, accuracy, image, image.sampled, edit) for image in self.images]
            pairs = (make_pair(image.sampled, plan) for image, plan in zip(self.images, plans, strict=True))
            self._pairs[key] = list(zip(pairs, plans, strict=True))
        return self._pairs[key]

    def flat_frames(self, accuracy: AccuracyConfig) -> list[Frame]:
        """Return noisy frames of flat fields under a budget."""
        key = _numbers(accuracy)
        if key not in self._flat_frames:
            self._flat_frames[key] = [make_pair(white, plan).noisy for white, plan in self.flat_plans(accuracy)]
        return self._flat_frames[key]

    def clear(self) -> None:
        """Forget the pairs and frames made so far."""
        self._pairs.clear()
        self._flat_frames.clear()

    def flat_plans(self, accuracy: AccuracyConfig) -> Iterator[tuple[Srgb, Plan]]:
        """Yield white images, and plans that expose them to `flat_rates` electrons with Gaussian read noise."""
        white = np.full((self.sizes.flat, self.sizes.flat, 3), 255, dtype=np.uint8)
        plan = self.plan(PHYSICAL, accuracy, self.images[0], white)
        assert plan.physics is not None
        read_std_e = plan.physics.read_std_dn / plan.physics.dn_per_e
        rates_e = flat_rates(read_std_e, max(tier.law_distance for tier in self.tiers.values()))
        span_dn = plan.white_level_dn - plan.black_level_dn
        gain = min(FLAT_DN_PER_E, span_dn / (2 * max(rates_e)))
        physics = replace(
            plan.physics,
            dn_per_e=gain,
            read_std_dn=gain * read_std_e,
            read_law="gaussian",
            fixed_pattern_in_clean=False,
        )
        flat = replace(
            plan,
            rgb2cam=colour.IDENTITY,
            red_gain=1.0,
            blue_gain=1.0,
            inverse_rgb_gain=1.0,
            physics=physics,
            a_dn=gain,
            b_dn2=physics.read_std_dn**2,
            effects=("shot", "read", "quantise"),
        )
        for rate_e in rates_e:
            yield white, replace(flat, exposure_ratio=span_dn / (gain * rate_e))

    def corner(self, image: BenchmarkImage | None = None) -> BenchmarkImage:
        """Return a small corner of an image, which compiles the kernels quickly."""
        image = image or self.images[0]
        corner = _copy(image.sampled[:16, :16])
        return replace(image, sampled=corner, readable=corner, compiled=corner)


FLAT_RATES_E = (1.0, 10.0, 100.0, 1000.0)
MOST_FLAT_E = 4000.0
FLAT_DN_PER_E = 8.0
"""System gain of flat fields, if the range allows it: so high that rounding to DN hides nothing of a distribution."""


def flat_rates(read_std_e: float, law_distance: float) -> list[float]:
    """Return the mean electrons of the flat fields: few, many, and near the limits of the Gaussian approximation."""
    below, above = gaussian_from(read_std_e, law_distance)
    edges = (0.5 * below, 0.99 * below, 1.01 * above, 2 * above)
    return sorted({*FLAT_RATES_E, *(rate for rate in edges if 0.01 < rate < MOST_FLAT_E)})


# ----------------------------------------------------------------------------------------------------------- budgets


def chosen_methods(budget: Budget) -> frozenset[str]:
    """Return the methods that a budget chooses for two-parameter or physical noise."""
    return frozenset(name for counts in (False, True) for name in choose_methods(budget, counts))


def budget_for(method: Method, tiers: dict[str, AccuracyConfig]) -> AccuracyConfig:
    """Return the budget that chooses a method and is exact otherwise.

    Methods that are available only together, such as those in float32, are all chosen.
    """
    exact = tiers[EXACT]
    if method.spelled in chosen_methods(accuracy_budget(exact)):
        return exact
    if method.readable:
        return tiers[REFERENCE]
    together = [
        one for one in METHODS if one.implementation == method.implementation and one.implementation != "float64"
    ] or [method]
    return replace(
        exact,
        clean_dn=max(exact.clean_dn, *(one.clean_dn for one in together)),
        clean_changed_share=max(exact.clean_changed_share, *(one.clean_changed_share for one in together)),
        normal_error=max(exact.normal_error, *(one.normal_error for one in together)),
        law_distance=max(tier.law_distance for tier in tiers.values()) if method.approximates_law else 0.0,
    )


def _numbers(accuracy: AccuracyConfig) -> object:
    """Return the numbers of a budget without its name, as a key."""
    return dataclasses.astuple(replace(accuracy, name=""))


# ------------------------------------------------------------------------------------------------------ construction


def open_session(config: Config, profiles: BenchmarkProfiles, sizes: SampleSizes) -> BenchmarkSession:
    """Return a session for a config; ConfigError if no photograph can be read or the config cannot be compared."""
    mosaics = as_mosaics(config)
    return BenchmarkSession(
        compared_configs(mosaics, profiles),
        compared_tiers(config, profiles),
        load_images(mosaics, sizes),
        sizes,
        run_settings(config, profiles),
    )


def as_mosaics(config: Config) -> Config:
    """Return the config with unpacked frames; packing moves values but changes none."""
    return replace(config, output=replace(config.output, layout=MOSAIC))


def compared_configs(config: Config, profiles: BenchmarkProfiles) -> dict[str, Config]:
    """Return the given config, and two with 14 bits whose noise is two-parameter and physical."""
    at_14_bits = replace(config, sensor=profiles.sensor)
    if is_physical(config.noise):
        two_parameter, physical = _with_other_noise(at_14_bits, profiles.two_parameter_noise), at_14_bits
    else:
        two_parameter = replace(at_14_bits, noise=replace(config.noise, law="gaussian"))
        physical = _at_calibrated_iso(_with_other_noise(at_14_bits, profiles.physical_noise))
    for one in (two_parameter, physical):
        validate_config(one)
    return {TWO_PARAMETER: two_parameter, PHYSICAL: physical, GIVEN: config}


def run_settings(config: Config, profiles: BenchmarkProfiles) -> dict[str, Config]:
    """Return the settings of complete runs: the given config, two-parameter noise, and physical noise in each scene.

    Settings equal to the given config are left out.
    """
    two_parameter, physical = config, config
    if is_physical(config.noise):
        two_parameter = _with_other_noise(config, profiles.two_parameter_noise)
    else:
        physical = _with_other_noise(config, profiles.physical_noise)
    scenes = {name: _at_calibrated_iso(replace(physical, scene=scene)) for name, scene in profiles.scenes.items()}
    others = {TWO_PARAMETER_RUN: two_parameter, **scenes}
    for one in others.values():
        validate_config(one)
    return {GIVEN: config, **{name: one for name, one in others.items() if one != config}}


def _with_other_noise(config: Config, noise: NoiseConfig) -> Config:
    """Replace a noise profile by one of the other kind, and drop effects that do not apply to it."""
    effects = EffectsConfig(tolerance=config.effects.tolerance, assumed=config.effects.assumed)
    return replace(config, noise=noise, effects=effects, clean=CleanConfig())


def _at_calibrated_iso(config: Config) -> Config:
    try:
        validate_config(config)
    except ConfigError:
        return replace(config, noise=replace(config.noise, iso=FALLBACK_ISO))
    return config


def compared_tiers(config: Config, profiles: BenchmarkProfiles) -> dict[str, AccuracyConfig]:
    """Return every tier, and the given budget under its own name if it differs from all tiers."""
    given = config.accuracy
    if any(_numbers(given) == _numbers(tier) for tier in profiles.tiers.values()):
        return profiles.tiers
    return {**profiles.tiers, f"{given.name}_changed" if given.name in profiles.tiers else given.name: given}


def load_images(config: Config, sizes: SampleSizes) -> tuple[BenchmarkImage, ...]:
    """Read evenly spaced photographs and ignore those that fail; ConfigError if all fail."""
    sources = evenly_spaced(list_photographs(config.source).sources, sizes.photographs)
    images = []
    for source in sources:
        with suppress(SourceError):
            sha256, photograph = load_source(config.source, source)
            identity = source.stream_identity(sha256)
            images.append(BenchmarkImage(source.name, identity, *cut_image(photograph.srgb, sizes)))
    if not images:
        raise ConfigError(
            f"source.root={config.source.root}: none of {len(sources)} photographs tried can be read; expected at "
            "least one"
        )
    return tuple(images)


def cut_image(srgb: Srgb, sizes: SampleSizes) -> tuple[Srgb, Srgb, Srgb]:
    """Return an image subsampled, and its centre in two sizes.

    Errors are measured on subsampled images, because centres alone are brighter than complete images.
    """
    step = max(1, math.ceil(math.sqrt(srgb.shape[0] * srgb.shape[1] / math.prod(sizes.sampled))))
    return _copy(srgb[::step, ::step]), _centre(srgb, sizes.readable), _centre(srgb, sizes.compiled)


def _centre(srgb: Srgb, most: tuple[int, int]) -> Srgb:
    top, left = (max(side - limit, 0) // 2 for side, limit in zip(srgb.shape[:2], most, strict=True))
    return _copy(srgb[top : top + most[0], left : left + most[1]])


def _copy(srgb: Srgb) -> Srgb:
    """Copy a part of an image, so that the memory of the complete image can be freed."""
    part: Srgb = srgb.copy()
    return part
