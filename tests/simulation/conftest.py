"""A plan that most tests of the simulation change."""

from __future__ import annotations

import pytest

from unprocess_gen.config.schema import Config, GainsConfig, NoiseConfig
from unprocess_gen.planning.plan import plan_image
from unprocess_gen.simulation.plan import Plan


@pytest.fixture(scope="session")
def plan() -> Plan:
    noise = NoiseConfig("imx385_iso3200", "dn", "subtracted", 12, 240, 4095, 6.955588, 38.117816)
    return plan_image(Config(gains=GainsConfig(1.0, 1.0, 1.0), noise=noise), "a" * 64)
