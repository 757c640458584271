"""Take the gain of darks from elsewhere: a noise profile, the NoiseProfile tags of the darks, or stated values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import msgspec

from unprocess_gen.calibration.captures import CaptureSet
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.profile import KnownGain
from unprocess_gen.calibration.stated_noise import is_raw, stated_variance
from unprocess_gen.config.interpretation import branch_of, is_physical
from unprocess_gen.config.noise_validation import check_noise
from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.schema import NoiseConfig, SceneConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.records import Amount, check_record, parse_record
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.planning.noise_profile import evaluate
from unprocess_gen.sources.raw.metadata import read_tags

UNKNOWN_INTERVAL = (-math.inf, math.inf)
LARGEST_LIST = 2**24
"""Bytes of the largest list of estimates that is read."""


def known_gain(captures: CaptureSet, profile: str | None, stated: str | None) -> KnownGain:
    """Return the gain at the ISOs of darks; ConfigError names an ISO without one."""
    if profile is not None and stated is not None:
        raise ConfigError(f"--gain {profile}, --dn-per-e {stated}: both state the gain; expected one of them")
    if profile is not None:
        return _profile_gain(captures, profile)
    return _user_gain(captures, stated) if stated is not None else _tag_gain(captures)


def _user_gain(captures: CaptureSet, stated: str) -> KnownGain:
    """Read gains such as ``0.1@100,0.4@400``."""
    gains = {}
    for text in stated.split(","):
        try:
            value, _, iso = text.partition("@")
            gains[float(iso)] = float(value)
        except ValueError:
            gains[math.nan] = math.nan
    if not all(0 < value < math.inf and 0 < iso < math.inf for iso, value in gains.items()):
        raise ConfigError(f"--dn-per-e {stated}: expected DN per electron @ ISO, such as 0.1@100,0.4@400")
    if missing := [iso for iso in captures.isos if iso not in gains]:
        raise ConfigError(f"--dn-per-e {stated}: has no gain for ISO {missing[0]:g} of the darks; add …@{missing[0]:g}")
    by_iso = {iso: Estimate(gains[iso], *UNKNOWN_INTERVAL) for iso in captures.isos}
    return KnownGain("gain stated by --dn-per-e, not measured", "not known", by_iso)


def _tag_gain(captures: CaptureSet) -> KnownGain:
    """Read the gain of green from the NoiseProfile tags of the darks."""
    by_iso = {}
    for capture in captures.captures:
        facts = read_tags(capture.path, "calibrate") if is_raw(capture.path) else None
        if capture.iso not in by_iso and facts is not None and facts.noise_profile is not None:
            by_iso[capture.iso] = Estimate(stated_variance(capture.path, facts)[0][1], *UNKNOWN_INTERVAL)
    if missing := [iso for iso in captures.isos if iso not in by_iso]:
        raise ConfigError(
            f"calibrate: --from darks: no dark of ISO {missing[0]:g} has a NoiseProfile tag, and darks do not show the "
            f"gain; expected --gain PROFILE, or --dn-per-e GAIN@{missing[0]:g}"
        )
    return KnownGain("gain from the NoiseProfile tags of the darks, not measured", "the tags state none", by_iso)


def _profile_gain(captures: CaptureSet, profile: str) -> KnownGain:
    """Evaluate the gain of a physical noise profile, in DN of the sensor; its list of estimates has intervals."""
    noise, listed = _read_profile(profile)
    if not is_physical(noise):
        problem = "is for one ISO that it does not state"
        raise ConfigError(f"--gain {profile}: {problem}; expected a physical profile, or --dn-per-e with its a")
    by_iso = {}
    for iso in captures.isos:
        try:
            check_noise(noise, SceneConfig(iso=iso))
        except ConfigError as error:
            raise ConfigError(f"--gain {profile}: {error}") from error
        branch = branch_of(noise, iso)
        assert branch is not None and noise.white_level_dn is not None and noise.black_level_dn is not None
        scale = captures.sensor.span_dn / (noise.white_level_dn - noise.black_level_dn)
        low, high = listed.get(iso, UNKNOWN_INTERVAL)
        value = evaluate(branch.dn_per_e, iso=iso)
        by_iso[iso] = Estimate(value * scale, low * scale, high * scale)
    errors = [(gain.high - gain.low) / 2 / gain.value for gain in by_iso.values()]
    uncertainty = f"{max(errors):.2%} (95 %)" if max(errors) < math.inf else f"that of profile {noise.name}"
    return KnownGain(f"gain from profile {noise.name}, not measured", uncertainty, by_iso)


def _read_profile(profile: str) -> tuple[NoiseConfig, dict[float, tuple[float, float]]]:
    """Read a profile, by the name of an option or from a file, and the intervals of its gain by ISO."""
    path, names = Path(profile), group_options("noise")
    if not path.is_file() and profile not in names:
        hint = did_you_mean(profile, names)
        raise ConfigError(f"--gain {profile}: no such noise profile; expected a YAML file, or an option of noise{hint}")
    if not path.is_file():
        return read_option("noise", profile), {}
    return read_option("noise", path), _intervals(path.with_suffix(".json"))


class ListedEstimate(msgspec.Struct):
    """Line of a list of estimates that is read back."""

    name: Annotated[str, msgspec.Meta(max_length=64)]
    iso: Amount | None
    site: Annotated[str, msgspec.Meta(max_length=2)] | None
    low: Amount | None
    high: Amount | None


def _intervals(path: Path) -> dict[float, tuple[float, float]]:
    """Return the intervals of the gain by ISO from the list of estimates next to a profile; none without a list."""
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_LIST + 1)
        if len(content) > LARGEST_LIST:
            raise ValueError(f"has more than {LARGEST_LIST} bytes")
        rows = [row for row in parse_record(content, list[dict[str, Any]]) if row.get("name") == "dn_per_e"]
        listed = [check_record(row, ListedEstimate) for row in rows]
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise MachineError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        problem = f"is not a list of estimates ({error_in_one_line(error)})"
        raise ConfigError(f"--gain: {path}: {problem}; calibrate again, or delete the list") from error
    return {
        entry.iso: (entry.low, entry.high)
        for entry in listed
        if entry.site is None and entry.iso is not None and entry.low is not None and entry.high is not None
    }
