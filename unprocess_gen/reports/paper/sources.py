"""Load the photographs of the paper figures, and count saturated sites before and after unprocessing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unprocess_gen.config.schema import Config, GainsConfig, NoiseConfig
from unprocess_gen.core.errors import ConfigError, SourceError
from unprocess_gen.core.types import Plan, Source, Srgb
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.pair import make_pair
from unprocess_gen.simulation.reference.cfa import mosaic
from unprocess_gen.sources.loader import load_source


class GainInterpretation(NamedTuple):
    """One interpretation of Figure 6: its description, and the gains (options of ``conf/gains``) of its two rows."""

    description: str
    top: str
    bottom: str


INTERPRETATIONS = (
    GainInterpretation("with the formula, which divides by g_rgb", "paper_min", "paper_max"),
    GainInterpretation("with the pictures, which multiply by it", "fig6_top", "fig6_bottom"),
)
DEFAULT_GAINS = "fixed"
GAINS = (DEFAULT_GAINS, *(name for reading in INTERPRETATIONS for name in (reading.top, reading.bottom)))
"""The options of ``conf/gains`` that the figures need."""

AUTHORS_NOISE = "imx385_iso3200_rvdd"
"""The option of ``conf/noise`` with the noise profile of the article's author."""


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """The settings that the article fixes: the gains of `GAINS` by name, and its author's noise profile."""

    gains: Mapping[str, GainsConfig]
    authors_noise: NoiseConfig


@dataclass(frozen=True, slots=True)
class FigureSource:
    """The photograph in the figures, its plan for each option of `GAINS`, and its plan with the author's noise."""

    name: str
    srgb: Srgb
    plans: Mapping[str, Plan]
    authors: Plan


class ImageSaturation(NamedTuple):
    """Site counts of a photograph: all, at the highest code before unprocessing, at white in the clean frame."""

    sites: int
    before: int
    after: int


@dataclass(frozen=True, slots=True)
class SaturationCounts:
    """The saturation of several photographs for each option of `GAINS`, and the photographs that failed."""

    by_gains: Mapping[str, Sequence[ImageSaturation]]
    failed: tuple[str, ...] = ()

    def count_matching(self, interpretation: GainInterpretation) -> int:
        """The number of photographs that match the caption of Figure 6: more saturation in the bottom row only."""
        both = zip(self.by_gains[interpretation.top], self.by_gains[interpretation.bottom], strict=True)
        return sum(top.after <= top.before and bottom.after > bottom.before for top, bottom in both)


def load_figure_source(config: Config, options: PaperOptions, sources: Sequence[Source]) -> FigureSource:
    """The first readable photograph with its plans; ConfigError if there is none."""
    for source in sources:
        with suppress(SourceError):
            sha256, photograph = load_source(config.source, source)
            plans = {name: _plan(config, source, sha256, options.gains[name]) for name in GAINS}
            with_authors_noise = replace(config, noise=options.authors_noise)
            authors = _plan(with_authors_noise, source, sha256, options.gains[DEFAULT_GAINS])
            return FigureSource(source.name, photograph.srgb, plans, authors)
    raise ConfigError(
        f"source.root={config.source.root}: none of {len(sources)} photographs can be read; expected at least one"
    )


def _plan(config: Config, source: Source, sha256: str, gains: GainsConfig) -> Plan:
    return plan_image(replace(config, gains=gains), *source.stream_identity(sha256))


def count_saturation(config: Config, options: PaperOptions, sources: Iterable[Source]) -> SaturationCounts:
    """Count the saturated sites of photographs, one at a time, for each option of `GAINS`."""
    by_gains: dict[str, list[ImageSaturation]] = {name: [] for name in GAINS}
    failed = []
    for source in sources:
        try:
            sha256, photograph = load_source(config.source, source)
        except SourceError as error:
            failed.append(f"{source.name} ({error.reason})")
            continue
        before = saturated_sites(photograph.srgb, config.sensor.pattern)
        for name in GAINS:
            plan = _plan(config, source, sha256, options.gains[name])
            after = make_pair(photograph.srgb, plan).counts.saturated
            by_gains[name].append(ImageSaturation(before.size, int(before.sum()), after))
    return SaturationCounts(by_gains, tuple(failed))


def saturated_sites(srgb: Srgb, pattern: str) -> NDArray[np.bool_]:
    """The sites whose channel has the highest code in the photograph, ``[H, W]``."""
    return np.asarray(mosaic(srgb.astype(np.float64), pattern) == np.iinfo(srgb.dtype).max)
