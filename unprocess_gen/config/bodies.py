"""Describe what a config takes from its body, a real camera whose options fit together."""

from __future__ import annotations

from unprocess_gen.config.schema import Config

NOUNS = {"camera": "colour matrix", "sensor": "set of raw levels", "noise": "noise profile"}
"""What the options of a body's groups contain."""


def body_sentence(config: Config) -> str:
    """Return a sentence about what a config does not take from its body; empty if it has all, or there is none."""
    body = config.body
    missing = [group for group in body.missing if group != "camera" or config.source.kind != "raw"]
    sentences = [f"no {NOUNS[group]} of it is published, so {_chosen(config, group)} applies" for group in missing]
    if body.replaced:
        sentences.append(f"settings that take precedence over it: {', '.join(body.replaced)}")
    return f"body={body.name}: {'; '.join(sentences)}" if body.name is not None and sentences else ""


def _chosen(config: Config, group: str) -> str:
    name = getattr(getattr(config, group), "name", None)
    return f"the setting {group}" if name is None else f"{group}={name}"
