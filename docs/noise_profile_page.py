"""Generate ``docs/reference/noise_profiles.md``: each physical profile and the published numbers of its camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from unprocess_gen.config.interpretation import branch_of
from unprocess_gen.config.option_files import option_summary
from unprocess_gen.config.schema import Config, NoiseConfig, SensorConfig
from unprocess_gen.config.serialization import read_option
from unprocess_gen.core.exact_distributions import tukey_std
from unprocess_gen.planning.draws import DRAW_COUNT
from unprocess_gen.planning.noise_profile import PhysicalNoise
from unprocess_gen.simulation.plan import Physics

SOURCES = Path(__file__).parent / "noise_sources.yaml"

ISOS = (100, 400, 800, 1600, 3200, 6400)
ISOS_OF = {"imx385": (1600, 3200, 6400, 12800, 25600)}
"""ISOs of the tables; those of profiles that have others."""

INTRODUCTION = """\
# Noise profiles and their sources

This page compares each physical noise profile with every published calibration of its camera, and lists the source and
the uncertainty of each number (`noise.provenance`). Numbers are in DN of the calibration, as a default run has them.
[Abbreviations of sources](#sources), such as ELD and PMN, are explained at the end.

- Read noise is a standard deviation, in DN and, in parentheses, in electrons. "Tukey" is the standard deviation of a
  Tukey-lambda distribution with the published scale and shape.
- ELD gives two shapes and two sets of black errors for each full stop. The rows of ELD have their means, and the
  profile has the first.
- An asterisk marks an ISO outside the range of the calibration. The last column is the profile divided by the source,
  over the ISOs inside that range.
- An assumed number (`noise.assumed`) is typical or inferred; no source gives it directly for this camera.

[Numbers of noise profiles](../design/noise_profiles.md) explains the choice of the numbers."""


@cache
def published() -> dict[str, Any]:
    """Return the published numbers: ``sources`` with citations, and ``profiles`` with lists of sets."""
    content = yaml.safe_load(SOURCES.read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


@cache
def physical_profiles() -> dict[str, NoiseConfig]:
    """Return the physical profiles with published numbers by name."""
    return {name: read_option("noise", name) for name in published()["profiles"]}


def profile_at(noise: NoiseConfig, iso: float) -> Physics | None:
    """Return the numbers of a profile at an ISO, in DN of its calibration; None without a branch."""
    if branch_of(noise, iso) is None:
        return None
    assert noise.bits is not None and noise.black_level_dn is not None and noise.white_level_dn is not None
    sensor = SensorConfig(noise.bits, noise.black_level_dn, noise.white_level_dn)
    config = Config(noise=replace(noise, iso=iso), sensor=sensor)
    profile = PhysicalNoise(config)
    return profile.physics(profile.draw([0.5] * DRAW_COUNT, 0, 0))


def by_colour(physics: Physics) -> tuple[float, ...]:
    """Return the black-level errors of a RGGB sensor in the order R, G1, B, G2."""
    red, green_1, green_2, blue = physics.black_error_dn
    return red, green_1, blue, green_2


def number_at(form: Any, iso: float, gain: float | None) -> Any:
    """Evaluate a published number at an ISO and a gain; None if the source has none there."""
    if not isinstance(form, list | tuple):
        return form
    kind, *numbers = form
    if kind == "per_iso":
        return numbers[0] * iso + (numbers[1] if len(numbers) > 1 else 0.0)
    if kind == "root":
        return math.sqrt(sum(one * iso**power for power, one in enumerate(numbers)))
    if kind == "line":
        return None if gain is None else math.exp(numbers[0] * math.log(gain) + numbers[1])
    if kind == "by_iso":
        return dict(zip(numbers[::2], numbers[1::2], strict=True)).get(iso)
    assert kind == "by_stop", kind
    rows = numbers[int(2 * math.log2(iso / 100) + 1e-9) :][:2]  # two for each full stop from ISO 100
    if isinstance(rows[0], list):
        return [sum(pair) / 2 for pair in zip(*rows, strict=True)]
    return sum(rows) / 2


class PublishedSet:
    """One set of published numbers of a camera.

    Parameters
    ----------
    entry : dict
        Item of a profile in the data file.
    noise : NoiseConfig
        The profile, whose gain is used for lines in the gain if the set states none.
    """

    def __init__(self, entry: dict[str, Any], noise: NoiseConfig) -> None:
        self._entry, self._noise = entry, noise
        self.name = " ".join(entry[key] for key in ("source", "set") if key in entry)

    def holds_at(self, iso: float) -> bool:
        """Return whether the ISO is in the range of the calibration."""
        low, high = self._entry.get("iso", (0, math.inf))
        return bool(low <= iso <= high)

    def has(self, key: str) -> bool:
        """Return whether the set has a number, or numbers from which it follows."""
        return key in self._entry or (key == "read" and "read_e" in self._entry)

    def own_gain(self, iso: float) -> float | None:
        """Return the gain that the set states, DN per electron."""
        return number_at(self._entry.get("gain"), iso, None)

    def gain(self, iso: float) -> float | None:
        """Return the gain of the set, or that of the profile if the set states none."""
        if "gain" in self._entry:
            return self.own_gain(iso)
        physics = profile_at(self._noise, iso)
        return None if physics is None else physics.dn_per_e

    def number(self, key: str, iso: float) -> Any:
        """Return a number at an ISO: ``read``, ``shape``, ``row``, ``black``; ``tukey`` as a standard deviation."""
        gain = self.gain(iso)
        if key == "read" and "read_e" in self._entry:
            electrons = number_at(self._entry["read_e"], iso, gain)
            return None if electrons is None or gain is None else electrons * gain
        value = number_at(self._entry.get(key), iso, gain)
        if key == "tukey" and value is not None:
            return value * float(tukey_std(self.number("shape", iso)))
        return value


def sets_of(name: str) -> list[PublishedSet]:
    """Return the published sets of a profile's camera."""
    return [PublishedSet(entry, physical_profiles()[name]) for entry in published()["profiles"][name]]


# ------------------------------------------------------------------------------------------------------------- tables

Value = Callable[[float], Any]


def _plain(digits: int) -> Callable[[Any, float | None], str]:
    return lambda value, gain: _signed(value, digits)


def _signed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")


def _deviation(value: Any, gain: float | None) -> str:
    return f"{value:.2f}" + (f" ({value / gain:.2f})" if gain else "")


def _errors(value: Any, gain: float | None) -> str:
    return ", ".join(_signed(one, 2) for one in value) if isinstance(value, Iterable) else _signed(value, 2)


def comparison_rows(name: str) -> list[list[str]]:
    """Return the rows of a profile's table: quantity, origin, a cell for each ISO, profile divided by source."""
    noise, sets, isos = physical_profiles()[name], sets_of(name), ISOS_OF.get(name, ISOS)
    made = {iso: profile_at(noise, iso) for iso in isos}

    def own(read: Callable[[Physics], Any]) -> Value:
        return lambda iso: None if (one := made[int(iso)]) is None else read(one)

    quantities: list[tuple[str, tuple[tuple[str, str], ...], Value, Callable[[Any, float | None], str]]] = [
        ("gain K, DN/e⁻", (("gain", ""),), own(lambda one: one.dn_per_e), _plain(4)),
        (
            "read σ, DN (e⁻)",
            (("read", ", Gaussian"), ("tukey", ", Tukey")),
            own(lambda one: one.read_std_dn),
            _deviation,
        ),
        ("λ of Tukey", (("shape", ""),), own(lambda one: one.read_shape), _plain(3)),
        ("row σ, DN", (("row", ""),), own(lambda one: one.row_std_dn), _plain(2)),
        ("black error R, G1, B, G2, DN", (("black", ""),), own(by_colour), _errors),
    ]
    rows = []
    for title, keys, of_profile, text in quantities:
        known = [(one, key, suffix) for one in sets for key, suffix in keys if one.has(key)]
        if not known and all(of_profile(iso) in (None, 0.0, (0.0,) * 4) for iso in isos):
            continue
        cells = [_cell(of_profile(iso), text, _gain_of(made[iso]), "") for iso in isos]
        rows.append([f"**{title}**", "**profile**", *(f"**{cell}**" if cell != "–" else cell for cell in cells), ""])
        for one, key, suffix in known:
            cells = []
            for iso in isos:
                mark = "" if one.holds_at(iso) else "\\*"
                value = one.own_gain(iso) if key == "gain" else one.number(key, iso)
                cells.append(_cell(value, text, one.gain(iso), mark))
            ratio = "" if key in ("shape", "black") else _ratio(one, key, of_profile, isos)
            rows.append(["", one.name + suffix, *cells, ratio])
    return rows


def _gain_of(physics: Physics | None) -> float | None:
    return None if physics is None else physics.dn_per_e


def _cell(value: Any, text: Callable[[Any, float | None], str], gain: float | None, mark: str) -> str:
    return "–" if value is None else text(value, gain) + mark


def _ratio(one: PublishedSet, key: str, of_profile: Value, isos: Sequence[float]) -> str:
    """Return the range of profile divided by source over the ISOs in the range of the calibration."""
    pairs = [
        (of_profile(iso), one.own_gain(iso) if key == "gain" else one.number(key, iso))
        for iso in isos
        if one.holds_at(iso)
    ]
    ratios = [made / other for made, other in pairs if made is not None and other is not None]
    if not ratios:
        return ""
    low, high = f"{min(ratios):.2f}", f"{max(ratios):.2f}"
    return low if low == high else f"{low} to {high}"


def provenance_rows(noise: NoiseConfig) -> list[list[str]]:
    """Return a row for each statement about the numbers of a profile: numbers, ISO, source, uncertainty."""
    return [
        [
            ", ".join(f"`{number}`{' (assumed)' * (number in noise.assumed)}" for number in one.numbers),
            f"{one.iso[0]:g} to {one.iso[1]:g}" if one.iso else "all",
            _words(one.source),
            _words(one.uncertainty),
        ]
        for one in noise.provenance
    ]


def _words(text: str) -> str:
    return text.replace("*", "\\*")


def source_lines() -> list[str]:
    """Return a line for each source: abbreviation, citation, where its numbers are."""
    return [f"- **{name}**: {one['citation']}. {one['place']}." for name, one in published()["sources"].items()]


def profiles_page(table: Callable[[Iterable[str], Iterable[Iterable[str]]], str], page: Callable[..., str]) -> str:
    """Return the page; ``table`` and ``page`` are those of `reference_pages`."""
    blocks = [INTRODUCTION]
    for name, noise in physical_profiles().items():
        isos = ISOS_OF.get(name, ISOS)
        head = ["quantity", "origin", *(f"ISO {iso}" for iso in isos), "profile ÷ source"]
        blocks += [
            f"## `{name}`",
            option_summary("noise", name),
            table(head, comparison_rows(name)),
            table(["numbers", "ISO", "source", "uncertainty"], provenance_rows(noise)),
        ]
    blocks += ["## Sources", "\n".join(source_lines())]
    return page(*blocks)
