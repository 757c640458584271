"""What a sensor adds to the clean frame, as reference forms: NumPy, float64, in the order light meets them.

A physical profile speaks in electrons up to the system gain K, in DN after it; `EFFECTS` is the order, and what is not
among a plan's effects is passed over without moving a value of any other, since each has a stream of its own. A profile
that has only two numbers offers one effect, ``heteroscedastic``: shot and read noise as one Gaussian whose variance is
a line in the signal (Foi et al. 2008; the article, section 2), or as its Poisson form (CRVD, Yue et al. 2020).

All values come from counted uniforms by inversion of a distribution function: one uniform, one value, in any order and
by any tile. Fixed patterns are keyed by the camera body: they stay put from frame to frame.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from unprocess_gen.core.lookup_tables import SEGMENTS, exponential_levels, normal_table, tukey_table
from unprocess_gen.core.random_streams import Words, words
from unprocess_gen.core.types import Float, Physics, Plan
from unprocess_gen.simulation.reference.poisson import poisson

EFFECTS = (
    *("prnu", "shot", "dark_current", "hot_pixels", "full_well"),  # in electrons
    *("read", "row", "column", "black_error", "dead_pixels", "quantise"),  # in DN
)
"""The effects of a physical profile, in the order light meets them."""

Origin = tuple[int, int]
Shape = tuple[int, ...]


def by_inverse_cdf(uniforms: Words, table: Float) -> Float:
    """Map uint32 words to a symmetric law whose quadratics are in ``table`` (`tables.normal_table`), same shape.

    The top bit is the sign, the other 31 an index i; the tail probability is (i + ½) / 2**32. The bits of j = 2i + 1 as
    a double are octave, segment and position in the segment, which spares a logarithm.
    """
    j = ((uniforms & np.uint32(0x7FFFFFFF)).astype(np.uint64) << np.uint64(1) | np.uint64(1)).astype(np.float64)
    mantissa, exponent = np.frexp(j)
    position = (2 * mantissa - 1) * SEGMENTS
    segment = np.floor(position)
    row = table[((exponent - 1) * SEGMENTS + segment.astype(np.int32))]
    t = (position - segment) / SEGMENTS
    z = row[..., 0] + t * (row[..., 1] + t * row[..., 2])
    return np.asarray(np.where(uniforms >> np.uint32(31), -z, z))


class Draws(NamedTuple):
    """How words are drawn, and made values of a symmetric law and Poisson counts; arguments as in `READABLE_DRAWS`."""

    words: Callable[..., Words]
    by_inverse_cdf: Callable[[Words, Float], Float]
    poisson: Callable[[Words, Float], Float]


READABLE_DRAWS = Draws(words, by_inverse_cdf, poisson)
"""The readable draws. Compiled ones (`floats`) give the same values, to the bit."""


def normals(uniforms: Words, draws: Draws = READABLE_DRAWS) -> Float:
    """Map uint32 words to standard normals by inverse CDF, same shape, float64, |z| up to 6.34; error below 1.5e-7."""
    return draws.by_inverse_cdf(uniforms, normal_table())


def noisy(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return what the sensor reads of the unrounded clean frame, ``[H, W]`` DN, not clipped."""
    if plan.physics is not None:
        return physical(clean_dn, plan, origin, draws)
    return heteroscedastic(clean_dn, plan, origin, draws) if "heteroscedastic" in plan.effects else clean_dn


def noise_variance(clean_dn: Float, plan: Plan) -> Float:
    """Return max(0, a·(x - black) + b) in DN², ``[H, W]``, of the unrounded clean frame x: shot and read noise."""
    a_dn, b_dn2 = plan.variance_line
    return np.asarray(np.maximum(a_dn * (clean_dn - plan.black_level_dn) + b_dn2, 0))


def heteroscedastic(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Add noise of `noise_variance` to the unrounded clean frame, ``[H, W]`` DN, not clipped.

    ``noise_law=gaussian``: one normal of that variance. ``poisson``: a times a Poisson count of mean (x - black) / a,
    and a normal of variance b.
    """
    n = normals(_words(plan, "heteroscedastic", clean_dn, origin, draws), draws)
    if plan.noise_law == "gaussian" or plan.a_dn == 0:  # a of 0: no shot noise, in either form
        return clean_dn + np.sqrt(noise_variance(clean_dn, plan)) * n
    electrons = (clean_dn - plan.black_level_dn) / plan.a_dn
    count = draws.poisson(_words(plan, "shot", clean_dn, origin, draws), electrons)
    return np.asarray((count * plan.a_dn + plan.black_level_dn) + np.sqrt(plan.b_dn2) * n)


def _image_words(
    plan: Plan, stream: str, shape: tuple[int, int], origin: Origin, draws: Draws = READABLE_DRAWS
) -> Words:
    at = {"frame": plan.frame, "level": plan.level, "draw": plan.draw}
    return draws.words(plan.stream_key, stream, shape, origin=origin, **at)


def _words(plan: Plan, stream: str, like: Float, origin: Origin, draws: Draws) -> Words:
    return _image_words(plan, stream, (like.shape[0], like.shape[1]), origin, draws)


def _body_words(
    physics: Physics, stream: str, shape: Shape, origin: Origin, draws: Draws = READABLE_DRAWS, draw: int = 0
) -> Words:
    return draws.words(physics.body_key, stream, (shape[0], shape[1]), origin=origin, draw=draw)


# --------------------------------------------------------------------------------------------- the physical effects


def physical(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return what the sensor reads of the unrounded clean frame, ``[H, W]`` DN, not clipped: the effects in order."""
    physics = plan.physics
    assert physics is not None
    electrons = (clean_dn - plan.black_level_dn) / physics.dn_per_e
    if "prnu" in plan.effects and not physics.fixed_pattern_in_clean:  # else the clean frame has it already
        electrons = electrons * response(physics, electrons.shape, origin, draws)
    if "shot" in plan.effects:
        electrons = draws.poisson(_words(plan, "shot", electrons, origin, draws), electrons)
    if "dark_current" in plan.effects:
        electrons = electrons + dark_current(plan, electrons, origin, draws)
    if "hot_pixels" in plan.effects:
        electrons = electrons + hot_pixels(plan, electrons, origin, draws)
    if "full_well" in plan.effects:
        electrons = np.minimum(electrons, physics.full_well_e)
    noisy_dn = electrons * physics.dn_per_e + plan.black_level_dn
    if "read" in plan.effects:
        noisy_dn = noisy_dn + read(plan, noisy_dn, origin, draws)
    noisy_dn = noisy_dn + offsets(plan, noisy_dn.shape, origin)
    if "dead_pixels" in plan.effects:
        noisy_dn = np.where(dead(physics, noisy_dn.shape, origin, draws), 0.0, noisy_dn)
    return noisy_dn


def response(physics: Physics, shape: Shape, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return each pixel's response, ``[H, W]``: mean 1, standard deviation ``prnu_std``, never negative (EMVA 1288).

    A pattern of the body. Kept as float32, so that one that is stored for many frames is the one that is computed.
    """
    n = normals(_body_words(physics, "prnu", shape, origin, draws), draws)
    return np.maximum(1 + physics.prnu_std * n, 0).astype(np.float32).astype(np.float64)


def dark_current(plan: Plan, like: Float, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return the electrons that heat sets free during the exposure, ``[H, W]``: Poisson of mean ``dark_e``.

    Optical black pixels have it too, so a camera takes its mean away, unless ``dark_offset`` is ``kept``.
    """
    physics = plan.physics
    assert physics is not None
    count = draws.poisson(_words(plan, "dark_current", like, origin, draws), np.full(like.shape, physics.dark_e))
    return count - (physics.dark_e if physics.dark_offset == "removed" else 0.0)


def hot_pixels(plan: Plan, like: Float, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return the excess electrons of hot pixels, ``[H, W]``, 0 elsewhere: Poisson of each hot pixel's own mean."""
    physics = plan.physics
    assert physics is not None
    mean_e = hot_pixel_means(physics, like.shape, origin, draws)
    return draws.poisson(_words(plan, "hot_pixels", like, origin, draws), mean_e)


def hot_pixel_means(physics: Physics, shape: Shape, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return the mean excess of each pixel in electrons, ``[H, W]``: a pattern of the body, 0 for all but a share.

    That of hot pixels is exponentially distributed about ``hot_pixel_e``, in 1024 equally likely steps.
    """
    hot = is_among(_body_words(physics, "hot_pixels", shape, origin, draws), physics.hot_pixel_share)
    step = _body_words(physics, "hot_pixels", shape, origin, draws, draw=1) >> np.uint32(22)
    return np.where(hot, physics.hot_pixel_e * exponential_levels()[step], 0.0)


def is_among(uniforms: Words, share: float) -> np.ndarray:
    """Return which of uint32 words belong to a share of all."""
    return np.asarray(uniforms < np.uint64(int(share * 2**32)))


def read(plan: Plan, like: Float, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Return the read noise, ``[H, W]`` DN of deviation ``read_std_dn``: Gaussian, or Tukey's lambda law."""
    physics = plan.physics
    assert physics is not None
    return physics.read_std_dn * draws.by_inverse_cdf(_words(plan, "read", like, origin, draws), read_table(physics))


def read_table(physics: Physics) -> Float:
    """Return the quantiles of the read noise's law, at deviation 1."""
    return normal_table() if physics.read_law == "gaussian" else tukey_table(physics.read_shape)


def offsets(plan: Plan, shape: Shape, origin: Origin = (0, 0), fixed_alone: bool = False) -> Float:
    """Return what is added to whole rows, columns and planes, ``[H, W]`` DN; without the rows' where fixed alone."""
    assert plan.physics is not None
    height, width = shape
    rows, columns = np.zeros(height), np.zeros(width)
    if "row" in plan.effects and not fixed_alone:
        rows = row(plan, height, origin[0])
    if "column" in plan.effects:
        columns = column(plan.physics, width, origin[1])
    offset_dn = rows[:, None] + columns[None, :]
    return offset_dn + black_error(plan.physics, shape, origin) if "black_error" in plan.effects else offset_dn


def row(plan: Plan, height: int, top: int = 0) -> Float:
    """Return the offset of each row, ``[H]`` DN: drawn anew for every frame (banding)."""
    assert plan.physics is not None
    return np.asarray(plan.physics.row_std_dn * normals(_image_words(plan, "row", (height, 1), (top, 0)))[:, 0])


def column(physics: Physics, width: int, left: int = 0) -> Float:
    """Return the offset of each column, ``[W]`` DN: a pattern of the body, from the columns' own amplifiers."""
    return np.asarray(physics.column_std_dn * normals(_body_words(physics, "column", (1, width), (0, left)))[0])


def black_error(physics: Physics, shape: Shape, origin: Origin = (0, 0)) -> Float:
    """Return by how much the mean black differs from the black level, ``[H, W]`` DN, by the site in the 2x2 pattern."""
    errors = np.array(physics.black_error_dn).reshape(2, 2)
    y, x = (np.arange(start, start + count) % 2 for start, count in zip(origin, shape, strict=True))
    return np.asarray(errors[y[:, None], x[None, :]])


def dead(physics: Physics, shape: Shape, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> np.ndarray:
    """Return which pixels are dead and read 0, ``[H, W]`` bool: a pattern of the body."""
    return is_among(_body_words(physics, "dead_pixels", shape, origin, draws), physics.dead_pixel_share)


# ------------------------------------------------------------------- what an average of many frames keeps of a body


def respond(light: Float, plan: Plan, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Multiply light by the pixels' responses, where they are simulated, ``[H, W]``."""
    assert plan.physics is not None
    return light * response(plan.physics, light.shape, origin, draws) if "prnu" in plan.effects else light


def average(clean_dn: Float, plan: Plan, origin: Origin = (0, 0), draws: Draws = READABLE_DRAWS) -> Float:
    """Add the other fixed patterns, and a dark offset that is kept, to the unrounded clean frame, ``[H, W]`` DN.

    Not clipped. What light, heat and hot pixels set free ends at the full well, as in every frame that is averaged.
    """
    physics = plan.physics
    assert physics is not None
    if "hot_pixels" in plan.effects:
        clean_dn = clean_dn + hot_pixel_means(physics, clean_dn.shape, origin, draws) * physics.dn_per_e
    if "dark_current" in plan.effects and physics.dark_offset == "kept":
        clean_dn = clean_dn + physics.dark_e * physics.dn_per_e
    if "full_well" in plan.effects:
        clean_dn = np.minimum(clean_dn, physics.full_well_e * physics.dn_per_e + plan.black_level_dn)
    clean_dn = clean_dn + offsets(plan, clean_dn.shape, origin, fixed_alone=True)
    if "dead_pixels" in plan.effects:
        clean_dn = np.where(dead(physics, clean_dn.shape, origin, draws), 0.0, clean_dn)
    return clean_dn
