"""Draw every parameter of an image once, and record them in a `Plan`.

A pair is a pure function of pixels and plan. Draws come from the stream ``parameters`` of the image
(`core.random_streams`), with a counter for each (`draws`); so a draw that is not used moves no other.
"""

from __future__ import annotations

import bisect
import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import mul
from typing import Any, NamedTuple

from unprocess_gen.config import interpretation
from unprocess_gen.config.distributions import Distribution
from unprocess_gen.config.interpretation import burst_rule
from unprocess_gen.config.limits import EV, EXPOSURE_RATIO
from unprocess_gen.config.schema import CameraConfig, Config
from unprocess_gen.core.arrays import FLOAT32
from unprocess_gen.core.exact_distributions import power_of_two
from unprocess_gen.core.random_streams import DARK_FRAME, PARAMETERS, frame_word, purpose, split_uniform, stream_key
from unprocess_gen.core.sequences import Recent, add_in_order
from unprocess_gen.planning.draws import DRAW_COUNT, NOISE_COUNTERS, Draw
from unprocess_gen.planning.effect_selection import NOT_ROUNDED, BodySelection, EffectRules, Selection
from unprocess_gen.planning.frame_model import (
    AtLevel,
    SignalRange,
    linear_signal_range,
    raw_signal_range,
    signal_range,
)
from unprocess_gen.planning.motion import still
from unprocess_gen.planning.noise_profile import PhysicalNoise
from unprocess_gen.planning.parameters import draw_parameter
from unprocess_gen.planning.raw_source import own_noise, parts_of, with_raw_sensor
from unprocess_gen.simulation.facts import DarkFrames, Facts
from unprocess_gen.simulation.kernels.draws import draws, mixed_rgb2cam
from unprocess_gen.simulation.plan import (
    CameraPlan,
    DarkFramePlan,
    IspPlan,
    NoisePlan,
    OutputPlan,
    Physics,
    Place,
    Plan,
    ScenePlan,
    SensorPlan,
    SourcePlan,
)
from unprocess_gen.simulation.reference import colour
from unprocess_gen.simulation.reference.cfa import MONO
from unprocess_gen.simulation.reference.light import LIGHTS, camera_gains
from unprocess_gen.simulation.reference.primaries import light_colours
from unprocess_gen.simulation.reference.sensor import noise_in_dn


def plan_image(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    dark_frames: DarkFrames | None = None,
) -> Plan:
    """Draw every parameter of one image, at the first noise level.

    All draws are functions of ``config.seed``, ``source_sha256`` and ``occurrence``.
    """
    return plan_pairs(config, source_sha256, occurrence, facts, 0, dark_frames)[0]


def plan_pairs(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    frame: int = 0,
    dark_frames: DarkFrames | None = None,
) -> tuple[Plan, ...]:
    """Draw the parameters of all pairs of one image: each noise level, and each draw of the noise at that level.

    The plans of a burst are those of all of its frames, without their motion, which depends on the patch.

    The first dark frame is chosen at random for each image, and the frames of a clip, the levels and the draws take the
    next ones in turn. All use the same part of the frames, so that the fixed pattern of the camera does not move.
    """
    levels, rule = [*_plan_exposures(config, source_sha256, occurrence, facts, dark_frames)], burst_rule(config.source)
    plans = [
        plan.replace(place=Place(number, plan.place.level, draw)) if draw or number else plan
        for number in ([frame] if rule is None else range(rule.frames))
        for plan, _ in (exposures[number % len(exposures)] for exposures in levels)
        for draw in range(config.noise.draws)
    ]
    if dark_frames is not None and facts is not None:
        first = frame * len(plans)
        plans = [with_dark_frame(plan, dark_frames, facts, first + number) for number, plan in enumerate(plans)]
    return tuple(plans)


def redraw_plans(
    config: Config, plan: Plan, facts: Facts | None, dark_frames: DarkFrames | None, epoch: int
) -> list[Plan]:
    """Draw new parameters of a pair for an epoch; its level, draw, frame, split and dark frame stay.

    There is one plan, or one for each exposure of a burst.
    """
    planner = _planner(with_raw_sensor(config, parts_of(plan)))
    images = planner.images(plan.seed, plan.stream_key, plan.split, facts, dark_frames, epoch)
    redrawn = planner.plans(images, plan.place, plan.dark)
    return [new.decoded(plan.source.profile, plan.source.pixels_xxh3) for new, _ in redrawn]


def next_dark_frame(plan: Plan, dark_frames: DarkFrames, epoch: int) -> Plan:
    """Replace the dark frame of a pair by another one in each epoch, at the same place: the body does not move."""
    assert plan.dark is not None
    digests = [frame.sha256 for frame in dark_frames.frames]
    number = (digests.index(plan.dark.dark_frame) + epoch) % len(digests)
    return plan.replace(dark=plan.dark.replace(dark_frame=digests[number]))


def with_dark_frame(plan: Plan, dark_frames: DarkFrames, facts: Facts, number: int) -> Plan:
    """Choose the dark frame of one pair."""
    words, _ = draws(plan.stream_key, 1, purpose(DARK_FRAME))
    chosen, row, column, _ = words[0].tolist()
    count = len(dark_frames.frames)
    frame = dark_frames.frames[((chosen * count >> 32) + number) % count]
    shift = _even_place(row, frame.height, facts.height), _even_place(column, frame.width, facts.width)
    return plan.replace(dark=DarkFramePlan(frame.sha256, shift, dark_frames.black_dn, dark_frames.scale))


def _even_place(word: int, available: int, needed: int) -> int:
    """Return an even place, drawn with a random word: any place at which a part of this length begins inside."""
    places = (available - needed) // 2 + 1 if available >= needed else available // 2
    return 2 * (word * places >> 32)


def plan_levels(
    config: Config,
    source_sha256: str,
    occurrence: int = 0,
    facts: Facts | None = None,
    dark_frames: DarkFrames | None = None,
) -> Iterator[tuple[Plan, Selection | None]]:
    """Yield the plan of one image at each noise level, and the selection of effects of a physical profile."""
    return (exposures[0] for exposures in _plan_exposures(config, source_sha256, occurrence, facts, dark_frames))


def _plan_exposures(
    config: Config, source_sha256: str, occurrence: int, facts: Facts | None, dark_frames: DarkFrames | None
) -> Iterator[Sequence[tuple[Plan, Selection | None]]]:
    """Yield the plans of one image at each noise level: one, or one for each exposure of a burst."""
    planner, key = _planner(config), stream_key(config.seed, source_sha256, occurrence)
    images = planner.images(config.seed, key, draw_split(config, source_sha256), facts, dark_frames)
    return (planner.plans(images, Place(level=number)) for number in range(len(planner.levels)))


def draw_split(config: Config, source_sha256: str) -> str:
    """Name the split of an image, empty without splits; the last split takes the remaining images."""
    splits: dict[str, float] = config.split or {"": 1.0}
    names, ends = list(splits), list(itertools.accumulate(splits.values()))
    return names[bisect.bisect_right(ends[:-1], split_uniform(config.seed, source_sha256))]


def _planner(config: Config) -> Planner:
    """Return the planner of a config, whatever its seed; hashing a config takes a fifth of all draws of an image."""
    known = _planners.get(id(config))
    if known is None or known[0] is not config:
        known = _planners.keep(id(config), (config, _planner_without_seed(replace(config, seed=0))))
    return known[1]


_planners: Recent[int, tuple[Config, Planner]] = Recent(64)
"""Planners by the identities of configs, which they keep."""


@functools.lru_cache(maxsize=64)
def _planner_without_seed(config: Config) -> Planner:
    return Planner(config)


LINEAR_ISP, UNCHANGED = IspPlan("none", "srgb", "none"), Distribution("constant", (1.0,))
"""Curve and brightening of linear sources: none is inverted, and pictures are developed with the curve of sRGB."""


class Planner:
    """Draw plans for the images of one configuration, which is interpreted once.

    Parsing distributions and interpreting the noise profile take longer than all draws of an image. The seed of the
    config is not used.
    """

    def __init__(self, config: Config) -> None:
        self._camera, self._needs_dark_frames = config.camera, interpretation.uses_dark_frames(config.noise)
        self._red, self._blue, self._inverse_rgb = interpretation.gain_distributions(config.gains)
        self._lights = interpretation.lights(config)
        self._ev = EV.parse("scene.ev", config.scene.ev)
        self._exposure_ratio = EXPOSURE_RATIO.parse("scene.exposure_ratio", config.scene.exposure_ratio)
        self._is_physical = interpretation.is_physical(config.noise)
        kind, levels = PhysicalLevel if self._is_physical else TwoNumberLevel, interpretation.noise_levels(config.noise)
        self.levels = [kind(replace(config, noise=noise)) for noise in levels]
        self._accuracy, self._scene_name = config.accuracy, config.scene.name
        self._source = SourcePlan(config.source.downscale, config.source.dequantize)
        isp, gains, sensor = config.isp, config.gains, config.sensor
        gamma = "srgb" if isp.gamma == "srgb" else float(isp.gamma)
        self._isp = IspPlan(isp.tone, gamma, gains.highlight, gains.threshold)
        if config.source.kind == "linear":  # there is no curve and no brightening to invert; pictures are developed so
            self._isp, self._inverse_rgb = LINEAR_ISP, UNCHANGED
        levels_dn, saturated_as = (sensor.black_level_dn, sensor.white_level_dn), interpretation.saturated_as(config)
        self._sensor = SensorPlan(sensor.pattern, sensor.bits, *levels_dn, sensor.clip, saturated_as)
        rule = burst_rule(config.source)
        self._stops = (0.0,) if rule is None else rule.exposures
        self._motion = None if rule is None else still(rule)
        clean_dtype = FLOAT32 if interpretation.has_float_clean(config) else ""
        self._output = OutputPlan(config.output.dtype, config.output.layout, clean_dtype)

    def images(
        self, seed: int, key: int, split: str, facts: Facts | None, dark_frames: DarkFrames | None, epoch: int = 0
    ) -> list[Image]:
        """Draw what the noise levels of an image share in an epoch, for each exposure of a burst."""
        if self._needs_dark_frames and dark_frames is None:
            raise ValueError("noise.dark_frames: the plan needs the dark frames")
        if self._is_physical and facts is None:
            raise ValueError("a physical profile needs the facts of the pixels")
        uniforms = draws(key, DRAW_COUNT, purpose(PARAMETERS), frame_word(0, epoch))[1].tolist()
        ratio, ev = (
            draw_parameter(distribution, uniforms[counter])
            for distribution, counter in ((self._exposure_ratio, Draw.EXPOSURE_RATIO), (self._ev, Draw.EV))
        )
        raw = None if facts is None else facts.raw
        if raw is None:
            # compiling takes as long as 20,000 matrices, which only redrawn plans may need
            name, weights, rgb2cam = plan_camera(self._camera, uniforms, is_compiled=epoch > 0)
            red, blue = draw_parameter(self._red, uniforms[Draw.RED]), draw_parameter(self._blue, uniforms[Draw.BLUE])
            lamp, cct_k = "", 0.0
            if self._lights:
                lamp, cct_k, (red, blue) = draw_light(self._lights, xyz2cam(self._camera, weights), uniforms)
            camera = CameraPlan(
                camera=name, weights=weights, rgb2cam=rgb2cam, light=lamp, cct_k=cct_k, red_gain=red, blue_gain=blue,
                inverse_rgb_gain=draw_parameter(self._inverse_rgb, uniforms[Draw.INVERSE_RGB]),
            )  # fmt: skip
            camera = without_filters(camera) if self._sensor.pattern == MONO else camera
            source, isp = (facts and facts.source) or self._source, self._isp
        else:
            source, isp, camera = raw.source, raw.isp, raw.camera
        images = []
        for stops in self._stops:
            scene = ScenePlan(self._scene_name, ratio, ev + stops)
            light = scene.exposure, float(self._sensor.span_dn)
            of_scene = source if raw is None else own_noise(raw, *light)
            signals = None
            if self._is_physical and facts is not None:
                if raw is not None:
                    signals = raw_signal_range(facts, of_scene, *light)
                elif source.is_linear:
                    signals = linear_signal_range(facts, *light_colours(source, camera), light[0], self._sensor)
                else:
                    signals = signal_range(facts, isp, camera, *light)
            shared = facts, signals, dark_frames, stops
            images.append(Image(seed, key, split, epoch, uniforms, scene, of_scene, camera, isp, *shared))
        return images

    def plans(
        self, images: Sequence[Image], place: Place, dark: DarkFramePlan | None = None
    ) -> list[tuple[Plan, Selection | None]]:
        """Draw the noise of an image at the level of a place, for each exposure of a burst.

        All frames of a burst get each effect that one of them needs.
        """
        plans = [self.plan(image, place, dark) for image in images]
        selections = [selection for _, selection in plans if selection is not None]
        if len(selections) < 2:
            return plans
        on = frozenset[str]().union(*(selection.on for selection in selections))
        together = [selection._replace(on=on) for selection in selections]
        chosen = ({name: getattr(selection, name) for name in CHOSEN} for selection in together)
        return [(plan.replace(**names), own) for (plan, _), names, own in zip(plans, chosen, together, strict=True)]

    def plan(self, image: Image, place: Place, dark: DarkFramePlan | None = None) -> tuple[Plan, Selection | None]:
        """Draw the noise of an image at the level of a place."""
        uniforms = image.uniforms
        if place.level:
            words = purpose(PARAMETERS, place.level), frame_word(0, image.epoch)
            own = draws(image.stream_key, DRAW_COUNT, *words)[1].tolist()
            uniforms = [own[n] if n in NOISE_COUNTERS else shared for n, shared in enumerate(uniforms)]
        noise, physics, selection = self.levels[place.level].draw(image, uniforms)
        return Plan(
            seed=image.seed, stream_key=image.stream_key, split=image.split, place=place, camera=image.camera,
            isp=image.isp, source=image.source, motion=self._motion, sensor=self._sensor, scene=image.scene,
            noise=noise, accuracy=self._accuracy, physics=physics, dark=dark, output=self._output,
        ), selection  # fmt: skip


def without_filters(camera: CameraPlan) -> CameraPlan:
    """Return a camera whose channels are equal: each is the mean of the three, gains included.

    Highlights are kept like highlights of the mean, whose gain is the mean of the three.
    """
    gains, rgb2cam = camera.inverse_gains, camera.rgb2cam
    sums = [add_in_order(map(mul, gains, rgb2cam[column::3])) for column in range(3)]
    red, green, blue = (value / add_in_order(sums) for value in sums)
    rows = red, green, blue, red, green, blue, red, green, blue
    return camera.replace(rgb2cam=rows, red_gain=1.0, blue_gain=1.0, inverse_rgb_gain=add_in_order(gains) / 3)


CHOSEN = "effects", "skipped", "assumed"
"""Fields of a plan that the selection of effects decides."""

DrawnNoise = tuple[NoisePlan, Physics | None, Selection | None]
"""Noise of a plan, and of a physical profile its numbers and the selection of effects."""


class Image(NamedTuple):
    """Draws and facts that the noise levels of an image share; a physical profile needs facts and signals."""

    seed: int
    stream_key: int
    split: str
    epoch: int
    uniforms: Sequence[float]
    scene: ScenePlan
    source: SourcePlan  # with the source's own noise
    camera: CameraPlan
    isp: IspPlan
    facts: Facts | None
    signals: SignalRange | None
    dark_frames: DarkFrames | None
    stops: float = 0.0  # of the exposure time, relative to the scene


class TwoNumberLevel:
    """One noise level of a profile with two numbers; the config has the profile of this level."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._a, self._b = interpretation.noise_distributions(config.noise)
        self._span_dn = config.sensor.white_level_dn - config.sensor.black_level_dn
        kept = functools.lru_cache(maxsize=64)  # of live pairs, which draw few of the numbers
        self._in_dn, self._plan = kept(self._convert), kept(self._noise_plan)

    def draw(self, image: Image, uniforms: Sequence[float]) -> DrawnNoise:
        """Draw the two numbers and select the effects of an image at this level."""
        a_dn, b_dn2 = self.two_numbers(uniforms)
        if self._config.source.own_noise == "subtract":  # the variances are lines, so their difference is one
            a_dn, b_dn2 = a_dn - image.source.own_a_dn, b_dn2 - image.source.own_b_dn2
        return self._plan(a_dn, b_dn2), None, None

    def _noise_plan(self, a_dn: float, b_dn2: float) -> NoisePlan:
        noise = self._config.noise
        return NoisePlan(noise.name, noise.law, a_dn, b_dn2, *plan_effects(self._config, a_dn, b_dn2, self._span_dn))

    def two_numbers(self, uniforms: Sequence[float]) -> tuple[float, float]:
        """Draw the two numbers and convert them to the sensor's DN: (a_dn, b_dn2)."""
        a = draw_parameter(self._a, uniforms[Draw.A])
        return self._in_dn(a, draw_parameter(self._b, uniforms[Draw.B], a))

    def _convert(self, a: float, b: float) -> tuple[float, float]:
        noise, sensor = self._config.noise, self._config.sensor
        levels_dn = noise.black_level_dn or 0, noise.white_level_dn or 0
        sensor_dn = sensor.black_level_dn, sensor.white_level_dn
        meaning = {"units": noise.units or "", "black": noise.black or ""}
        return noise_in_dn(a, b, **meaning, profile_levels_dn=levels_dn, sensor_levels_dn=sensor_dn)


class Sensor(NamedTuple):
    """Numbers of a sensor unit in a scene, its fixed patterns, and predictions at the darkest signal by frame size."""

    physics: Physics
    patterns: BodySelection | None
    at_dark: Recent[tuple[int, int, int], AtLevel]


class PhysicalLevel:
    """One noise level of a physical profile; the config has the profile of this level."""

    def __init__(self, config: Config) -> None:
        self._noise, self._rules = PhysicalNoise(config), EffectRules(config)
        self._sensors: Recent[tuple[Any, ...], Sensor] = Recent(1024)

    def draw(self, image: Image, uniforms: Sequence[float]) -> DrawnNoise:
        """Draw the numbers of the sensor and select the effects of an image at this level."""
        assert image.facts is not None and image.signals is not None
        facts, lens, dark = image.facts, self._noise.has_lens_shading, image.dark_frames
        drawn = self._noise.draw(uniforms, image.stream_key, image.seed)
        if image.stops:
            drawn = drawn._replace(exposure_s=drawn.exposure_s * power_of_two(image.stops))
        key = drawn, dark and dark.variance_dn2, facts.frames > 1, (facts.height, facts.width) if lens else None
        known = self._sensors.get(key)
        if known is None:
            physics = self._noise.physics(drawn)
            if dark is not None:
                read_std_dn = math.sqrt(dark.variance_dn2)
                physics = physics.replace(read_law="gaussian", read_shape=0.0, read_std_dn=read_std_dn)
            if lens:
                physics = physics.replace(frame_size=(facts.height, facts.width))
            patterns = self._rules.select_patterns(physics, facts.frames > 1)
            known = self._sensors.keep(key, Sensor(physics, patterns, Recent(16)))
        physics, patterns, known_at_dark = known
        frame = facts.width, facts.height, facts.frames
        at_dark = known_at_dark.get(frame) or known_at_dark.keep(frame, AtLevel())
        selection = self._rules.select_effects(physics, facts, image.signals, patterns, at_dark)
        name, law, b_dn2 = self._noise.noise.name, self._noise.noise.law, physics.read_std_dn * physics.read_std_dn
        chosen = selection.effects, selection.skipped, selection.assumed
        return NoisePlan(name, law, physics.dn_per_e, b_dn2, *chosen), physics, selection


# ---------------------------------------------------------------------------------------------------------- camera

Weights = tuple[float, float, float, float]


def plan_camera(
    camera: CameraConfig, uniforms: Sequence[float], is_compiled: bool = False
) -> tuple[str, Weights, colour.Matrix]:
    """Return the name of the camera, the weights of the four known cameras in it, and its matrix from linear sRGB.

    With ``is_compiled``, a kernel computes the matrix of a mix, with the same result.
    """
    names = tuple(colour.CAMERAS)
    if camera.law == "identity":
        return camera.name, (0.0, 0.0, 0.0, 0.0), colour.IDENTITY
    if camera.law == "custom":
        return camera.name, (0.0, 0.0, 0.0, 0.0), colour.rgb2cam(colour.matrix(camera.xyz2cam or ()))
    if camera.law == "convex":
        weights = convex_weights(uniforms if camera.weights is None else camera.weights)
        matrix = mixed_rgb2cam(weights) if is_compiled else colour.rgb2cam(xyz2cam(camera, weights))
        return camera.name, weights, matrix
    name = names[int(uniforms[Draw.CHOICE] * len(names))] if camera.law == "choice" else camera.name
    w0, w1, w2, w3 = (float(name == other) for other in names)
    return name, (w0, w1, w2, w3), colour.rgb2cam(colour.CAMERAS[name])


def xyz2cam(camera: CameraConfig, weights: Weights) -> colour.Matrix:
    """Return the matrix from XYZ to the camera of an image, before its rows are divided by their sums."""
    if camera.law == "identity":
        return colour.invert(colour.RGB2XYZ)
    if camera.law == "custom":
        return colour.matrix(camera.xyz2cam or ())
    return colour.mix(tuple(colour.CAMERAS.values()), weights)


def draw_light(
    lights: Sequence[tuple[str, float]], matrix: colour.Matrix, uniforms: Sequence[float]
) -> tuple[str, float, tuple[float, float]]:
    """Draw a light and its colour temperature; return both, and the gains of red and blue of a camera under it."""
    ends = list(itertools.accumulate(share for _, share in lights))
    name = lights[bisect.bisect_right(ends[:-1], uniforms[Draw.LIGHT])][0]
    kelvin = LIGHTS[name].kelvin(uniforms[Draw.CCT])
    return name, kelvin, camera_gains(matrix, LIGHTS[name].xy(kelvin, 2 * uniforms[Draw.LIGHT_DISTANCE] - 1))


def convex_weights(uniforms: Sequence[float]) -> Weights:
    """Return the first four uniforms, each divided by their sum (Brooks et al. 2019, random_ccm())."""
    u0, u1, u2, u3 = uniforms[Draw.WEIGHT_0 : Draw.WEIGHT_3 + 1]
    total = u0 + u1 + u2 + u3
    return u0 / total, u1 / total, u2 / total, u3 / total


# ----------------------------------------------------------------------------------------------------------- noise


def plan_effects(config: Config, a_dn: float, b_dn2: float, span_dn: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the simulated effects of a profile with two numbers, in order, and the skipped ones with their reasons.

    ``span_dn`` is the white level minus the black level. If the variance is 0 or less in all of it, no noise is
    simulated.
    """
    noise = config.noise.name
    rounded = not interpretation.is_normalised(config)
    last = ("quantise",) if rounded else ()
    skipped = () if rounded else (f"quantise: {NOT_ROUNDED}",)
    if interpretation.effect_switch(config.effects, "heteroscedastic") == "off":
        return last, ("heteroscedastic: switched off", *skipped)
    if max(a_dn * span_dn + b_dn2, b_dn2) <= 0:
        numbers = f"a_dn={a_dn!r}, b_dn2={b_dn2!r}"
        none = f"heteroscedastic: noise={noise} has no variance ({numbers})"
        return last, (none, *skipped)
    return ("heteroscedastic", *last), skipped
