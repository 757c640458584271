"""Reference for the effects of the sensor (NumPy, float64), in the order in which light meets them.

A physical profile uses electrons up to the system gain K and DN after it; `EFFECTS` is the order. An effect that a plan
omits does not change the values of any other effect, because each effect has its own random stream. A profile with only
two numbers has one effect, ``heteroscedastic``: shot and read noise as a Gaussian whose variance is linear in the
signal (Foi et al. 2008; the article, section 2), or in Poisson form (CRVD, Yue et al. 2020).

Each value is computed from one random word by inverting a distribution function, so values do not depend on the order
or the tiles. Fixed patterns are keyed by the camera body and are constant over frames.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.core.lookup_tables import SEGMENTS, exponential_levels, normal_table, quantile_table
from unprocess_gen.core.random_streams import Words, words
from unprocess_gen.core.types import DarkPixels, Float, Physics, Plan
from unprocess_gen.simulation.reference.poisson import poisson

EFFECTS = (
    *("lens_shading", "prnu", "shot", "dark_current", "hot_pixels", "full_well"),  # in electrons
    *("gain_by_colour", "read", "row", "column", "column_temporal", "black_error", "dead_pixels", "quantise"),  # in DN
)
"""Effects of a physical profile, in the order in which light meets them."""

REPLACED = ("dark_current", "hot_pixels", "row", "column", "column_temporal", "black_error")
"""Effects whose noise a dark frame contains; it takes the place of ``read`` as the effect ``dark_frame``."""

Origin = tuple[int, int]
Shape = tuple[int, ...]


def by_inverse_cdf(uniforms: Words, table: Float) -> Float:
    """Convert random words to deviates of a symmetric distribution by inverse CDF.

    The top bit of a word is the sign, the other 31 bits are an index i; the tail probability is (i + ½) / 2**32. The
    float64 bits of j = 2i + 1 contain octave, segment and position in the segment, which saves a logarithm.

    Parameters
    ----------
    uniforms : ndarray of uint32
        Random words, any shape.
    table : ndarray of float64, [1024, 3]
        Quadratics of the quantile function (`lookup_tables.normal_table`).

    Returns
    -------
    ndarray of float64
        Deviates, same shape.
    """
    j = ((uniforms & np.uint32(0x7FFFFFFF)).astype(np.uint64) << np.uint64(1) | np.uint64(1)).astype(np.float64)
    mantissa, exponent = np.frexp(j)
    position = (2 * mantissa - 1) * SEGMENTS
    segment = np.floor(position)
    row = table[((exponent - 1) * SEGMENTS + segment.astype(np.int32))]
    t = (position - segment) / SEGMENTS
    z = row[..., 0] + t * (row[..., 1] + t * row[..., 2])
    return np.asarray(np.where(uniforms >> np.uint32(31), -z, z))


def normals(uniforms: Words) -> Float:
    """Convert random words to standard normal deviates by inverse CDF.

    Parameters
    ----------
    uniforms : ndarray of uint32
        Random words, any shape.

    Returns
    -------
    ndarray of float64
        Deviates, same shape; at most 6.34 in magnitude, error below 1.5e-7.
    """
    return by_inverse_cdf(uniforms, normal_table())


def noisy(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), dark_pixels: DarkPixels | None = None) -> Float:
    """Add the plan's effects to the unrounded clean frame.

    Parameters
    ----------
    clean_dn : ndarray of float64, [H, W]
        Clean frame, DN.
    plan : Plan
        Parameters of the pair.
    origin : (int, int)
        Row and column of ``clean_dn[0, 0]`` in the full frame.

    Returns
    -------
    ndarray of float64, [H, W]
        Noisy frame, DN, not clipped.
    """
    if plan.physics is not None:
        return physical(clean_dn, plan, origin, dark_pixels)
    return heteroscedastic(clean_dn, plan, origin) if "heteroscedastic" in plan.effects else clean_dn


def noise_variance(clean_dn: Float, plan: Plan) -> Float:
    """Return the variance of shot and read noise, max(0, a·(x - black) + b).

    Parameters
    ----------
    clean_dn : ndarray of float64, [H, W]
        Unrounded clean frame x, DN.
    plan : Plan
        Parameters of the pair.

    Returns
    -------
    ndarray of float64, [H, W]
        Variance, DN².
    """
    a_dn, b_dn2 = plan.variance_line
    return np.asarray(np.maximum(a_dn * (clean_dn - plan.black_level_dn) + b_dn2, 0))


def heteroscedastic(clean_dn: Float, plan: Plan, origin: Origin = (0, 0)) -> Float:
    """Add shot and read noise of a two-parameter profile.

    For ``noise_law="gaussian"``, the noise is one normal deviate of variance `noise_variance`. For ``"poisson"``, it is
    a times a Poisson count of mean (x - black) / a, plus a normal deviate of variance b.

    Parameters
    ----------
    clean_dn : ndarray of float64, [H, W]
        Unrounded clean frame x, DN.
    plan : Plan
        Parameters of the pair.
    origin : (int, int)
        Row and column of ``clean_dn[0, 0]`` in the full frame.

    Returns
    -------
    ndarray of float64, [H, W]
        Noisy frame, DN, not clipped.
    """
    n = normals(_words(plan, "heteroscedastic", clean_dn, origin))
    if plan.noise_law == "gaussian" or plan.a_dn == 0:  # a = 0: no shot noise
        return clean_dn + np.sqrt(noise_variance(clean_dn, plan)) * n
    electrons = (clean_dn - plan.black_level_dn) / plan.a_dn
    count = poisson(_words(plan, "shot", clean_dn, origin), electrons)
    return np.asarray((count * plan.a_dn + plan.black_level_dn) + np.sqrt(plan.b_dn2) * n)


def _image_words(plan: Plan, stream: str, shape: tuple[int, int], origin: Origin) -> Words:
    """Return the random words of the plan's frame, level and draw, [H, W]."""
    at = {"frame": plan.frame, "level": plan.level, "draw": plan.draw}
    return words(plan.stream_key, stream, shape, origin=origin, **at)


def _words(plan: Plan, stream: str, like: Float, origin: Origin) -> Words:
    """Return random words as `_image_words` in the shape of ``like``."""
    return _image_words(plan, stream, (like.shape[0], like.shape[1]), origin)


def _body_words(physics: Physics, stream: str, shape: Shape, origin: Origin, draw: int = 0) -> Words:
    """Return the random words of a fixed pattern of the camera body, [H, W]."""
    return words(physics.body_key, stream, (shape[0], shape[1]), origin=origin, draw=draw)


# --------------------------------------------------------------------------------------------- physical effects


def physical(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), dark_pixels: DarkPixels | None = None) -> Float:
    """Add the effects of a physical profile, in order, to the unrounded clean frame; [H, W] DN, not clipped."""
    physics = plan.physics
    assert physics is not None
    relative = relative_gains(plan, clean_dn.shape, origin)
    gain = physics.dn_per_e * relative
    electrons = (clean_dn - plan.black_level_dn) / gain
    if "prnu" in plan.effects and not physics.fixed_pattern_in_clean:  # otherwise the clean frame contains it
        electrons = electrons * response(physics, electrons.shape, origin)
    if "shot" in plan.effects:
        electrons = poisson(_words(plan, "shot", electrons, origin), electrons)
    if "dark_current" in plan.effects:
        electrons = electrons + dark_current(plan, electrons, origin)
    if "hot_pixels" in plan.effects:
        electrons = electrons + hot_pixels(plan, electrons, origin)
    if "full_well" in plan.effects:
        electrons = np.minimum(electrons, physics.full_well_e / relative)
    noisy_dn = electrons * gain + plan.black_level_dn
    if "read" in plan.effects:
        noisy_dn = noisy_dn + read(plan, noisy_dn, origin)
    if plan.dark_frame:
        noisy_dn = noisy_dn + dark_dither(plan, noisy_dn, origin)
    noisy_dn = noisy_dn + offsets(plan, noisy_dn.shape, origin)
    if plan.dark_frame:
        noisy_dn = noisy_dn + dark_frame_offsets(plan, dark_pixels, noisy_dn.shape, origin)
    if "dead_pixels" in plan.effects:
        noisy_dn = np.where(dead(physics, noisy_dn.shape, origin), 0.0, noisy_dn)
    return noisy_dn


def relative_gains(plan: Plan, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return the system gain of each CFA site relative to ``dn_per_e``, [H, W]; 1 without ``gain_by_colour``."""
    assert plan.physics is not None
    if "gain_by_colour" not in plan.effects:
        return np.ones(shape)
    sites = [plan.physics.gain_by_colour["RGB".index(colour)] for colour in plan.pattern]
    return _by_site(sites, shape, origin)


def _by_site(sites: Sequence[float], shape: Shape, origin: Origin) -> Float:
    """Repeat the values of the sites (0, 0), (0, 1), (1, 0), (1, 1) of the 2x2 tile, [H, W]."""
    tile = np.array(sites).reshape(2, 2)
    y, x = (np.arange(start, start + count) % 2 for start, count in zip(origin, shape, strict=True))
    return np.asarray(tile[y[:, None], x[None, :]])


def illumination_at(square: Float, coefficients: tuple[float, float, float]) -> Float:
    """Return the relative illumination at a squared distance from the centre, in units of the corner's.

    A polynomial in r², as in the opcode FixVignetteRadial of DNG 1.4 and in Lensfun's model "pa"; those correct the
    shading or describe it with the centre at 1.

    Parameters
    ----------
    square : ndarray of float64
        r², 0 in the centre and 1 in the corners.
    coefficients : tuple of three floats
        Coefficients of r², r⁴ and r⁶.

    Returns
    -------
    ndarray of float64
        1 in the centre, same shape.
    """
    first, second, third = coefficients
    return 1 + square * (first + square * (second + square * third))


def illumination(plan: Plan, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return the relative illumination of each pixel (lens shading).

    Parameters
    ----------
    plan : Plan
        Parameters of a pair with a physical profile.
    shape : (int, int)
        Height and width.
    origin : (int, int)
        Row and column of the first pixel in the full frame.

    Returns
    -------
    ndarray of float64, [H, W]
        At most 1; rounded to float32, the dtype in which kernels store the pattern. Ones without ``lens_shading``.
    """
    physics = plan.physics
    if physics is None or "lens_shading" not in plan.effects:
        return np.ones(shape)
    return illumination_of_lens(physics.lens_shading, physics.frame_size, shape, origin).astype(np.float64)


def illumination_of_lens(
    coefficients: tuple[float, float, float], frame_size: Shape, shape: Shape, origin: Origin = (0, 0)
) -> NDArray[np.float32]:
    """Return `illumination` of a lens with these coefficients, in a frame of ``frame_size``, as float32.

    Parameters
    ----------
    coefficients : tuple of three floats
        As in `illumination_at`.
    frame_size : (int, int)
        Height and width of the full frame.
    shape : (int, int)
        Height and width of the crop.
    origin : (int, int)
        Row and column of its first pixel in the full frame.

    Returns
    -------
    ndarray of float32, [H, W]
        At most 1.
    """
    # Twice the distance from the centre is an integer, so that its square is exact.
    rows, columns = (
        2 * (np.arange(start, start + count) - 0.0) - (full - 1)
        for start, count, full in zip(origin, shape, frame_size, strict=True)
    )
    corner = float(sum((full - 1) ** 2 for full in frame_size)) or 1.0
    square = (rows * rows)[:, None] + (columns * columns)[None, :]
    return np.asarray(illumination_at(square / corner, coefficients)).astype(np.float32)


def response(physics: Physics, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return the relative gain of each pixel (PRNU, EMVA 1288), a fixed pattern.

    Parameters
    ----------
    physics : Physics
        Numbers of the profile.
    shape : (int, int)
        Height and width.
    origin : (int, int)
        Row and column of the first pixel in the full frame.

    Returns
    -------
    ndarray of float64, [H, W]
        Gain with mean 1 and standard deviation ``prnu_std``, not negative; rounded to float32, the dtype in which
        kernels store the pattern for many frames.
    """
    n = normals(_body_words(physics, "prnu", shape, origin))
    return np.maximum(1 + physics.prnu_std * n, 0).astype(np.float32).astype(np.float64)


def dark_current(plan: Plan, like: Float, origin: Origin = (0, 0)) -> Float:
    """Draw the dark signal: Poisson counts of mean ``physics.dark_e``, [H, W] electrons in the shape of ``like``.

    The mean is subtracted, as cameras do with optical-black pixels, unless ``dark_offset="kept"``.
    """
    physics = plan.physics
    assert physics is not None
    count = poisson(_words(plan, "dark_current", like, origin), np.full(like.shape, physics.dark_e))
    return count - (physics.dark_e if physics.dark_offset == "removed" else 0.0)


def hot_pixels(plan: Plan, like: Float, origin: Origin = (0, 0)) -> Float:
    """Draw the excess of hot pixels, [H, W] electrons: Poisson counts of each hot pixel's mean, 0 elsewhere."""
    physics = plan.physics
    assert physics is not None
    mean_e = hot_pixel_means(physics, like.shape, origin)
    return poisson(_words(plan, "hot_pixels", like, origin), mean_e)


def hot_pixel_means(physics: Physics, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return the mean excess of each pixel, [H, W] electrons, a fixed pattern; 0 except for hot pixels.

    The excess of hot pixels is exponentially distributed with mean ``hot_pixel_e``, in 1024 equally likely steps.
    """
    hot = is_among(_body_words(physics, "hot_pixels", shape, origin), physics.hot_pixel_share)
    step = _body_words(physics, "hot_pixels", shape, origin, draw=1) >> np.uint32(22)
    return np.where(hot, physics.hot_pixel_e * exponential_levels()[step], 0.0)


def is_among(uniforms: Words, fraction: float) -> np.ndarray:
    """Return a mask of the random words that select a ``fraction`` of all pixels."""
    return np.asarray(uniforms < np.uint64(int(fraction * 2**32)))


def read(plan: Plan, like: Float, origin: Origin = (0, 0)) -> Float:
    """Draw the read noise, [H, W] DN: Gaussian or Tukey's lambda distribution, standard deviation ``read_std_dn``."""
    physics = plan.physics
    assert physics is not None
    return physics.read_std_dn * by_inverse_cdf(_words(plan, "read", like, origin), read_table(physics))


def read_table(physics: Physics) -> Float:
    """Return the quantile table of the read noise.

    Parameters
    ----------
    physics : Physics
        Numbers of the profile.

    Returns
    -------
    ndarray of float64, [1024, 3]
        Table for standard deviation 1, as `lookup_tables.normal_table`.
    """
    return quantile_table(physics.read_law, physics.read_shape)


DITHER_LAW, DITHER_SHAPE = "tukey_lambda", 1.0
"""Uniform distribution, as Tukey's lambda distribution of shape 1."""


def dither_std_dn(plan: Plan) -> float:
    """Return the standard deviation of the dither of a dark frame, DN: uniform in ±½ DN of the dark frame."""
    return plan.dark_scale / math.sqrt(12)


def dark_dither(plan: Plan, like: Float, origin: Origin = (0, 0)) -> Float:
    """Draw the dither of a dark frame, [H, W] DN.

    A dark frame has integer values. Without dither, the sum of a constant signal and the frame is rounded at every site
    alike, so fractions of a DN are lost from the mean (as SFRN, Zhang et al. 2021, which samples within the bins too).
    """
    uniform = by_inverse_cdf(_words(plan, "dark_dither", like, origin), quantile_table(DITHER_LAW, DITHER_SHAPE))
    return dither_std_dn(plan) * uniform


def dark_frame_offsets(
    plan: Plan,
    dark_pixels: DarkPixels | None,
    shape: Shape,
    origin: Origin = (0, 0),
    out: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return what a plan's dark frame adds to each pixel.

    Frames smaller than the image are repeated: rows and columns count modulo the size of the frame, which is even.

    Parameters
    ----------
    plan : Plan
        Parameters of a pair with a dark frame.
    dark_pixels : DarkPixels or None
        Access to the pixels of the frame.
    shape : (int, int)
        Height and width.
    origin : (int, int)
        Row and column of the first pixel in the full frame.
    out : ndarray of float32, [H, W], optional
        Where the result is written.

    Returns
    -------
    ndarray of float32, [H, W]
        (frame - black level - dark-shading map) · scale, in DN of the sensor; without a map if the plan names none.

    Raises
    ------
    ValueError
        If ``dark_pixels`` is None.
    """
    if dark_pixels is None:
        raise ValueError(f"dark_pixels=None: the plan needs the dark frame {plan.dark_frame}; expected access to it")
    out = np.empty((shape[0], shape[1]), dtype=np.float32) if out is None else out
    frame, black, scale = (
        dark_pixels.frame(plan.dark_frame),
        np.float32(plan.dark_black_dn),
        np.float32(plan.dark_scale),
    )
    shading = dark_pixels.shading(plan.dark_shading) if plan.dark_shading else None
    for y, from_y, rows in _runs(origin[0] + plan.dark_shift[0], shape[0], frame.shape[0]):
        for x, from_x, columns in _runs(origin[1] + plan.dark_shift[1], shape[1], frame.shape[1]):
            part, source = out[y : y + rows, x : x + columns], np.s_[from_y : from_y + rows, from_x : from_x + columns]
            np.subtract(frame[source], black if shading is None else shading[source], out=part, dtype=np.float32)
            if shading is not None and black != 0:
                part -= black
            if scale != 1:
                part *= scale
    return out


def _runs(start: int, count: int, period: int) -> Iterator[tuple[int, int, int]]:
    """Yield runs of a periodic sequence: first index in the result, first index in the period, and length."""
    done = 0
    while done < count:
        place = (start + done) % period
        length = min(period - place, count - done)
        yield done, place, length
        done += length


def offsets(plan: Plan, shape: Shape, origin: Origin = (0, 0), fixed_only: bool = False) -> Float:
    """Return the sum of row, column and black-level offsets, [H, W] DN; ``fixed_only`` omits the row offsets."""
    assert plan.physics is not None
    height, width = shape
    rows, columns = np.zeros(height), np.zeros(width)
    if "row" in plan.effects and not fixed_only:
        rows = row(plan, height, origin[0])
    if "column" in plan.effects:
        columns = column(plan.physics, width, origin[1])
    if "column_temporal" in plan.effects and not fixed_only:
        columns = columns + column_temporal(plan, width, origin[1])
    offset_dn = rows[:, None] + columns[None, :]
    return offset_dn + black_error(plan.physics, shape, origin) if "black_error" in plan.effects else offset_dn


def row(plan: Plan, height: int, top: int = 0) -> Float:
    """Draw the offset of each row (banding), [H] DN; different in every frame.

    With a correlation r, z(y) = r·z(y - 1) + √(1 - r²)·n(y) for normal deviates n, an autoregressive process of order 1
    (Box and Jenkins 1970) with the standard deviation of n. It begins at row 0 of the full frame, so that a crop has
    the offsets of its rows.
    """
    physics = plan.physics
    assert physics is not None
    if physics.row_correlation == 0:
        return np.asarray(physics.row_std_dn * normals(_image_words(plan, "row", (height, 1), (top, 0)))[:, 0])
    independent = normals(_image_words(plan, "row", (top + height, 1), (0, 0)))[:, 0].tolist()
    before, share = physics.row_correlation, math.sqrt(1 - physics.row_correlation * physics.row_correlation)
    correlated = itertools.accumulate(independent, lambda last, n: before * last + share * n)
    return physics.row_std_dn * np.array(list(correlated)[top:])


def column(physics: Physics, width: int, left: int = 0) -> Float:
    """Return the offset of each column's amplifier, [W] DN: a fixed pattern."""
    return np.asarray(physics.column_std_dn * normals(_body_words(physics, "column", (1, width), (0, left)))[0])


def column_temporal(plan: Plan, width: int, left: int = 0) -> Float:
    """Draw the part of each column's offset that is new in every frame, [W] DN."""
    assert plan.physics is not None
    std_dn = plan.physics.column_temporal_std_dn
    return np.asarray(std_dn * normals(_image_words(plan, "column_temporal", (1, width), (0, left)))[0])


def black_error(physics: Physics, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return the black-level error of each CFA site, [H, W] DN."""
    return _by_site(physics.black_error_dn, shape, origin)


def dead(physics: Physics, shape: Shape, origin: Origin = (0, 0)) -> np.ndarray:
    """Return the mask of dead pixels, which read 0, [H, W] bool: a fixed pattern."""
    return is_among(_body_words(physics, "dead_pixels", shape, origin), physics.dead_pixel_share)


# ----------------------------------------------------------------- fixed patterns in the average of many frames


def light_factor(plan: Plan, shape: Shape, origin: Origin = (0, 0)) -> Float | None:
    """Return by what the light of the clean frame is multiplied: lens shading, and PRNU if the clean frame has it.

    Parameters
    ----------
    plan : Plan
        Parameters of a pair.
    shape : (int, int)
        Height and width.
    origin : (int, int)
        Row and column of the first pixel in the full frame.

    Returns
    -------
    ndarray of float64, [H, W], or None
        Values of float32; None if nothing changes the light.
    """
    shaded = "lens_shading" in plan.effects and plan.physics is not None
    if not plan.averaged or "prnu" not in plan.effects:
        return illumination(plan, shape, origin) if shaded else None
    assert plan.physics is not None
    pattern = response(plan.physics, shape, origin)
    return (pattern * illumination(plan, shape, origin)).astype(np.float32).astype(np.float64) if shaded else pattern


def average(clean_dn: Float, plan: Plan, origin: Origin = (0, 0)) -> Float:
    """Add fixed patterns except PRNU, and a kept dark offset, to the unrounded clean frame; [H, W] DN, not clipped.

    The sum of light, dark signal and hot pixels is limited by the full well, as in each frame of a real average.
    """
    physics = plan.physics
    assert physics is not None
    gain = physics.dn_per_e * relative_gains(plan, clean_dn.shape, origin)
    if "hot_pixels" in plan.effects:
        clean_dn = clean_dn + hot_pixel_means(physics, clean_dn.shape, origin) * gain
    if "dark_current" in plan.effects and physics.dark_offset == "kept":
        clean_dn = clean_dn + physics.dark_e * gain
    if "full_well" in plan.effects:
        clean_dn = np.minimum(clean_dn, physics.full_well_e * physics.dn_per_e + plan.black_level_dn)
    clean_dn = clean_dn + offsets(plan, clean_dn.shape, origin, fixed_only=True)
    if "dead_pixels" in plan.effects:
        clean_dn = np.where(dead(physics, clean_dn.shape, origin), 0.0, clean_dn)
    return clean_dn
