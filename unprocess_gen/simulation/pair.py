"""Simulate the clean and noisy raw frame of one image: the module to read first.

`reference_pair` defines a pair with the NumPy reference, in the order of the article. `make_pair` computes the same
frames with compiled kernels, much faster; datasets are made with it. Tests compare both on photographs and
on every option.

In both, a pair is computed in three steps: unprocess the image to the clean frame, add the effects of the sensor, then
clip and round both frames.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.arrays import FLOAT32, MOSAIC, PACKED, Float, Frame, Normalised, Srgb
from unprocess_gen.core.random_streams import frame_word
from unprocess_gen.simulation.facts import DarkPixels
from unprocess_gen.simulation.frames import Counts, Pair
from unprocess_gen.simulation.kernels.render import CODES, Renderer, render_clean, renderer_of
from unprocess_gen.simulation.plan import EXACT, MOST_LIGHT, REFERENCE, Plan
from unprocess_gen.simulation.plan_slots import slots_of
from unprocess_gen.simulation.reference import electrons
from unprocess_gen.simulation.reference.cfa import ONE_COLOUR, pack
from unprocess_gen.simulation.reference.sensor import in_dn, normalise, quantise, to_dn
from unprocess_gen.simulation.reference.unprocess import dequantise, unprocess


def make_pair(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0), dark_pixels: DarkPixels | None = None) -> Pair:
    """Simulate the clean and noisy raw frame of one image.

    The result depends only on the arguments, not on machine, worker, method or order.

    Parameters
    ----------
    srgb : ndarray of uint8 or uint16, [H, W, 3]
        Display-referred codes, R, G, B.
    plan : Plan
        All parameters of the pair.
    origin : (int, int)
        Row and column of ``srgb[0, 0]`` in the full frame. The pair of a crop is the crop of the full pair.
    dark_pixels : DarkPixels, optional
        Access to the dark frame that the plan names.

    Returns
    -------
    Pair
        Clean and noisy frame: uint16 [H, W] in DN, unless dtypes or layout of the plan differ; counts of
        clipped, saturated and zero-variance sites.

    Raises
    ------
    ValueError
        If ``srgb`` has another dtype or shape, or an odd side with ``layout="packed"``, or if the plan has lens shading
        and the image is not inside the plan's frame, or if the plan names a dark frame and ``dark_pixels`` is None.
    """
    return next(make_pairs(srgb, [plan], origin, dark_pixels))


def make_pairs(
    srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int] = (0, 0), dark_pixels: DarkPixels | None = None
) -> Iterator[Pair]:
    """Simulate several pairs of one image that share the clean frame, in the order of their plans.

    Each pair equals that of `make_pair`, but the image is unprocessed once for several pairs. Raises ValueError as
    `make_pair`, and if the plans differ in more than noise, level and draw.
    """
    for plan in plans:
        _check_image(srgb, plan, origin)
    if any(plan.clean != plans[0].clean for plan in plans[1:]):
        raise ValueError(
            "the clean frames of the plans differ; expected plans that differ in noise, level and draw only"
        )
    return _pairs(srgb, plans, origin, dark_pixels)


FRAMES_PER_PASS = 5
"""Noisy frames simulated in one pass over the image: 10 bytes per pixel, and 5 for the image and the clean frame."""


def _pairs(
    srgb: Srgb, plans: Sequence[Plan], origin: tuple[int, int], dark_pixels: DarkPixels | None
) -> Iterator[Pair]:
    """Yield the pair of each plan, several from each pass over the image, with one kind of noise and one sensor unit.

    Each pass recomputes the clean frame, which costs less than storing it unrounded.
    """
    if not plans:
        return
    srgb = dequantise(srgb, plans[0], origin)
    if plans[0].accuracy == REFERENCE:
        yield from (reference_pair(srgb, plan, origin, dark_pixels) for plan in plans)
        return
    clean: Frame | None = None
    for _, group in itertools.groupby(plans, lambda plan: (plan.counts_electrons, slots_of(plan).patterns)):
        while alike := tuple(itertools.islice(group, FRAMES_PER_PASS)):
            renderer = renderer_of(srgb, alike, origin)
            own, noisy, numbers = renderer.render(srgb, origin, renderer.keys, dark_pixels)
            clean = own if clean is None else clean
            yield from map(functools.partial(Pair, clean), noisy, _counts_of(numbers, plans[0]))


def _counts_of(numbers: NDArray[np.int64], plan: Plan) -> list[Counts]:
    """Counts of frames that share the clean frame."""
    clean_low, clean_high, _, _, saturated, _, light_high = numbers[0].tolist()
    is_linear = plan.source.is_linear
    light = light_high if is_linear or plan.scene.exposure != 1 else None, clean_low if is_linear else None
    return [
        Counts(clean_low, clean_high, noisy_low, noisy_high, saturated, zero_variance, *light)
        for _, _, noisy_low, noisy_high, _, zero_variance, _ in numbers.tolist()
    ]


CropMaker = Callable[[Srgb, tuple[int, int], int], tuple[Frame, Frame, Callable[[], Counts]]]
"""Takes pixels, the row and column of the first one in the full frame, and the epoch. Returns the clean frame, the
noisy frame, and a function that returns their counts."""


def crop_maker(
    plan: Plan,
    shape: tuple[int, int],
    frame: tuple[int, int],
    corner: tuple[int, int],
    codes: int,
    dark_pixels: DarkPixels | None = None,
) -> CropMaker:
    """Return a function that simulates crops of one image in any epoch, with little fixed cost for each.

    All crops have one ``shape`` and the parities of ``corner``; ``frame`` is the height and width of the image, which
    has ``codes`` codes. Pairs are those of `make_pair` with ``plan.replace(epoch=epoch)``.
    """
    if plan.dark or plan.accuracy == REFERENCE:

        def make(srgb: Srgb, origin: tuple[int, int], epoch: int) -> tuple[Frame, Frame, Callable[[], Counts]]:
            pair = make_pair(srgb, plan.replace(epoch=epoch), origin, dark_pixels)
            return pair.clean, pair.noisy, lambda: pair.counts

        return make
    is_dithered = plan.source.dequantize != "off" and codes == CODES[0]
    renderer = Renderer((plan,), shape, (corner[0] % 2, corner[1] % 2), CODES[1] if is_dithered else codes)

    def make_crop(srgb: Srgb, origin: tuple[int, int], epoch: int) -> tuple[Frame, Frame, Callable[[], Counts]]:
        keys = renderer.keys.copy()
        keys[0, 3] = frame_word(plan.place.frame, epoch)
        srgb = dequantise(srgb, plan, origin)
        clean, noisy, numbers = renderer.render(srgb, origin, keys, epoch=epoch, frame=frame)
        return clean, noisy[0], lambda: _counts_of(numbers, plan)[0]  # counted in 5 µs, if at all

    return make_crop


def linear_rgb(srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0)) -> Normalised:
    """Compute the scene before the mosaic: the clean frame with all three channels at every site, [H, W, 3].

    Camera RGB with all that the clean frame contains, 0 at black and 1 at white, float32. The channel of a site's
    filter is its unrounded clean value. If clean frames are rounded, all values round to the DN of the exact light; a
    few are therefore the second nearest float32. ``accuracy=fast`` changes clean frames, and not these values.
    """
    _check_image(srgb, plan, origin)
    srgb, levels_dn = dequantise(srgb, plan, origin), (plan.sensor.black_level_dn, plan.sensor.white_level_dn)
    channels: list[Normalised] = []
    for pattern in ONE_COLOUR:
        colour = plan.replace(pattern=pattern, layout=MOSAIC, accuracy=EXACT)
        light = render_clean(srgb, colour.replace(clean_dtype=FLOAT32), origin).astype(np.float32, copy=False)
        if not plan.output.clean_normalised:
            dn = render_clean(srgb, colour, origin).astype(np.float64)
            rounded = np.rint(in_dn(light, levels_dn))
            wrong = rounded != dn
            towards = np.copysign(np.inf, (dn - rounded)[wrong]).astype(np.float32)
            light[wrong] = np.nextafter(light[wrong], towards)
        channels.append(light)
    return np.stack(channels, axis=-1)


def reference_pair(
    srgb: Srgb, plan: Plan, origin: tuple[int, int] = (0, 0), dark_pixels: DarkPixels | None = None
) -> Pair:
    """Simulate a pair with the NumPy reference: Algorithm 1, exposure of the scene, noise, rounding.

    Arguments, result and errors are those of `make_pair`. Noise is added to the clean frame before both are clipped,
    then rounded or normalised.
    """
    _check_image(srgb, plan, origin)
    sensor, output = plan.sensor, plan.output
    light, lost = expose(unprocess(dequantise(srgb, plan, origin), plan, origin), plan)
    factor = electrons.light_factor(plan, (light.shape[0], light.shape[1]), origin)
    light = light if factor is None else light * factor
    levels = sensor.black_level_dn, sensor.white_level_dn
    clean_dn = to_dn(light, *levels, plan.brightest, plan.darkest)
    light_dn = to_dn(light, *levels, plan.most_light, plan.darkest)
    noisy_dn = electrons.noisy(light_dn, plan, origin, dark_pixels)
    if plan.pins_saturated:
        noisy_dn = np.where(clean_dn >= plan.brightest_dn, plan.brightest_dn, noisy_dn)

    limits_dn, levels_dn = sensor.limits_dn, (sensor.black_level_dn, sensor.white_level_dn)
    averaged_dn = electrons.average(light_dn, plan, origin) if plan.averaged else clean_dn
    clean_limits_dn = limits_dn[0], limits_dn[1] if plan.averaged else sensor.white_level_dn
    clean = _frame_of(averaged_dn, clean_limits_dn, output.clean_normalised, levels_dn)
    noisy = _frame_of(noisy_dn, limits_dn, output.normalised, levels_dn)
    read_dn = noisy_dn if output.normalised else np.rint(noisy_dn)
    counts = Counts(
        clean_clipped_low=int((light < plan.darkest).sum()),
        clean_clipped_high=int((light > plan.brightest).sum()),
        noisy_clipped_low=int((read_dn < limits_dn[0]).sum()),
        noisy_clipped_high=int((read_dn > limits_dn[1]).sum()),
        saturated=int((clean == plan.saturated_value).sum()),
        zero_variance=int((electrons.noise_variance(light_dn, plan) == 0).sum()),
        light_clipped_high=lost,
        light_clipped_low=int((light < 0).sum()) if plan.source.is_linear else None,
    )
    if output.layout == PACKED:
        clean, noisy = pack(clean, sensor.pattern, origin), pack(noisy, sensor.pattern, origin)
    return Pair(clean, noisy, counts)


def expose(light: Float, plan: Plan) -> tuple[Float, int | None]:
    """Multiply light by the exposure of the scene, and count the sites that are clipped; None if no site can be.

    Light of a photograph is clipped at white first: once darkened, light above white would reappear. Light of a linear
    source is limited to `MOST_LIGHT` afterwards.
    """
    exposure = plan.scene.exposure
    if plan.source.is_linear:
        light = light * exposure
        return np.minimum(light, MOST_LIGHT), int((light > MOST_LIGHT).sum())
    return (light, None) if exposure == 1 else (np.minimum(light, 1) * exposure, int((light > 1).sum()))


def _frame_of(dn: Float, limits_dn: tuple[float, float], normalised: bool, levels_dn: tuple[int, int]) -> Frame:
    """Clip unrounded DN, then normalise or round them."""
    return normalise(dn, *limits_dn, levels_dn) if normalised else quantise(dn, *limits_dn)


_DTYPES = np.dtype(np.uint8), np.dtype(np.uint16)
"""Dtypes of images; comparing with a class takes six times as long as with a dtype."""
_LINEAR_DTYPES = (np.dtype(np.float32),)
"""Dtypes of linear sources."""


def _check_image(srgb: Srgb, plan: Plan, origin: tuple[int, int]) -> None:
    """Raise ValueError if an image has an unusable dtype or shape, or is not inside the frame of the lens shading."""
    if plan.motion is not None:
        raise ValueError(f"plan={plan}: is that of a frame of a burst, which `bursts` resamples; expected another plan")
    dtypes = _LINEAR_DTYPES if plan.source.is_linear else _DTYPES
    if srgb.dtype not in dtypes or srgb.ndim != 3 or srgb.shape[2] != 3:
        expected = " or ".join(map(str, dtypes))
        raise ValueError(f"srgb={srgb.dtype} {list(srgb.shape)}: unusable array; expected {expected} [H, W, 3]")
    if plan.output.layout == PACKED and (srgb.shape[0] % 2 or srgb.shape[1] % 2):
        raise ValueError(f"srgb={list(srgb.shape)}: odd side; expected even height and width for layout={PACKED}")
    if plan.physics is not None and "lens_shading" in plan.noise.effects:
        height, width = plan.physics.frame_size
        if origin[0] + srgb.shape[0] > height or origin[1] + srgb.shape[1] > width:
            raise ValueError(
                f"srgb={list(srgb.shape)}: exceeds the frame {[height, width]} of the lens shading at {list(origin)}; "
                "expected a part of the frame"
            )
