"""Turn the NoiseProfile tags of DNG files into a two-number noise profile: variance = a·signal + b at each ISO.

With W - B = white - black, the tag's S and O of a colour give a = S·(W - B) DN and b = O·(W - B)² DN² (DNG
Specification 1.4). The profile has a and b of green; red and blue follow by their relative gains. Between two ISOs of
one gain mode both are interpolated; nothing is extrapolated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unprocess_gen.calibration.captures import Sensor, common, joined_sha256
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.profile import (
    MARK,
    NamedNumber,
    estimates_json,
    profile_head,
    profile_yaml,
    provenance,
    rounded,
    std_table,
)
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import file_sha256, machine_errors
from unprocess_gen.core.raw_files import RAW_FILES, list_raw_files
from unprocess_gen.sources.raw.decode import read_metadata
from unprocess_gen.sources.raw.tags import RawMetadata

FORM = "calibrate --from noise_profile"
DIGITS = 12
"""Digits of numbers, which keep the precision of tags."""
COLOUR_NAMES = ("R", "G", "B")
SAME = 1e-6
"""Relative difference up to which two tags are equal."""
MOST_SWITCHES = 2
"""Most changes of the gain mode of a sensor, where the variance without light falls."""


class StatedIso(NamedTuple):
    """Variance of one ISO by colour (R, G, B), a in DN and b in DN², and the first file that states it."""

    iso: float
    a: tuple[float, ...]
    b: tuple[float, ...]
    path: Path


class StatedNoise(NamedTuple):
    """Variances that the files of a folder state, in ascending order of ISO; the ISOs of each gain mode."""

    isos: list[StatedIso]
    modes: list[list[StatedIso]]
    sensor: Sensor
    camera: str
    sha256: str
    files: int
    notes: list[str]


def read_stated_noise(folder: Path) -> StatedNoise:
    """Read the NoiseProfile tags of the DNG files below a folder, or of one file; ConfigError or MachineError."""
    with machine_errors(folder):
        files, hidden = ([folder], "") if folder.is_file() else list_raw_files(folder, RAW_FILES)
        facts = {path: read_metadata(path, "calibrate", with_libraw=False) for path in files}
        stated = {path: tags for path, tags in facts.items() if tags.noise_profile is not None}
        sha256 = joined_sha256(map(file_sha256, stated))
    if not stated:
        problem = f"none of {len(files)} raw files has a NoiseProfile tag"
        raise ConfigError(f"calibrate: {folder}: {problem}; expected DNG files, such as those of Adobe's DNG Converter")
    notes = [f"{folder}: {hidden}"] if hidden else []
    notes += [f"{path}: {note}" for path, tags in stated.items() for note in tags.notes]
    if without := [path for path in files if path not in stated]:
        notes.append(f"{without[0]}: has no NoiseProfile tag; left out ({len(without)} of {len(files)} raw files)")
    model, blacks, white = (common(stated, name) for name in ("model", "black_dn", "white_dn"))
    modes = _modes(_stated_iso(path, tags) for path, tags in stated.items())
    pattern = next(iter(stated.values())).pattern
    sensor = Sensor(int(white).bit_length(), round(sum(blacks) / 4), round(white), pattern or "RGGB", (0, 0))
    return StatedNoise(
        list(itertools.chain(*modes)), modes, sensor, model or "an unknown camera", sha256, len(stated), notes
    )


def _stated_iso(path: Path, facts: RawMetadata) -> StatedIso:
    """ISO, a and b of red, green and blue of a file; ConfigError if no sensor has them."""
    black, white, numbers = facts.black_dn, facts.white_dn, facts.noise_profile or ()
    if black is None or white is None or not sum(black) / 4 < white:
        raise ConfigError(f"calibrate: {path}: BlackLevel={black}, WhiteLevel={white}; expected both")
    if facts.iso is None:
        raise ConfigError(f"calibrate: {path}: states no ISO; expected a DNG with its EXIF tags")
    if len(numbers) not in (2, 6):
        raise ConfigError(f"calibrate: {path}: NoiseProfile has {len(numbers)} values; expected 2, or 6 for 3 colours")
    scales, offsets = (numbers[start::2] * (6 // len(numbers)) for start in (0, 1))
    for name, scale, offset in zip(COLOUR_NAMES, scales, offsets, strict=True):
        if not 0 < scale < 1 or not 0 <= offset < 1:
            raise ConfigError(
                f"calibrate: {path}: NoiseProfile of {name}: variance = {scale:g}·x + {offset:g}; expected a slope "
                "above 0 and a variance at black of 0 or more, both below 1; remove the file"
            )
    span = white - sum(black) / 4
    return StatedIso(
        facts.iso, tuple(scale * span for scale in scales), tuple(offset * span**2 for offset in offsets), path
    )


def _modes(stated: Iterable[StatedIso]) -> list[list[StatedIso]]:
    """Records of all ISOs by gain mode, which begins where the variance without light falls or is no longer 0.

    ConfigError for files of one ISO that differ, and for variances that no sensor has: all others rise with ISO.
    """
    first, *others = sorted(stated, key=lambda record: record.iso)
    modes, falls = [[first]], [False]
    for high in others:
        low = modes[-1][-1]
        where = f"calibrate: {high.path}: NoiseProfile at ISO {high.iso:g}"
        expected = f"than at ISO {low.iso:g} ({low.path.name}); expected a rise with ISO; remove the wrong file"
        if high.iso == low.iso:
            if not np.allclose(high.a + high.b, low.a + low.b, rtol=SAME, atol=0):
                raise ConfigError(
                    f"{where} differs from that of {low.path.name}; expected files of one camera and mode"
                )
            continue
        for name, before, after in zip(COLOUR_NAMES, low.a, high.a, strict=True):
            if after <= before * (1 + SAME):
                raise ConfigError(f"{where}: the variance of {name} has no larger slope {expected}")
        falls.append(high.b[1] < low.b[1] * (1 - SAME))
        if sum(falls) > MOST_SWITCHES or all(falls[-2:]):
            raise ConfigError(f"{where}: again less variance without light {expected}")
        if falls[-1] or (high.b[1] > 0) != (low.b[1] > 0):
            modes.append([])
        modes[-1].append(high)
    return modes


def stated_json(stated: StatedNoise) -> str:
    """The list of estimates as JSON; the tags state no intervals."""
    named = []
    for iso, a, b, _ in stated.isos:
        for site, plane in ((None, 1), ("R", 0), ("Gr", 1), ("Gb", 1), ("B", 2)):
            numbers = {"dn_per_e": a[plane], "b_dn2": b[plane], "read_std_dn": math.sqrt(b[plane])}
            estimates = {name: Estimate(value, -math.inf, math.inf) for name, value in numbers.items()}
            named += [NamedNumber(name, iso, site, number) for name, number in estimates.items()]
    return estimates_json(named, DIGITS)


def stated_yaml(stated: StatedNoise, name: str) -> str:
    """The noise profile of NoiseProfile tags."""
    isos, profile = [record.iso for record in stated.isos], profile_head(name, stated.sensor)
    profile["branches"] = []
    for mode in stated.modes:
        own = [record.iso for record in mode]
        gain = std_table(own, [record.a[1] for record in mode], DIGITS)
        read = std_table(own, [math.sqrt(record.b[1]) for record in mode], DIGITS)
        branch = {"iso": [own[0], own[-1]], "dn_per_e": gain, "read_law": "gaussian", "read_std_dn": read}
        profile["branches"].append(branch)
    gains = stated.isos[len(isos) // 2].a
    if max(gains) > min(gains) * (1 + SAME):
        profile["gain_by_colour"] = [rounded(gain / gains[1], DIGITS) for gain in gains]
    source = f"{FORM}, tags of {stated.camera}, {stated.files} files, SHA-256 {stated.sha256[:16]}"
    profile["provenance"] = [provenance(["dn_per_e", "read_std_dn"], isos, source, "the tags state none")]
    start = f"Read {MARK} from the NoiseProfile tags of {stated.camera}, {stated.files} files"
    return profile_yaml(f"{start}, ISO {', '.join(f'{iso:g}' for iso in isos)}", stated.sha256, stated.notes, profile)
