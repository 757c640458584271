"""Record a run below ``.work``, so that processes that share only ``out`` can generate its shards.

    .work/plan.json     version, digests of settings and listing, settings that decide no data, and the canary

The settings themselves are in ``config.yaml``, and the sources in files of `run_records`. The canary is one
image of the run. The process that prepares the run records the digest of its rows, which contain the digests of its
frames. Every other process regenerates the canary before its first shard, and generates no shard if the digest differs.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from functools import cached_property, lru_cache
from importlib.metadata import version
from typing import Annotated

import msgspec

from unprocess_gen.config.schema import Config, replaced
from unprocess_gen.config.serialization import parse_dataset_yaml
from unprocess_gen.config.validation import check_values
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.paths import absolute_text
from unprocess_gen.core.records import Count, Digest, parse_record
from unprocess_gen.core.types import Source
from unprocess_gen.dataset.manifest import row_json
from unprocess_gen.dataset.shards import ShardWriter
from unprocess_gen.pipeline.pairs import PairSettings
from unprocess_gen.pipeline.run import Run
from unprocess_gen.pipeline.run_records import INDEX, RecordedListing, ShardRecords, text_sha256, write_listing
from unprocess_gen.pipeline.storage import WORK, Storage
from unprocess_gen.pipeline.tasks import RunContext, ShardLog, ShardReport, ShardTask
from unprocess_gen.pipeline.worker import make_and_commit, make_image
from unprocess_gen.pipeline.workspace import Workspace

PACKAGE = "unprocess_gen"
PLAN = f"{WORK}/plan.json"

OnCompiling = Callable[[], object]
"""Function that is called before kernels are compiled, so that a user knows why nothing else happens."""

TRIED = 64
"""Sources of which the smallest usable one becomes the canary; without one, only the self-test compares hosts."""


Positive = Annotated[int, msgspec.Meta(ge=1, le=2**63 - 1)]


class CanaryError(MachineError):
    """Report a host that makes other bytes than the host that froze the run."""


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
    canary_source : int or None
        Index of the source that every process makes first; None without a usable one.
    canary_sha256 : str
        Digest of its rows.
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
    canary_source: Count | None
    canary_sha256: str
    dark_frames: str | None = None
    parts: Positive | None = None

    def __post_init__(self) -> None:
        if self.parts is not None and self.parts > self.shards:
            raise ValueError(f"parts={self.parts}: expected 1 to {self.shards}, the number of shards")

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.sources // self.pairs_per_shard)

    def sources_of(self, shard: int) -> tuple[int, int]:
        """Index of the first source of a shard, and of the one after its last."""
        first = shard * self.pairs_per_shard
        return first, min(first + self.pairs_per_shard, self.sources)

    @property
    def text(self) -> str:
        """Content of ``plan.json``."""
        return json.dumps(msgspec.structs.asdict(self), indent=1) + "\n"


def freeze_run(
    workspace: Workspace, run: Run, on_compiling: OnCompiling | None = None, parts: int | None = None
) -> FrozenPlan:
    """Record the plan of a run that `Workspace.begin` has begun, or continue the plan that is recorded.

    Raises ConfigError if another version of unprocess_gen froze the run, CanaryError if this host makes another canary
    than the one recorded, MachineError if the self-test fails or a file cannot be written.
    """
    storage = workspace.storage
    plan = recorded_plan(storage)
    if plan is None:
        plan = _new_plan(workspace, run, on_compiling, parts)
        if storage.create(PLAN, plan.text):
            return plan
        plan = recorded_plan(storage) or plan
    check_canary(plan, run.settings, run.sources, on_compiling)
    if parts is not None and plan.parts is None:  # a run on a cluster is continued in parts
        plan = msgspec.structs.replace(plan, parts=parts)
        storage.write(PLAN, plan.text)
    return plan


def _new_plan(workspace: Workspace, run: Run, on_compiling: OnCompiling | None, parts: int | None) -> FrozenPlan:
    if (workspace.storage / INDEX).size() is None:  # version 0.1 began the dataset
        write_listing(workspace.storage, run.sources)
    smallest_first = sorted(run.sources[:TRIED], key=lambda source: source.size_bytes or 0)
    index, sha256 = _make_canary(run.settings, smallest_first, on_compiling)
    config = run.config
    return FrozenPlan(
        version=version(PACKAGE),
        config_sha256=text_sha256(workspace.config_yaml),
        sources=len(run.sources),
        listing_sha256=text_sha256(workspace.storage.read(INDEX)),
        pairs_per_shard=config.output.pairs_per_shard,
        root=absolute_text(config.source.place),
        max_failed=config.source.max_failed,
        n_jobs=config.n_jobs,
        self_test=config.self_test,
        not_matched=run.listing.not_matched,
        skipped_links=run.listing.skipped_links,
        canary_source=index,
        canary_sha256=sha256,
        dark_frames=absolute_text(config.noise.dark_frames),
        parts=parts,
    )


def _make_canary(
    settings: PairSettings, sources: Iterable[Source], on_compiling: OnCompiling | None
) -> tuple[int | None, str]:
    """Make the first usable source; return its index and the digest of its rows, None and "" without one."""
    with closing(Storage(settings.config.out)) as storage:
        context = RunContext(settings, str(storage.scratch), os.getpid(), on_compiling=on_compiling)
        path = storage.scratch / "canary.tar"
        for source in sources:
            with ShardWriter(path) as writer:
                rows = make_image(context, 0, source, writer, ShardLog())
            path.unlink()
            if rows[0]["status"] == "ok":
                return source.index, hashlib.sha256(row_json(rows)).hexdigest()
        return None, ""


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


def check_canary(
    plan: FrozenPlan, settings: PairSettings, sources: Sequence[Source], on_compiling: OnCompiling | None = None
) -> None:
    """Make the canary of a plan, which is among the sources, and compare it.

    Raises CanaryError if its rows differ, MachineError if the self-test fails, or the source was changed or deleted.
    """
    if plan.canary_source is None:
        return
    canary = [source for source in sources if source.index == plan.canary_source]
    made = _make_canary(settings, canary, on_compiling)
    if made != (plan.canary_source, plan.canary_sha256):
        raise CanaryError(
            f"{platform.node()} makes other bytes from source {canary[0].name} than the host that began the run; "
            "expected the same; install the same versions of its libraries"
        )


class FrozenRun:
    """Make shards of a frozen run in this process.

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

    def check_host(self, on_compiling: OnCompiling | None = None) -> None:
        """Run the self-test and make the canary; errors are those of `check_canary`."""
        if (index := self.plan.canary_source) is not None:
            check_canary(self.plan, self.settings, [*self._listing.sources(index, index + 1)], on_compiling)

    def has_ended(self) -> bool:
        """Check whether another process has finished the run meanwhile, and deleted its plan."""
        return (self.storage / PLAN).size() is None

    def task(self, shard: int) -> ShardTask:
        """Read the sources of a shard."""
        return ShardTask(shard, tuple(self._listing.sources(*self.plan.sources_of(shard))))

    def make(self, shard: int) -> ShardReport | None:
        """Make and commit a shard, or return None if it is committed; one at a time in a process.

        Raises MachineError if a file cannot be read or written, or a source was changed or deleted.
        """
        with _ONE_AT_A_TIME:
            if self.records.is_committed(shard):
                return None
            context = RunContext(self.settings, str(self.storage.scratch), None, counts_deaths=True)
            return make_and_commit(context, self.task(shard))


_ONE_AT_A_TIME = threading.Lock()


def open_run(out: str, plan_sha256: str, root: str | None = None) -> FrozenRun:
    """Open a frozen run once for this process, and check the host.

    ``plan_sha256`` identifies the run, because a later one can be in the same folder; ``root`` is the place of the
    sources if they were moved. Raises ConfigError and DamageError as `read_plan`, CanaryError and MachineError as
    `check_canary`.
    """
    with _ONE_AT_A_TIME:
        return _open_run(out, plan_sha256, root)


@lru_cache(maxsize=2)
def _open_run(out: str, plan_sha256: str, root: str | None) -> FrozenRun:
    run = FrozenRun(out, root)
    if text_sha256(run.plan.text) != plan_sha256:
        raise ConfigError(f"out={out}: its plan is not that of this run; prepare another out")
    run.check_host()
    return run
