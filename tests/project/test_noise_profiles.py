"""The published numbers in docs/noise_sources.yaml, compared with the physical profiles."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import noise_profile_page
from noise_profile_page import ISOS, ISOS_OF, PublishedSet, number_at, physical_profiles, profile_at, published, sets_of

from unprocess_gen.config.interpretation import provenance_at
from unprocess_gen.config.option_files import conf_dir, group_options

PROFILES = list(published()["profiles"])


def isos_of(name: str) -> tuple[int, ...]:
    return ISOS_OF.get(name, ISOS)


def test_every_physical_profile_has_published_numbers() -> None:
    written = {name: yaml.safe_load((conf_dir() / f"noise/{name}.yaml").read_text()) for name in group_options("noise")}
    assert set(PROFILES) == {name for name, profile in written.items() if "branches" in profile}


def test_every_source_is_cited() -> None:
    sources = published()["sources"]
    assert all(one["citation"] and one["place"] for one in sources.values())
    for name in PROFILES:
        assert {entry["source"] for entry in published()["profiles"][name]} <= set(sources)
        for statement in physical_profiles()[name].provenance:
            source = re.match(r"[A-Z][A-Za-z]+\b", statement.source)
            assert source is None or source[0] in sources, statement.source


def published_values(name: str, iso: float, number: str) -> list[float | None]:
    """Return what the source of a profile's number at an ISO published; None where its table has no such ISO."""
    noise, key = physical_profiles()[name], NUMBERS[number]
    sources = [one.source.replace(",", "") for one in provenance_at(noise, (iso,)) if number in one.numbers]
    return [
        one.number(key, iso)
        for source in sources
        for one in sets_of(name)
        if one.name in source or ("Profile" not in source and one.name.split()[0] == source.split()[0])
    ]


NUMBERS = {"dn_per_e": "gain", "read_std_dn": "read", "row_std_dn": "row"}


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("iso", [*ISOS, 200, 2000, 12800, 25600])
def test_numbers_of_a_profile_are_those_of_the_source_that_its_provenance_names(iso: float, name: str) -> None:
    """Those of the IMX385 are published as rounded to 1e-4; tables of the Oppo are interpolated between half stops."""
    physics = profile_at(physical_profiles()[name], iso)
    for number in NUMBERS if physics is not None else ():
        made, values = getattr(physics, number), published_values(name, iso, number)
        tolerance = {"imx385": 1e-4, "oppo_reno10x": 5e-3}.get(name, 1e-8)
        agrees = any(value is None or math.isclose(made, value, rel_tol=tolerance) for value in values)
        assert agrees if values else made == 0, number


@pytest.mark.parametrize("name", PROFILES)
def test_table_of_a_profile_has_all_its_sources(name: str) -> None:
    rows = noise_profile_page.comparison_rows(name)
    assert {len(row) for row in rows} == {3 + len(isos_of(name))}
    origins = {row[1].split(",")[0] for row in rows} - {"**profile**"}
    assert origins == {one.name for one in sets_of(name) if any(one.has(key) for key in ("gain", "read", "row"))}


def test_published_numbers_are_evaluated_by_their_form() -> None:
    assert number_at(0.5, 100, None) == 0.5
    assert number_at(["per_iso", 0.5, 1.0], 100, None) == 51
    assert number_at(["root", 1.0, 0.03], 100, None) == 2
    assert math.isclose(number_at(["line", 2.0, 1.0], 100, 3.0), 9 * math.e)
    assert number_at(["by_iso", 100, 1.5, 200, 2.5], 200, None) == 2.5
    assert number_at(["by_iso", 100, 1.5, 200, 2.5], 150, None) is None
    assert number_at(["by_stop", 1.0, 2.0, 3.0, 5.0], 200, None) == 4
    assert number_at(["by_stop", [1.0, 2.0], [3.0, 4.0]], 100, None) == [2, 3]


def test_electrons_and_tukey_scales_become_standard_deviations() -> None:
    noise = physical_profiles()["oppo_reno10x"]
    entry = {"source": "ELD", "gain": ["per_iso", 0.02], "read_e": ["by_iso", 100, 1.5], "tukey": 3.0, "shape": 0.0}
    one = PublishedSet(entry, noise)
    assert one.number("read", 100) == 3
    assert math.isclose(one.number("tukey", 100), math.pi * math.sqrt(3))
