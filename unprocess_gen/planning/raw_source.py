"""Take what the file of a raw source states into the settings and the plan of its image."""

from __future__ import annotations

from dataclasses import replace

from unprocess_gen.config.schema import Config
from unprocess_gen.simulation.facts import RawParts
from unprocess_gen.simulation.plan import Plan, SourcePlan


def parts_of(plan: Plan) -> RawParts | None:
    """Return the parts that the file of a raw source gave to a plan; None for a photograph."""
    return RawParts(plan.source, plan.camera, plan.isp, plan.sensor) if plan.source.is_raw else None


def stated_source(plan: Plan) -> SourcePlan | None:
    """Return the source that the file of a linear source gave to a plan; None for others."""
    return plan.source if plan.source.is_linear else None


def with_raw_sensor(config: Config, raw: RawParts | None) -> Config:
    """Return the config of an image of a raw source: its levels with ``sensor=source``, and the pattern of its mosaic.

    Averaged cells have all colours, so they take the pattern of the sensor.
    """
    if raw is None:
        return config
    sensor = config.sensor
    if sensor.levels == "source":
        levels = ("pattern", "bits", "black_level_dn", "white_level_dn")
        sensor = replace(sensor, **{name: getattr(raw.sensor, name) for name in levels})
    elif raw.source.shrink == 1:
        sensor = replace(sensor, pattern=raw.sensor.pattern)
    return replace(config, sensor=sensor)


def own_noise(raw: RawParts, exposure: float, span_dn: float) -> SourcePlan:
    """Return the source of a plan with the variance that its own noise has in the clean frame.

    The variance of the source, S·x + O, is multiplied by the square of the exposure. A signal of u DN is the light
    x = u / (exposure · span), so the variance is exposure · span · S · u + (exposure · span)² · O.
    """
    if raw.noise is None:
        return raw.source
    scale, offset = raw.noise
    dn = exposure * span_dn
    return raw.source.replace(own_a_dn=scale * dn, own_b_dn2=offset * dn * dn)
