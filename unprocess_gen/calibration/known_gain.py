"""Take the gain of darks from elsewhere: a noise profile, the NoiseProfile tags of the darks, or stated values."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec

from unprocess_gen.calibration.captures import CaptureSet
from unprocess_gen.calibration.gain import Estimate
from unprocess_gen.calibration.profile import KnownGain
from unprocess_gen.calibration.stated_noise import is_raw, stated_variance, unknown
from unprocess_gen.config.interpretation import branch_of, is_physical
from unprocess_gen.config.noise_validation import check_noise
from unprocess_gen.config.option_files import group_options
from unprocess_gen.config.schema import NoiseConfig, SceneConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.records import parse_record
from unprocess_gen.core.suggestions import did_you_mean
from unprocess_gen.planning.noise_profile import evaluate
from unprocess_gen.sources.raw.metadata import read_tags


def known_gain(captures: CaptureSet, profile: str | None, stated: str | None) -> KnownGain:
    """Return the gain at the ISOs of darks; ConfigError names an ISO without one."""
    if profile is not None and stated is not None:
        raise ConfigError(f"--gain {profile}, --dn-per-e {stated}: both state the gain; expected one of them")
    if profile is not None:
        return _profile_gain(captures, profile)
    gains = _user_gains(stated) if stated is not None else _tag_gains(captures)
    if missing := [iso for iso in captures.isos if iso not in gains]:
        problem = f"--dn-per-e {stated}: has no gain for ISO {missing[0]:g} of the darks"
        if stated is None:
            dark = f"no dark of ISO {missing[0]:g} has a NoiseProfile tag"
            problem = f"calibrate: --from darks: {dark}, and darks do not show the gain"
        raise ConfigError(f"{problem}; expected --gain PROFILE, or --dn-per-e GAIN@{missing[0]:g}")
    by_iso = {iso: unknown(gains[iso]) for iso in captures.isos}
    if stated is not None:
        return KnownGain("gain stated by --dn-per-e, not measured", "not known", by_iso)
    return KnownGain("gain from the NoiseProfile tags of the darks, not measured", "the tags state none", by_iso)


def _user_gains(stated: str) -> dict[float, float]:
    """Read gains such as ``0.1@100,0.4@400``."""
    try:
        pairs = [text.partition("@") for text in stated.split(",")]
        gains = {float(iso): float(value) for value, _, iso in pairs}
    except ValueError:
        gains = {math.nan: math.nan}
    if not all(0 < value < math.inf and 0 < iso < math.inf for iso, value in gains.items()):
        raise ConfigError(f"--dn-per-e {stated}: expected DN per electron @ ISO, such as 0.1@100,0.4@400")
    return gains


def _tag_gains(captures: CaptureSet) -> dict[float, float]:
    """Read the gain of green from the NoiseProfile tags of the darks."""
    gains = dict[float, float]()
    for capture in captures.captures:
        if capture.iso not in gains and is_raw(capture.path):
            facts = read_tags(capture.path, "calibrate")
            if facts.noise_profile is not None:
                gains[capture.iso] = stated_variance(capture.path, facts)[0][1]
    return gains


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
        value = evaluate(branch.dn_per_e, iso=iso)
        low, high = listed.get(iso, (-math.inf, math.inf))
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

    name: str
    iso: float | None
    site: str | None
    low: float | None
    high: float | None


def _intervals(path: Path) -> dict[float, tuple[float, float]]:
    """Return the intervals of the gain by ISO from the list of estimates next to a profile; none without a list."""
    if not path.is_file():
        return {}
    try:
        with machine_errors(path):
            listed = parse_record(path.read_bytes(), list[ListedEstimate])
    except ValueError as error:
        problem = f"is not a list of estimates ({error_in_one_line(error)})"
        raise ConfigError(f"--gain: {path}: {problem}; calibrate again, or delete the list") from error
    gains = [entry for entry in listed if (entry.name, entry.site) == ("dn_per_e", None)]
    return {
        gain.iso: (gain.low, gain.high)
        for gain in gains
        if gain.iso is not None and gain.low is not None and gain.high is not None
    }
