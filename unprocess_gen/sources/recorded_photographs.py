"""Decode the photographs of a dataset again, as its rows record them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import PurePosixPath

from unprocess_gen.config.schema import RawConfig, SourceConfig
from unprocess_gen.core.errors import RESTORE, ConfigError, DamageError, MachineError, SourceChangedError, SourceError
from unprocess_gen.core.raw_files import RAW_FILES
from unprocess_gen.core.sequences import Recent
from unprocess_gen.core.source import Source
from unprocess_gen.simulation.plan import Plan, SourcePlan
from unprocess_gen.simulation.profiles import SRGB, UNCONVERTED, Profile
from unprocess_gen.sources.image.decode import Photograph, read_profile
from unprocess_gen.sources.loader import load_source
from unprocess_gen.sources.reading import read_bytes

PROFILES = 4096
"""Photographs whose colours are kept."""

NO_LIMIT = 2**40
"""Pixels that a replay accepts; ``source.max_pixels`` applied when the row was made."""


class RecordedPhotographs:
    """Decode sources below ``root``; the last one stays decoded, because rows of one image are consecutive."""

    def __init__(self, root: str | None) -> None:
        self._root = root
        self._kept: tuple[SourceConfig, Source, str, Photograph] | None = None
        self._profiles: Recent[str, Profile] = Recent(PROFILES)

    def load(self, source: Source, recorded: str, prepared: SourcePlan) -> Photograph:
        """Decode the source of a row with this SHA-256.

        SourceChangedError unless the file can be read and used as when it was listed, DamageError if its bytes cannot
        be a source, ConfigError if it is a file and there is no root.
        """
        if self._root is None and source.size_bytes != 0:
            raise ConfigError(
                f"source.root is missing: row {source.index:08d} was generated from the file {source.name}; "
                "expected its folder; give source.root=…"
            )
        config = _settings_of(self._root, source, prepared)
        try:
            if self._kept is None or self._kept[:2] != (config, source):
                self._kept = None  # frees the last photograph first: two at a time would take twice the memory
                self._kept = config, source, *load_source(config, source)
        except SourceError as error:
            if error.sha256 not in (None, recorded):
                raise SourceChangedError(_changed(str(error.sha256), recorded)) from error
            text = f"source {source.name}: cannot be used below {self._root} ({error})"
            raise (DamageError(text) if error.sha256 else SourceChangedError(f"{text}; {RESTORE}")) from error
        except MachineError as error:
            raise SourceChangedError(f"{str(error).partition(';')[0]}; {RESTORE}") from error
        _, _, sha256, photograph = self._kept
        if sha256 != recorded:
            raise SourceChangedError(_changed(sha256, recorded))
        if photograph.profile.name != prepared.profile.name:
            names = photograph.profile.name, prepared.profile.name
            raise DamageError("its source has the colour profile {!r}, the row records {!r}".format(*names))
        digest = photograph.pixels_xxh3 if photograph.raw is None else photograph.raw.source.mosaic_xxh3
        if digest != (expected := prepared.pixels_xxh3 or prepared.mosaic_xxh3):
            raise SourceChangedError(
                f"its file is the same, but is decoded to other pixels: XXH3-128 is {digest}, the row records "
                f"{expected}; expected the versions of the decoders that dataset.json records"
            )
        return photograph

    def with_profile(self, plan: Plan, source: Source, recorded: str) -> Plan:
        """Add the colours of its source to the plan of a row; SourceChangedError if its bytes are others.

        Only headers are read: with a cache of pixels, each worker would otherwise decode each photograph once.
        """
        if self._root is None or plan.source.profile.name in (UNCONVERTED.name, SRGB):
            return plan
        profile = self._profiles.get(recorded)
        if profile is None:
            content = read_bytes(self._root, source)
            if (sha256 := hashlib.sha256(content).hexdigest()) != recorded:
                raise SourceChangedError(_changed(sha256, recorded))
            profile = self._profiles.keep(recorded, read_profile(content))
        return plan.decoded(profile, plan.source.pixels_xxh3)


def _settings_of(root: str | None, source: Source, prepared: SourcePlan) -> SourceConfig:
    """Settings with which the source of a row is decoded."""
    place = None if source.size_bytes == 0 else root  # synthetic pictures have no bytes
    icc = "convert" if prepared.profile.name else "ignore"
    config = SourceConfig(root=place, max_pixels=NO_LIMIT, downscale=prepared.downscale, icc=icc)
    if prepared.is_linear:
        return replace(config, kind="linear", primaries=prepared.primaries)
    if not prepared.is_raw:
        return config
    pattern = None if PurePosixPath(source.path).suffix.lower() in RAW_FILES else prepared.raw_pattern
    black = set(prepared.raw_black_dn)  # several are those of the file
    raw = RawConfig(pattern, black.pop() if len(black) == 1 else None, prepared.raw_white_dn[0])
    return replace(config, kind="raw", shrink=prepared.shrink, raw=raw)


def _changed(sha256: str, recorded: str) -> str:
    return f"its source has changed: SHA-256 is {sha256}, the row records {recorded}; {RESTORE}"
