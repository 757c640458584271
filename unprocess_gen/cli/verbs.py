"""List the verbs of ``gen-dataset`` in the order of the help."""

from __future__ import annotations

from unprocess_gen.cli import cameras, checks, reports, runs, scores
from unprocess_gen.cli.arguments import Verb

_VERBS: tuple[Verb, ...] = (
    runs.generate,
    runs.manifest,
    runs.part,
    runs.merge,
    reports.plan,
    reports.accuracy,
    checks.verify,
    checks.replay,
    reports.report,
    reports.explore,
    reports.preview,
    reports.dng,
    runs.again,
    runs.build,
    cameras.calibrate,
    cameras.camera,
    scores.score,
)

VERBS = {verb.name: verb for verb in _VERBS}
"""The verbs by name."""
