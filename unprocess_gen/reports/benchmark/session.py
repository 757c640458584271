"""Hold the photographs, configs and budgets of one benchmark, and the pairs that several measurements share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

from unprocess_gen.config import schema
from unprocess_gen.config.accuracy import METHODS, Method, choose_methods
from unprocess_gen.config.interpretation import is_physical
from unprocess_gen.config.schema import AccuracyConfig, Config, NoiseConfig
from unprocess_gen.config.serialization import read_option, read_tiers
from unprocess_gen.config.validation import validate_config
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.core.types import MOSAIC, Pair, Plan, Srgb
from unprocess_gen.planning.effect_selection import facts_for
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.sources.loader import list_photographs, load_source

REFERENCE, EXACT, FAST = "reference", "exact", "fast"
"""Tiers: the one that defines results, the default, and the quickest."""

TWO_PARAMETER, PHYSICAL, GIVEN = "two_parameter", "physical", "given"
"""Configs of a session: 14 bits with two-parameter noise, 14 bits with physical noise, the user's own."""

TWO_PARAMETER_RUN = "two_parameter_noise"
"""Name of the setting of complete runs that has the user's sensor with two-parameter noise."""

OTHER_NOISE = {TWO_PARAMETER: "imx385_iso3200", PHYSICAL: "sony_a7s2"}
"""Noise profile of each kind, for a user's config with noise of the other kind."""

RUN_SCENES = ("daylight", "night")
"""Scenes of complete runs with physical noise."""

FALLBACK_ISO = 1600
"""ISO of the physical profile if it is not calibrated at the ISO of the scene."""


@dataclass(frozen=True, slots=True)
class SampleSizes:
    """Sizes of the measurement; sizes of images are the largest height and width.

    Errors are measured on ``sampled`` photographs, NumPy methods on ``readable`` crops, kernels on ``compiled`` crops.
    ``run_files`` and ``run_pixels`` limit complete runs to photographs and, if there are several, to pixels.
    """

    photographs: int = 8
    rounds: int = 7
    sampled: tuple[int, int] = (384, 512)
    readable: tuple[int, int] = (512, 768)
    compiled: tuple[int, int] = (1024, 1536)
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

    def corner(self) -> BenchmarkImage:
        """A small corner, which compiles the kernels quickly."""
        corner = self.sampled[:16, :16].copy()
        return replace(self, sampled=corner, readable=corner, compiled=corner)


EDITS: dict[str, Callable[[tuple[str, ...]], tuple[str, ...]]] = {
    "unchanged": lambda effects: effects,
    "with_shot": lambda effects: ("shot", *(name for name in effects if name != "shot")),
    "without_shot": lambda effects: tuple(name for name in effects if name != "shot"),
    "without_effects": lambda effects: ("quantise",),
}
"""Changes to the effects of a plan."""


@dataclass
class BenchmarkSession:
    """Inputs of all measurements; ``run_configs`` are the settings of complete runs, `GIVEN` first."""

    configs: dict[str, Config]
    tiers: dict[str, AccuracyConfig]
    images: tuple[BenchmarkImage, ...]
    sizes: SampleSizes
    run_configs: dict[str, Config] = field(default_factory=dict)
    _pairs: dict[object, list[tuple[Pair, Plan]]] = field(default_factory=dict)

    @property
    def all_configs(self) -> dict[str, Config]:
        """Every config by name; complete runs with the given settings have the configs of its mosaics."""
        return self.run_configs | self.configs

    @property
    def given_tier(self) -> str:
        """Name of the tier with the numbers of the given budget."""
        given = _numbers(self.configs[GIVEN].accuracy)
        return next(name for name, tier in self.tiers.items() if _numbers(tier) == given)

    def plan(
        self, config_name: str, accuracy: AccuracyConfig, image: BenchmarkImage, srgb: Srgb, edit: str = "unchanged"
    ) -> Plan:
        """Plan of some pixels of an image under a budget, with the effects of one of `EDITS`."""
        config = replace(self.all_configs[config_name], accuracy=accuracy)
        plan = plan_image(config, *image.identity, facts_for(config, srgb))
        return plan.replace(effects=EDITS[edit](plan.noise.effects))

    def sampled_pairs(
        self, config_name: str, accuracy: AccuracyConfig, edit: str = "unchanged"
    ) -> list[tuple[Pair, Plan]]:
        """Pairs and plans of all subsampled images under a budget, kept for further calls."""
        key = (config_name, edit, _numbers(accuracy))
        if key not in self._pairs:
            plans = [self.plan(config_name, accuracy, image, image.sampled, edit) for image in self.images]
            self._pairs[key] = [
                (make_pair(image.sampled, plan), plan) for image, plan in zip(self.images, plans, strict=True)
            ]
        return self._pairs[key]


# ----------------------------------------------------------------------------------------------------------- budgets


def chosen_methods(budget: AccuracyConfig) -> frozenset[str]:
    """Methods that a budget chooses for two-parameter or physical noise."""
    return frozenset(name for counts in (False, True) for name in choose_methods(budget, counts))


def budget_for(method: Method, tiers: dict[str, AccuracyConfig]) -> AccuracyConfig:
    """The budget that chooses a method, together with the others of its implementation, and is exact otherwise."""
    exact = tiers[EXACT]
    if method.spelled in chosen_methods(exact):
        return exact
    if method.readable:
        return tiers[REFERENCE]
    together = [other for other in METHODS if other.implementation == method.implementation]
    return replace(
        exact,
        clean_dn=max(other.clean_dn for other in together),
        clean_changed_share=max(other.clean_changed_share for other in together),
        normal_error=max(other.normal_error for other in together),
    )


def _numbers(accuracy: AccuracyConfig) -> object:
    """The numbers of a budget without its name, as a key."""
    return dataclasses.astuple(replace(accuracy, name=""))


# ------------------------------------------------------------------------------------------------------ construction


def open_session(config: Config, sizes: SampleSizes) -> BenchmarkSession:
    """Session for a config; ConfigError if no photograph can be read or the config cannot be compared."""
    mosaics = replace(config, output=replace(config.output, layout=MOSAIC))  # packing changes no value
    runs, at_14_bits = run_settings(config), configs_at_14_bits(mosaics)
    for compared in (*runs.values(), *at_14_bits.values()):
        validate_config(compared)
    images, tiers = load_images(mosaics, sizes), compared_tiers(config)
    return BenchmarkSession({**at_14_bits, GIVEN: mosaics}, tiers, images, sizes, runs)


def run_settings(config: Config) -> dict[str, Config]:
    """The given config, two-parameter noise, and physical noise in each scene; others differ from it."""
    two_parameter, physical = _kinds_of_noise(config)
    scenes = {name: _at_calibrated_iso(replace(physical, scene=read_option("scene", name))) for name in RUN_SCENES}
    others = {TWO_PARAMETER_RUN: two_parameter, **scenes}
    return {GIVEN: config, **{name: other for name, other in others.items() if other != config}}


def configs_at_14_bits(config: Config) -> dict[str, Config]:
    """Two configs with 14 bits, whose noise is two-parameter and Gaussian, and physical."""
    two_parameter, physical = _kinds_of_noise(replace(config, sensor=read_option("sensor", "generic_14bit")))
    gaussian = replace(two_parameter, noise=replace(two_parameter.noise, law="gaussian"))
    return {TWO_PARAMETER: gaussian, PHYSICAL: _at_calibrated_iso(physical)}


def _kinds_of_noise(config: Config) -> tuple[Config, Config]:
    """The config with two-parameter and with physical noise; one of them is the given one."""
    if is_physical(config.noise):
        return _with_other_noise(config, TWO_PARAMETER), config
    return config, _with_other_noise(config, PHYSICAL)


def _with_other_noise(config: Config, kind: str) -> Config:
    """Replace a noise profile by one of another kind, and drop effects that do not apply to it."""
    noise: NoiseConfig = read_option("noise", OTHER_NOISE[kind])
    effects = schema.EffectsConfig(tolerance=config.effects.tolerance, assumed=config.effects.assumed)
    return replace(config, noise=noise, effects=effects, clean=schema.CleanConfig())


def _at_calibrated_iso(config: Config) -> Config:
    try:
        validate_config(config)
    except ConfigError:
        return replace(config, noise=replace(config.noise, iso=FALLBACK_ISO))
    return config


def compared_tiers(config: Config) -> dict[str, AccuracyConfig]:
    """Every tier, and the given budget under its own name if it differs from all tiers."""
    given, tiers = config.accuracy, read_tiers()
    if any(_numbers(given) == _numbers(tier) for tier in tiers.values()):
        return tiers
    return {**tiers, f"{given.name}_changed" if given.name in tiers else given.name: given}


def load_images(config: Config, sizes: SampleSizes) -> tuple[BenchmarkImage, ...]:
    """Read evenly spaced photographs and ignore those that fail; ConfigError if all fail."""
    sources = evenly_spaced(list_photographs(config.source).sources, sizes.photographs)
    images = []
    for source in sources:
        with suppress(SourceError):
            sha256, photograph = load_source(config.source, source)
            images.append(cut_image(source.name, source.stream_identity(sha256), photograph.srgb, sizes))
    if not images:
        raise ConfigError(
            f"source.root={config.source.place}: none of {len(sources)} photographs tried can be read; expected at "
            "least one"
        )
    return tuple(images)


def cut_image(name: str, identity: tuple[str, int], srgb: Srgb, sizes: SampleSizes) -> BenchmarkImage:
    """Subsample an image for errors, because centres are brighter than complete images, and cut out its centre."""
    step = max(1, math.ceil(math.sqrt(srgb.shape[0] * srgb.shape[1] / math.prod(sizes.sampled))))
    sampled = srgb[::step, ::step].copy()  # a view would keep the complete image in memory
    return BenchmarkImage(name, identity, sampled, _centre(srgb, sizes.readable), _centre(srgb, sizes.compiled))


def _centre(srgb: Srgb, most: tuple[int, int]) -> Srgb:
    top, left = (max(side - limit, 0) // 2 for side, limit in zip(srgb.shape[:2], most, strict=True))
    centre: Srgb = srgb[top : top + most[0], left : left + most[1]].copy()
    return centre
