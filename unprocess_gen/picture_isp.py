"""Develop frames to pictures in float32, then do what a camera does before it saves a picture.

Order: gains, demosaicking, matrix, gamma and tone curve, as `simulation.reference.isp`; noise reduction; JPEG. Noise is
reduced in luma and chroma of the displayed values, before they are rounded to codes.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from unprocess_gen.config.distributions import Drawn
from unprocess_gen.core.arrays import Float, Srgb
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.fields import Choice, Limit, Numbers, value_text
from unprocess_gen.core.random_streams import PARAMETERS, stream_key, words
from unprocess_gen.planning.parameters import draw_parameter
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.simulation.reference import isp

SAMPLINGS = {
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
}
"""Chroma sampling of JPEG files."""

STRENGTH = Drawn(("uniform", "log_uniform", "choice"), Numbers(0, 100))
QUALITY = Drawn(("uniform", "choice"), Numbers(1, 100))
"""Quality of JPEG; draws are rounded."""

LIMITS: dict[str, Limit] = {
    "demosaic": Choice(*isp.DEMOSAICS),
    "chroma_nr": Numbers(0, 100),
    "luma_nr": Numbers(0, 255),
    "jpeg_sampling": Choice(*SAMPLINGS),
}
"""Allowed values of the other options."""


@dataclass(frozen=True, slots=True)
class IspOptions:
    """Options of `CameraNoise` behind the raw frame, as users give them; ConfigError if one is not allowed."""

    demosaic: str
    strength: Any
    chroma_nr: float
    luma_nr: float
    jpeg: Any
    jpeg_sampling: str

    def __str__(self) -> str:
        return ", ".join(f"{name}={value_text(getattr(self, name))}" for name in self.__slots__)

    def __post_init__(self) -> None:
        for name, limit in LIMITS.items():
            value = getattr(self, name)
            if not limit.allows(value):
                raise ConfigError(f"CameraNoise: {name}={value_text(value)}: not allowed; expected {limit}")
        STRENGTH.parse("CameraNoise: strength", self.strength)
        if isinstance(self.jpeg, float):
            problem = "not allowed; expected an integer from 1 to 100, a distribution, or None"
            raise ConfigError(f"CameraNoise: jpeg={self.jpeg}: {problem}")
        if self.jpeg is not None:
            QUALITY.parse("CameraNoise: jpeg", self.jpeg)

    def without_reduction(self) -> IspOptions:
        """Options of pictures without noise."""
        return replace(self, chroma_nr=0, luma_nr=0)

    def drawn(self, seed: int, index: int) -> tuple[float, int | None]:
        """Strength, and quality of JPEG if there is one, of a picture: a pure function of seed and index."""
        uniforms = (words(stream_key(seed, f"CameraNoise {index}"), PARAMETERS, (1, 2))[0] + 0.5) / 2**32
        strength = draw_parameter(STRENGTH.parse("strength", self.strength), float(uniforms[0]))
        if self.jpeg is None:
            return strength, None
        return strength, round(draw_parameter(QUALITY.parse("jpeg", self.jpeg), float(uniforms[1])))


def render(camera_rgb: Float, plan: Plan, options: IspOptions, codes: int) -> Srgb:
    """Render white-balanced camera RGB to codes: matrix, gamma and tone curve, noise reduction."""
    reduces = bool(options.chroma_nr or options.luma_nr)
    table = table_of_roots(plan.isp.tone, plan.isp.gamma, codes, not reduces)
    positions: Any = cv2.transform(camera_rgb, cam2rgb(plan))
    np.sqrt(np.clip(positions, 0, 1, out=positions), out=positions)
    positions *= np.float32(len(table) - 1)
    positions += np.float32(0.5)
    picture: Any = table.take(positions.astype(np.int32))
    return to_picture(picture, options, codes) if reduces else picture


def cam2rgb(plan: Plan) -> Any:
    """Matrix from camera RGB to linear sRGB, float32."""
    return np.reshape(isp.cam2rgb(plan), (3, 3)).astype(np.float32)


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


def to_picture(picture: Any, options: IspOptions, codes: int) -> Srgb:
    """Reduce the noise of unrounded codes, float32 [H, W, 3], in Y, Cb and Cr and round them."""
    luma, *chroma = cv2.split(cv2.transform(picture, YCBCR))
    if options.chroma_nr:
        chroma = [cv2.GaussianBlur(plane, (0, 0), options.chroma_nr) for plane in chroma]
    if options.luma_nr:
        luma = cv2.bilateralFilter(luma, LUMA_SIDE, options.luma_nr * (codes - 1) / 255, LUMA_STD)
    reduced: Any = cv2.transform(cv2.merge((luma, *chroma)), np.linalg.inv(YCBCR))
    rounded: Srgb = np.rint(np.clip(reduced, 0, codes - 1)).astype(np.uint8 if codes == 256 else np.uint16)
    return rounded


def compressed(picture: Srgb, quality: int, sampling: str) -> Srgb:
    """Compress a picture as JPEG, and decode it."""
    settings = (cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS[sampling])
    encoded = cv2.imencode(".jpg", picture[..., ::-1], settings)[1]
    decoded: Any = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.ascontiguousarray(decoded[..., ::-1])
