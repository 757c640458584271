"""Record a run below ``.work``, so that processes that share only ``out`` can generate its shards.

    .work/plan.json     version, digests of settings and listing, settings that decide no data, and the canary

The settings themselves are in ``config.yaml``, and the sources in the files of `listing_record`. The canary is one
image of the run. The process that prepares the run records the digest of its rows, which contain the digests of its
frames. Every other process regenerates the canary before its first shard, and generates no shard if the digest differs.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import platform
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from typing import Any

from unprocess_gen.config.interpretation import shading_place
from unprocess_gen.config.schema import Config
from unprocess_gen.config.serialization import parse_dataset_yaml
from unprocess_gen.config.validation import check_values
from unprocess_gen.config.values import error_in_one_line
from unprocess_gen.core.errors import ConfigError, DamageError, MachineError
from unprocess_gen.core.types import Source
from unprocess_gen.dataset.manifest import row_json
from unprocess_gen.dataset.shards import ShardWriter
from unprocess_gen.pipeline.listing_record import ListingRecord, RecordedListing, read_record, write_listing
from unprocess_gen.pipeline.shard_records import ShardRecords
from unprocess_gen.pipeline.storage import WORK, Storage, open_storage
from unprocess_gen.pipeline.tasks import RunContext, ShardReport, ShardTask
from unprocess_gen.pipeline.worker import ShardLog, make_and_commit, make_image
from unprocess_gen.pipeline.workspace import Workspace
from unprocess_gen.sources.dark_frames import DarkPlaces, set_dark_places
from unprocess_gen.sources.listing import Listing, absolute_root

PACKAGE = "unprocess_gen"
PLAN = f"{WORK}/plan.json"

OnCompiling = Callable[[], object]
"""Function that is called before kernels are compiled, so that a user knows why nothing else happens."""

TRIED = 64
"""Sources of which the smallest usable one becomes the canary; without one, only the self-test compares hosts."""


class CanaryError(MachineError):
    """Report a host that makes other bytes than the host that froze the run."""


@dataclass(frozen=True, slots=True)
class FrozenPlan:
    """Hold what all processes of a run must agree on, and the settings that decide no data.

    Attributes
    ----------
    version : str
        Version of unprocess_gen.
    config_sha256 : str
        Digest of ``config.yaml``.
    sources : int
        Number of sources.
    listing_sha256 : tuple of str
        Digests of the listing's files.
    pairs_per_shard : int
        Sources in a shard.
    root : str or None
        Absolute place of the sources; None for built-in scenes.
    max_failed, n_jobs : int
        Settings of the run.
    self_test : str
        Setting of the run.
    not_matched, skipped_links : int
        What the listing left out.
    canary_source : int or None
        Index of the source that every process makes first.
    canary_sha256 : str
        Digest of its rows.
    dark_frames : str or None
        Absolute place of the dark frames; None without them.
    dark_shading : str or None
        Absolute place of the dark-shading map, or of the folder of maps; None without a map.
    """

    version: str
    config_sha256: str
    sources: int
    listing_sha256: tuple[str, ...]
    pairs_per_shard: int
    root: str | None
    max_failed: int
    n_jobs: int
    self_test: str
    not_matched: int
    skipped_links: int
    canary_source: int | None
    canary_sha256: str
    dark_frames: str | None = None
    dark_shading: str | None = None

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.sources // self.pairs_per_shard)

    @property
    def record(self) -> ListingRecord:
        """The recorded listing."""
        return ListingRecord(self.sources, self.listing_sha256)

    @property
    def text(self) -> str:
        """Content of ``plan.json``."""
        return json.dumps(dataclasses.asdict(self), indent=1) + "\n"

    @property
    def sha256(self) -> str:
        """Digest of `text`."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def freeze(
    workspace: Workspace, config: Config, listing: Listing, on_compiling: OnCompiling | None = None
) -> FrozenPlan:
    """Record the plan of a run that `Workspace.begin` has begun, or return the plan that is recorded.

    Parameters
    ----------
    workspace : Workspace
        The begun dataset.
    config : Config
        Its validated config.
    listing : Listing
        Its sources, with which ``workspace`` began.
    on_compiling : callable, optional
        Called before kernels are compiled.

    Returns
    -------
    FrozenPlan
        With the settings of the process that froze the run first.

    Raises
    ------
    ConfigError
        If another version of unprocess_gen froze the run.
    CanaryError
        If this host makes another canary than the one recorded.
    MachineError
        If the self-test fails, or a file cannot be written.
    """
    known = _read_plan(workspace.storage, workspace.out)
    if known is None:
        known = _new_plan(workspace, config, listing, on_compiling)
        if workspace.storage.create(PLAN, known.text):
            return known
        known = _read_plan(workspace.storage, workspace.out) or known
    check_version(known, workspace.out)
    check_canary(known, config, listing.sources, on_compiling)
    return known


def _new_plan(workspace: Workspace, config: Config, listing: Listing, on_compiling: OnCompiling | None) -> FrozenPlan:
    record = read_record(workspace.storage, workspace.out)
    if record is None:  # version 0.1 began the dataset
        record = write_listing(workspace.storage, workspace.out, listing.sources)
    smallest_first = sorted(listing.sources[:TRIED], key=lambda source: source.size_bytes or 0)
    canary = next(_canaries(config, smallest_first, on_compiling), (None, ""))
    return FrozenPlan(
        version=version(PACKAGE),
        config_sha256=hashlib.sha256(workspace.config_yaml.encode()).hexdigest(),
        sources=record.sources,
        listing_sha256=record.sha256,
        pairs_per_shard=config.output.pairs_per_shard,
        root=absolute_root(config.source.root),
        max_failed=config.source.max_failed,
        n_jobs=config.n_jobs,
        self_test=config.self_test,
        not_matched=listing.not_matched,
        skipped_links=listing.skipped_links,
        canary_source=canary[0],
        canary_sha256=canary[1],
        dark_frames=absolute_root(config.noise.dark_frames),
        dark_shading=absolute_root(shading_place(config.noise)),
    )


def _canaries(config: Config, sources: Sequence[Source], on_compiling: OnCompiling | None) -> Iterator[tuple[int, str]]:
    """Yield the index of each usable source, and the digest of its rows."""
    storage = open_storage(config.out)
    context = RunContext(config, str(storage.scratch), os.getpid(), on_compiling=on_compiling)
    path = storage.scratch / "canary.tar"
    try:
        for source in sources:
            with ShardWriter(path) as writer:
                rows = make_image(context, 0, source, writer, ShardLog())
            path.unlink()
            if rows[0]["status"] == "ok":
                yield source.index, hashlib.sha256(row_json(rows)).hexdigest()
    finally:
        storage.close()


def read_plan(storage: Storage, out: str) -> FrozenPlan:
    """Return the plan of a run that this version of unprocess_gen can continue.

    Parameters
    ----------
    storage : Storage
        Where the dataset is written.
    out : str
        Its place, for messages.

    Returns
    -------
    FrozenPlan
        The plan.

    Raises
    ------
    ConfigError
        If there is none, another version froze it, or ``config.yaml`` or the listing are not those of the plan.
    DamageError
        If the plan cannot be read.
    """
    plan = _read_plan(storage, out)
    if plan is None:
        raise ConfigError(f"out={out}: contains no plan of a run in parts; expected one; run gen-dataset prepare first")
    check_version(plan, out)
    if hashlib.sha256(storage.read("config.yaml").encode()).hexdigest() != plan.config_sha256:
        raise ConfigError(f"out={out}: its config.yaml is not the one that was prepared; prepare another out")
    if read_record(storage, out) != plan.record:
        raise ConfigError(f"out={out}: its listing of sources is not the one that was prepared; prepare another out")
    return plan


def _read_plan(storage: Storage, out: str) -> FrozenPlan | None:
    try:
        values: dict[str, Any] = json.loads(storage.read(PLAN))
        return FrozenPlan(**values | {"listing_sha256": tuple(values["listing_sha256"])})
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError) as error:
        raise DamageError(
            f"{out}/{PLAN}: cannot be read ({error_in_one_line(error)}); remove the folder and start again"
        ) from error


def check_version(plan: FrozenPlan, out: str) -> None:
    """Raise ConfigError if another version of unprocess_gen froze the run."""
    if plan.version != version(PACKAGE):
        raise ConfigError(
            f"out={out}: was begun by {PACKAGE} {plan.version}, this is {version(PACKAGE)}; use that version, or "
            "prepare another out"
        )


def check_canary(
    plan: FrozenPlan, config: Config, sources: Sequence[Source], on_compiling: OnCompiling | None = None
) -> None:
    """Make the canary of a plan once per process, and compare it.

    Parameters
    ----------
    plan : FrozenPlan
        The plan.
    config : Config
        Its config.
    sources : sequence of Source
        Sources that include the canary.
    on_compiling : callable, optional
        Called before kernels are compiled.

    Raises
    ------
    CanaryError
        If its rows differ.
    MachineError
        If the self-test fails, or the source was changed or deleted.
    """
    if plan.canary_source is None:
        return
    canary = [source for source in sources if source.index == plan.canary_source]
    found = next(_canaries(config, canary, on_compiling), (None, ""))
    if found != (plan.canary_source, plan.canary_sha256):
        raise CanaryError(
            f"{platform.node()} makes other bytes from source {canary[0].name} than the host that began the run; "
            "expected the same; install the same versions of its libraries"
        )


class FrozenRun:
    """Make shards of a frozen run; `open_run` returns one.

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
        self.out = out
        self.storage = open_storage(out)
        self.records = ShardRecords(self.storage, out)
        self.plan = read_plan(self.storage, out)
        self.config = self._config(root)
        self._listing = RecordedListing(self.storage, out, self.plan.record)
        self._making = threading.Lock()
        self._is_checked = False

    def _config(self, root: str | None) -> Config:
        plan = self.plan
        try:
            config, _ = parse_dataset_yaml(self.storage.read("config.yaml"))
            check_values(config)
        except (ValueError, ConfigError) as error:
            raise DamageError(f"{self.out}/config.yaml: cannot be read ({error_in_one_line(error)})") from error
        config.out, config.source.root = self.out, root or plan.root
        set_dark_places(config, DarkPlaces(plan.dark_frames, plan.dark_shading))
        config.source.max_failed, config.n_jobs, config.self_test = plan.max_failed, plan.n_jobs, plan.self_test
        return config

    def check_host(self, on_compiling: OnCompiling | None = None) -> None:
        """Run the self-test and make the canary, unless it was done before; arguments and errors of `check_canary`."""
        index = self.plan.canary_source
        if index is not None and not self._is_checked:
            check_canary(self.plan, self.config, self._listing.sources(index, index + 1), on_compiling)
        self._is_checked = True

    def tasks(self, shards: Iterable[int]) -> Iterator[ShardTask]:
        """Yield the tasks of shards in ascending order; only the listing files of their sources are read."""
        size = self.plan.pairs_per_shard
        for shard in shards:
            last = min((shard + 1) * size, self.plan.sources)
            yield ShardTask(shard, tuple(self._listing.sources(shard * size, last)))

    def make(self, shards: Iterable[int]) -> Iterator[ShardReport]:
        """Make and commit shards that are not committed; yield a report of each.

        One shard is made at a time in a process, whatever the number of threads that call this method.

        Parameters
        ----------
        shards : iterable of int
            Numbers of shards.

        Yields
        ------
        ShardReport
            For each shard that this call made.

        Raises
        ------
        MachineError
            If a file cannot be read or written, or a source was changed or deleted.
        """
        for shard in shards:
            with self._making:
                if self.records.is_committed(shard):
                    continue
                (task,) = self.tasks([shard])
                context = RunContext(self.config, str(self.storage.scratch), None, counts_deaths=True)
                report = make_and_commit(context, task)
            yield report


def open_run(out: str, plan_sha256: str, root: str | None = None, on_compiling: OnCompiling | None = None) -> FrozenRun:
    """Return a frozen run for this process, after the self-test and the canary.

    Parameters
    ----------
    out : str
        Folder of the dataset.
    plan_sha256 : str
        Digest of the plan (`FrozenPlan.sha256`), so that a later run in the same folder is another one.
    root : str, optional
        Place of the sources, if they were moved since the run was frozen.
    on_compiling : callable, optional
        Called before kernels are compiled.

    Returns
    -------
    FrozenRun
        The same object for every call with the same arguments.

    Raises
    ------
    ConfigError, DamageError
        As `read_plan`.
    CanaryError, MachineError
        As `check_canary`.
    """
    with _OPENING:
        run = _open_run(out, plan_sha256, root)
        run.check_host(on_compiling)
        return run


_OPENING = threading.Lock()


@lru_cache(maxsize=2)
def _open_run(out: str, plan_sha256: str, root: str | None) -> FrozenRun:
    run = FrozenRun(out, root)
    if run.plan.sha256 != plan_sha256:
        raise ConfigError(f"out={out}: its plan is not that of this run; prepare another out")
    return run
