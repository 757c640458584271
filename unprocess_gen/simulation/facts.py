"""Records from which planning decides, next to a config: facts of pixels, raw files, dark frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from unprocess_gen.core.arrays import Raw
from unprocess_gen.simulation.plan import CameraPlan, IspPlan, SensorPlan, SourcePlan
from unprocess_gen.simulation.profiles import UNCONVERTED, Profile


class DarkPixels(Protocol):
    """Access to the pixels of dark frames."""

    def frame(self, sha256: str) -> Raw:
        """Mosaic of the dark frame whose file has this SHA-256, [H, W] with even sides."""


@dataclass(frozen=True, slots=True)
class DarkFrame:
    """Dark frame of a camera: SHA-256 of its file, and even height and width in pixels."""

    sha256: str
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class DarkFrames:
    """Dark frames from which a run samples noise, in the order of their SHA-256.

    ``sha256`` identifies the set. ``black_dn`` is in DN of the frames, ``scale`` converts them to DN of the sensor, and
    ``variance_dn2`` is the variance of their noise with dither, DN² of the sensor.
    """

    frames: tuple[DarkFrame, ...]
    sha256: str
    black_dn: float
    scale: float
    variance_dn2: float


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts about an image's pixels that a plan may depend on, identical on every machine.

    ``dark_code`` and ``bright_code`` are the lowest and highest code in any channel, of ``codes`` possible codes; of a
    linear source they are light, and ``codes`` is 0. ``frames`` is the number of frames in the clip, 1 for a
    photograph. ``raw`` is what the file of a raw source states, ``source`` what that of a linear source does, and
    ``profile`` has the colours of a photograph.
    """

    width: int
    height: int
    codes: int
    dark_code: float
    bright_code: float
    frames: int = 1
    raw: RawParts | None = None
    source: SourcePlan | None = None
    profile: Profile = UNCONVERTED


class RawParts(NamedTuple):
    """Parts of a plan that the file of a raw source gives.

    Pictures are drawn with ``camera`` and ``isp``; frames do not depend on them. ``noise`` is S and O of the variance
    S·x + O of the source, with x = 0 at black and 1 at white; None if it is not known.
    """

    source: SourcePlan
    camera: CameraPlan
    isp: IspPlan
    sensor: SensorPlan
    noise: tuple[float, float] | None = None
