"""Describe what a body, a real camera whose options fit together, leaves to other options."""

from __future__ import annotations

from unprocess_gen.config.schema import Config

NOUNS = {"camera": "colour matrix", "sensor": "set of raw levels", "noise": "noise profile"}
"""What the options of a body's groups contain."""


def body_sentence(config: Config) -> str:
    """Return a sentence about the groups for which no numbers of the body are published; empty without any."""
    body = config.body
    missing = [group for group in body.missing if group != "camera" or config.source.kind != "raw"]
    sentences = [f"no {NOUNS[group]} of it is published, so {_chosen(config, group)} applies" for group in missing]
    return f"body={body.name}: {'; '.join(sentences)}" if body.name is not None and sentences else ""


def _chosen(config: Config, group: str) -> str:
    name = getattr(getattr(config, group), "name", None)
    return f"the setting {group}" if name is None else f"{group}={name}"
