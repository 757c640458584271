"""Record a run in parts below ``.work``, so that processes that share only ``out`` can generate its shards.

    .work/plan.json     version, digests of settings and listing, settings that decide no data, and the number of parts

The settings themselves are in ``config.yaml``, and the sources in files of `run_records`.
"""

from __future__ import annotations

import json
from functools import cached_property
from importlib.metadata import version
from typing import Annotated

import msgspec

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import parse_dataset_yaml
from unprocess_gen.config.validation import check_values
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError
from unprocess_gen.core.paths import absolute_text
from unprocess_gen.core.records import Count, Digest, parse_record
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.run import Run
from unprocess_gen.pipeline.run_records import INDEX, RecordedListing, ShardRecords, text_sha256
from unprocess_gen.pipeline.storage import WORK, Storage
from unprocess_gen.pipeline.tasks import ShardTask
from unprocess_gen.pipeline.workspace import Workspace

PACKAGE = "unprocess_gen"
PLAN = f"{WORK}/plan.json"

Positive = Annotated[int, msgspec.Meta(ge=1, le=2**63 - 1)]


class FrozenPlan(msgspec.Struct, frozen=True):
    """Hold what all processes of a run must agree on, and the settings that decide no data.

    Attributes
    ----------
    config_sha256, listing_sha256 : str
        Digests of ``config.yaml`` and of the index of the recorded listing.
    root, dark_frames : str or None
        Absolute places of the sources and the dark frames; None without them.
    not_matched, skipped_links : int
        What the listing left out.
    """

    version: str
    config_sha256: Digest
    sources: Count
    listing_sha256: Digest
    pairs_per_shard: Positive
    root: str | None
    max_failed: Count
    n_jobs: int
    self_test: str
    not_matched: Count
    skipped_links: Count
    parts: Positive
    dark_frames: str | None = None

    def __post_init__(self) -> None:
        if self.parts > self.shards:
            raise ValueError(f"parts={self.parts}: expected 1 to {self.shards}, the number of shards")

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.sources // self.pairs_per_shard)

    def sources_of(self, shard: int) -> tuple[int, int]:
        """Index of the first source of a shard, and of the one after its last."""
        first = shard * self.pairs_per_shard
        return first, min(first + self.pairs_per_shard, self.sources)


def freeze_run(workspace: Workspace, run: Run, parts: int) -> FrozenPlan:
    """Record the plan of a run that `Workspace.begin` has begun, or return the plan that is recorded.

    Raises ConfigError if another version of unprocess_gen froze the run, MachineError if a file cannot be written.
    """
    storage, config = workspace.storage, run.config
    plan = FrozenPlan(
        version=version(PACKAGE),
        config_sha256=text_sha256(workspace.config_yaml),
        sources=len(run.sources),
        listing_sha256=text_sha256(storage.read(INDEX)),
        pairs_per_shard=config.output.pairs_per_shard,
        root=absolute_text(config.source.place),
        max_failed=config.source.max_failed,
        n_jobs=config.n_jobs,
        self_test=config.self_test,
        not_matched=run.listing.not_matched,
        skipped_links=run.listing.skipped_links,
        dark_frames=absolute_text(config.noise.dark_frames),
        parts=parts,
    )
    if storage.create(PLAN, json.dumps(msgspec.structs.asdict(plan), indent=1) + "\n"):
        return plan
    return recorded_plan(storage) or plan


def recorded_plan(storage: Storage) -> FrozenPlan | None:
    """Read the plan of a run, None if there is none; raise ConfigError if another version recorded it."""
    if not (storage / PLAN).is_listed():
        return None
    plan = storage.record(PLAN, lambda content: parse_record(content, FrozenPlan))
    if plan.version != version(PACKAGE):
        raise ConfigError(
            f"out={storage.out}: was begun by {PACKAGE} {plan.version[:20]}, this is {version(PACKAGE)}; use that "
            "version, or prepare another out"
        )
    return plan


def read_plan(storage: Storage) -> FrozenPlan:
    """Read the plan of a run; raise ConfigError without one, or if ``config.yaml`` or the listing are not its own."""
    plan = recorded_plan(storage)
    if plan is None:
        raise ConfigError(
            f"out={storage.out}: contains no plan of a run in parts; expected one; run gen-dataset prepare first"
        )
    for name, sha256 in (("config.yaml", plan.config_sha256), (INDEX, plan.listing_sha256)):
        try:
            is_prepared = text_sha256(storage.read(name)) == sha256
        except (FileNotFoundError, ValueError):  # was deleted, is no regular file or not UTF-8
            is_prepared = False
        if not is_prepared:
            what = "listing of sources" if name == INDEX else name
            raise ConfigError(f"out={storage.out}: its {what} is not the one that was prepared; prepare another out")
    if (count := RecordedListing(storage).count) != plan.sources:
        raise storage.unusable(PLAN, f"sources={plan.sources}: expected {count}, as in {INDEX}")
    return plan


class FrozenRun:
    """Read a frozen run.

    Attributes
    ----------
    plan : FrozenPlan
        The plan.
    config : Config
        The config, with the settings of the plan that decide no data.
    storage : Storage
        Where the dataset is written.
    records : ShardRecords
        The committed shards.
    """

    def __init__(self, out: str, root: str | None = None) -> None:
        self.storage = Storage(out)
        self.records = ShardRecords(self.storage)
        self.plan = read_plan(self.storage)
        self.config = self._config(root)
        self._listing = RecordedListing(self.storage)

    def _config(self, root: str | None) -> Config:
        plan = self.plan
        try:
            config, _ = parse_dataset_yaml(self.storage.read("config.yaml"))
            check_values(config)
        except (ValueError, ConfigError) as error:
            raise DamageError(f"{self.storage.out}/config.yaml: cannot be read ({error_in_one_line(error)})") from error
        changes = {"out": self.storage.out, "n_jobs": plan.n_jobs, "self_test": plan.self_test}
        changes |= {
            "source.root": root or plan.root,
            "source.max_failed": plan.max_failed,
            "noise.dark_frames": plan.dark_frames,
        }
        return replaced(config, changes)

    @cached_property
    def settings(self) -> PairSettings:
        """The config with its dark frames, which this process reads."""
        return PairSettings.read(self.config)

    def task(self, shard: int) -> ShardTask:
        """Read the sources of a shard."""
        return ShardTask(shard, tuple(self._listing.sources(*self.plan.sources_of(shard))))
