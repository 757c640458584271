"""Develop frames to pictures in float32, then do what a camera does before it saves a picture.

Order: gains, demosaicking, matrix, gamma and tone curve, as `simulation.reference.isp`; noise reduction; JPEG. Noise is
reduced in luma and chroma of the displayed values, before they are rounded to codes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from unprocess_gen.config.distributions import DISTRIBUTIONS, Drawn, parse_distribution
from unprocess_gen.core.arrays import Frame, Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import Choice, Limit, Numbers, value_text
from unprocess_gen.core.random_streams import PARAMETERS, stream_key, words
from unprocess_gen.planning.parameters import draw_parameter
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp

SAMPLINGS = {
    name: int(getattr(cv2, f"IMWRITE_JPEG_SAMPLING_FACTOR_{name.replace(':', '')}"))
    for name in ("4:2:0", "4:2:2", "4:4:4")
}
"""Chroma sampling of JPEG files."""

LIMITS: dict[str, Limit] = {
    "demosaic": Choice(*isp.DEMOSAICS),
    "strength": Drawn(("uniform", "log_uniform", "choice"), Numbers(0, 100)),
    "chroma_nr": Numbers(0, 100),
    "luma_nr": Numbers(0, 255),
    "jpeg": Drawn(("uniform", "choice"), Numbers(1, 100)),
    "jpeg_sampling": Choice(*SAMPLINGS),
}
"""Allowed values of the options; ``jpeg`` may also be None."""


@dataclass(frozen=True, slots=True)
class IspOptions:
    """Options of `CameraNoise` that apply after the raw frame, as users give them; ConfigError if not allowed."""

    demosaic: str
    strength: Any
    chroma_nr: float
    luma_nr: float
    jpeg: Any
    jpeg_sampling: str

    def __post_init__(self) -> None:
        for name, limit in LIMITS.items():
            value = getattr(self, name)
            if isinstance(limit, Drawn) and (name, value) != ("jpeg", None):
                limit.parse(f"CameraNoise: {name}", value)
            elif not limit.allows(value):
                raise ConfigError(f"CameraNoise: {name}={value_text(value)}: not allowed; expected {limit}")
        if isinstance(self.jpeg, float):
            raise ConfigError(f"CameraNoise: jpeg={self.jpeg}: no integer; expected 1 to 100 or a distribution")

    def drawn(self, seed: int, index: int) -> dict[str, Any]:
        """Draw strength and JPEG quality, or None, of a picture; they depend only on seed and index."""
        values = {"strength": self.strength, "jpeg": self.jpeg}
        if any(isinstance(value, list | tuple) for value in values.values()):
            random = words(stream_key(seed, f"CameraNoise {index}"), PARAMETERS, (1, 2))[0]
            for (name, value), word in zip(values.items(), random.tolist(), strict=True):
                if value is not None:
                    distribution = parse_distribution(name, value, tuple(DISTRIBUTIONS))
                    drawn = draw_parameter(distribution, (word + 0.5) / 2**32)
                    values[name] = round(drawn) if name == "jpeg" else drawn
        return values


def light_of(frame: Frame, plan: Plan) -> Any:
    """Light of a frame in float32, before the scene's darkening."""
    light: Any = frame.astype(np.float32)
    return isp.to_light(light, plan) if frame.dtype == np.uint16 else light * np.float32(plan.scene.exposure_ratio)


def light_limits(plan: Plan) -> tuple[float, float]:
    """Least and greatest light that the sensor records, before the scene's darkening."""
    limits_dn = plan.sensor.limits_dn
    low, high = isp.to_light(np.array(limits_dn), plan).tolist()
    return low, high


def with_strength(clean: Any, noisy: Any, strength: float, plan: Plan) -> Any:
    """Multiply the difference of noisy from clean light, and clip the result where the sensor clips."""
    return noisy if strength == 1 else np.clip(clean + strength * (noisy - clean), *light_limits(plan))


def render(light: Any, plan: Plan, options: IspOptions, codes: int) -> Srgb:
    """Develop a mosaic of light, float32 [H, W], to codes."""
    reduces = bool(options.chroma_nr or options.luma_nr)
    table = table_of_roots(plan.isp.tone, plan.isp.gamma, codes, not reduces)
    camera_rgb = isp.white_balanced(light, plan, method=options.demosaic)
    positions: Any = cv2.transform(camera_rgb, np.reshape(isp.cam2rgb(plan), (3, 3)).astype(np.float32))
    np.sqrt(np.clip(positions, 0, 1, out=positions), out=positions)
    positions *= np.float32(len(table) - 1)
    positions += np.float32(0.5)
    picture: Any = table.take(positions.astype(np.int32))
    return finish(picture, options, codes) if reduces else picture


ROOTS_PER_CODE = {256: 64, 65536: 4}
"""Entries for each code of the table from roots of light to codes."""


@functools.lru_cache(maxsize=8)
def table_of_roots(tone: str, gamma: float | str, codes: int, is_rounded: bool) -> Any:
    """Codes of the squares of equally spaced values from 0 to 1, in place of powers of each pixel."""
    light = np.linspace(0, 1, codes * ROOTS_PER_CODE[codes]) ** 2
    displayed = isp.TONES[tone](isp.compress_gamma(light, gamma))
    if not is_rounded:
        return np.asarray(displayed * (codes - 1), np.float32)
    return np.asarray(isp.to_codes(displayed, codes), dtype=np.uint8 if codes == 256 else np.uint16)


YCBCR = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])
"""Y, Cb and Cr of R, G and B, without offsets (ITU-T T.871)."""

LUMA_SIDE, LUMA_STD = 5, 1.5
"""Side and spatial standard deviation of the bilateral filter of luma, pixels."""


def finish(picture: Any, options: IspOptions, codes: int) -> Srgb:
    """Reduce the noise of unrounded codes, float32 [H, W, 3], in Y, Cb and Cr, and round them."""
    if options.chroma_nr or options.luma_nr:
        luma, *chroma = cv2.split(cv2.transform(picture, YCBCR))
        if options.chroma_nr:
            chroma = [cv2.GaussianBlur(plane, (0, 0), options.chroma_nr) for plane in chroma]
        if options.luma_nr:
            luma = cv2.bilateralFilter(luma, LUMA_SIDE, options.luma_nr * (codes - 1) / 255, LUMA_STD)
        picture = cv2.transform(cv2.merge((luma, *chroma)), np.linalg.inv(YCBCR))
    rounded: Srgb = np.rint(np.clip(picture, 0, codes - 1)).astype(np.uint8 if codes == 256 else np.uint16)
    return rounded


def compressed(picture: Srgb, quality: int, sampling: str) -> Srgb:
    """Compress a picture as JPEG, and decode it."""
    settings = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS[sampling])
    encoded = cv2.imencode(".jpg", picture[..., ::-1], settings)[1]
    decoded: Any = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1])
