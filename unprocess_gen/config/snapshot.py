"""Identify configs by their content, so that values derived from a config are computed once, not for every image.

The dataclasses of a config are not frozen: Hydra sets their fields, and so may any program. A cache therefore uses the
content as its key, which is immutable. A snapshot takes 10 µs; checking and interpreting a config take 0.3 to 0.6 ms.
"""

from __future__ import annotations

import pickle
from operator import attrgetter

from unprocess_gen.config.schema import GROUPS, BranchConfig, Config, ProvenanceConfig

CLASSES = list(GROUPS.values())
TOP_LEVEL = tuple(name for name in Config.__dataclass_fields__ if name not in (*GROUPS, "seed"))
_groups_of, _others_of = attrgetter(*GROUPS), attrgetter(*TOP_LEVEL)

NOISE = list(GROUPS).index("noise")
PARTS = {"branches": BranchConfig, "provenance": ProvenanceConfig}
"""Lists of the noise profile, and the class of their items. Their fields alone are pickled in half the time."""


def snapshot(config: Config) -> bytes | None:
    """Return the content of a config without its seed.

    Parameters
    ----------
    config : Config
        Any config.

    Returns
    -------
    bytes or None
        Configs with equal bytes have equal content. None if a group or a part of the noise profile is not of the class
        of the schema, or a value cannot be pickled; no valid config has such values.
    """
    groups = _groups_of(config)
    if [*map(type, groups)] != CLASSES:
        return None
    values = [*map(vars, groups), _others_of(config)]
    try:
        noise = values[NOISE] = {**vars(config.noise)}
        for name, kind in PARTS.items():
            if {*map(type, noise[name])} - {kind}:
                return None
            noise[name] = [*map(vars, noise[name])]
        return pickle.dumps(values, pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


def restored(content: bytes) -> Config:
    """Return a config with the content of a snapshot and seed 0, which shares no value with the original.

    Parameters
    ----------
    content : bytes
        From `snapshot`.

    Returns
    -------
    Config
        A new config.
    """
    *values, others = pickle.loads(content)
    for name, kind in PARTS.items():
        values[NOISE][name] = [kind(**fields) for fields in values[NOISE][name]]
    groups = {name: kind(**fields) for (name, kind), fields in zip(GROUPS.items(), values, strict=True)}
    return Config(**groups, **dict(zip(TOP_LEVEL, others, strict=True)))
