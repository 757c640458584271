"""Draw the motion of the frames of a burst: a rotation about the centre of the target, and a translation."""

from __future__ import annotations

from unprocess_gen.config.interpretation import RADIANS_PER_DEGREE, BurstRule
from unprocess_gen.core.random_streams import MOTION, frame_word, purpose
from unprocess_gen.simulation.frames import Patch
from unprocess_gen.simulation.kernels.draws import draws
from unprocess_gen.simulation.plan import Motion

NUMBERS_OF_PATCH = 2**12
"""Levels, and draws, that a word of the random counter numbers: motion numbers patches by both."""


def still(rule: BurstRule) -> Motion:
    """Motion of the first frame of a burst."""
    return Motion(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, rule.downscale, rule.phase)


def draw_motion(rule: BurstRule, stream_key: int, patch: Patch, frame: int, epoch: int = 0) -> Motion:
    """Draw the motion of a frame; frame 0 has none, and no draw depends on how many frames or patches there are."""
    if frame == 0:
        return still(rule)
    words = purpose(MOTION, *divmod(patch.patch, NUMBERS_OF_PATCH)), frame_word(frame, epoch)
    down, right, turn = (2 * uniform - 1 for uniform in draws(stream_key, 3, *words)[1].tolist())
    cosine, sine = cosine_and_sine(RADIANS_PER_DEGREE * (rule.rotation_deg * turn))
    y, x = ((side * rule.downscale - 1) / 2 for side in (patch.height, patch.width))
    return Motion(
        *(cosine, sine, y - (cosine * y + sine * x) + rule.shift * down),
        *(-sine, cosine, x - (cosine * x - sine * y) + rule.shift * right),
        *(rule.downscale, rule.phase),
    )


def cosine_and_sine(angle: float) -> tuple[float, float]:
    """Compute both by power series, for angles up to 45 degrees: libm's last bit differs between machines."""
    cosine, sine, term = 1.0, 0.0, 1.0
    for n in range(1, 20, 2):
        term *= angle / n
        sine += term
        term *= -angle / (n + 1)
        cosine += term
    return cosine, sine
