"""Draw the entry of a mixture that decides the settings of an image."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from fractions import Fraction

from unprocess_gen.config.interpretation import entry_config
from unprocess_gen.config.schema import Config
from unprocess_gen.core.random_streams import mixture_word, stream_key

WORD_COUNT = 2**64
"""Number of values of `random_streams.mixture_word`."""


def image_config(config: Config, source_sha256: str, occurrence: int = 0) -> Config:
    """Return the config of an image: its entry's config, whose ``mixture`` is the entry's number, or ``config``."""
    if config.mixture is None:
        return config
    return config_of_key(config, stream_key(config.seed, source_sha256, occurrence))


def config_of_key(config: Config, key: int, epoch: int = 0) -> Config:
    """Return the config of an image like `image_config`, by the key of its random streams, in an epoch."""
    if config.mixture is None:
        return config
    return entry_config(config, entry_number(config, key, epoch))


def entry_number(config: Config, key: int, epoch: int = 0) -> int:
    """Draw the number of an image's entry: entry n has the share weight_n / sum of weights, to 2^-64."""
    weights = tuple(entry.weight for entry in config.mixture)
    return drawn_entry(_whole_weights(weights), mixture_word(key, epoch))


def drawn_entry(weights: Sequence[int], word: int) -> int:
    """Return the first entry whose cumulative share exceeds ``word`` / 2^64, in exact arithmetic."""
    total = sum(weights)
    return next(number for number, end in enumerate(itertools.accumulate(weights)) if word * total < end * WORD_COUNT)


@functools.lru_cache
def _whole_weights(weights: tuple[float, ...]) -> tuple[int, ...]:
    """Return integers with the ratios of the weights, which floats represent exactly."""
    fractions = [Fraction(weight) for weight in weights]
    common = math.lcm(*(fraction.denominator for fraction in fractions))
    return tuple(int(fraction * common) for fraction in fractions)
