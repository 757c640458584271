"""Regenerate pairs from manifest rows and compare them with the digests in the rows.

A replay needs the row and the source; no config file and no other row. A source that was changed or deleted is not
damage of the dataset: it is reported separately, with exit code 5 instead of 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from unprocess_gen.core.errors import ConfigError, DamageError, SourceChangedError
from unprocess_gen.core.files import array_xxh3, machine_errors
from unprocess_gen.core.output_paths import check_output_folder
from unprocess_gen.core.paths import AnyPath
from unprocess_gen.core.source import NO_CLIP, Source
from unprocess_gen.core.targets import LINEAR_RGB
from unprocess_gen.dataset.columns import Row
from unprocess_gen.dataset.keys import image_key
from unprocess_gen.dataset.row import has_frames, patch_from_row, plan_from_row
from unprocess_gen.dataset.shards import arrays_of
from unprocess_gen.pipeline.pairs import PlannedImage, Targets
from unprocess_gen.simulation import self_test
from unprocess_gen.simulation.plan import Plan
from unprocess_gen.sources.dark_frames import DarkFolder, dark_folder
from unprocess_gen.sources.names import decode_name
from unprocess_gen.sources.recorded_photographs import RecordedPhotographs


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """The outcome for one row.

    ``complaint`` says what differs; it is empty if the pair is the same, bit for bit. With ``source_changed`` the
    source was changed or deleted, so that the row could not be checked. ``compared`` is False without digests.
    """

    key: str
    source: str
    complaint: str = ""
    source_changed: bool = False
    written: bool = False
    compared: bool = True

    @property
    def exit_code(self) -> int:
        """Exit code for this row alone: 0 same, 4 damage, 5 changed source."""
        if not self.complaint:
            return 0
        return SourceChangedError.exit_code if self.source_changed else DamageError.exit_code


def check_root(folder: AnyPath, kind: str, root: str | None, verb: str = "") -> None:
    """Raise ConfigError if sources of this kind are files and their place is unknown; ``verb`` begins the sentence."""
    if "synthetic" not in kind and root is None:
        raise ConfigError(
            f"{verb}source.root is missing: {folder} does not record the folder of its sources; expected that "
            "folder; give source.root=…"
        )


def replay(
    rows: Iterable[Row], root: str | None, to: Path | None = None, dark_frames: str | None = None
) -> Iterator[ReplayResult]:
    """Regenerate the pairs of rows and compare them with the rows' digests.

    Raises ConfigError if a row was made from a file and ``root`` is None, ``to`` is inside a dataset or no folder, or a
    row has no digests and ``to`` is None; MachineError if the self-test fails, or the arrays cannot be written.
    """
    if to is not None:
        check_output_folder(to, f"--to {to}")
    regenerator = PairRegenerator(root, dark_frames)
    for row in rows:
        if row["status"] != "ok":
            continue
        if to is None and not has_frames(row):
            raise ConfigError(
                f"row {row['key']}: has no digests to compare, because its dataset has no frames "
                "(output.frames=false); expected a manifest with digests; add --to FOLDER to write the arrays"
            )
        key, source, compared = str(row["key"]), str(row["source"]), has_frames(row)
        try:
            arrays = regenerator.regenerate(row)
        except (SourceChangedError, DamageError) as error:
            yield ReplayResult(key, source, str(error), isinstance(error, SourceChangedError))
            continue
        if to is not None:
            with machine_errors(to):
                to.mkdir(parents=True, exist_ok=True)
                for name, array in arrays.items():
                    np.save(to / f"{key}.{name}.npy", array)
        yield ReplayResult(key, source, _difference(arrays, row) if compared else "", False, to is not None, compared)


class PairRegenerator:
    """Regenerate pairs from rows and the folder of their sources, ``root``; synthetic pictures need none.

    ``dark_frames`` is the folder of the dark frames that rows name.
    """

    def __init__(self, root: str | None, dark_frames: str | None = None) -> None:
        self._photographs, self._dark_frames = RecordedPhotographs(root), dark_frames

    def regenerate(self, row: Row) -> Targets:
        """Make the frames and targets of a row by name, without comparing their digests.

        Raises SourceChangedError if the source was changed or deleted, DamageError if the row has no valid plan,
        ConfigError if the row was made from a file and there is no root, MachineError if the self-test fails.
        """
        plan, names = plan_from_row(row), [LINEAR_RGB] if row["targets"] else []
        self_test.check([plan], names)
        photograph = self._photographs.load(source_of(row), str(row["source_sha256"]), plan.source)
        plan, patch = plan.decoded(photograph.profile, photograph.pixels_xxh3), patch_from_row(row)
        height, width = (side // plan.pixel_side for side in photograph.srgb.shape[:2])
        if patch.patch_y + patch.height > height or patch.patch_x + patch.width > width:
            raise DamageError(
                f"its patch of {patch.width} x {patch.height} pixels at row {patch.patch_y}, column {patch.patch_x} "
                f"exceeds its source of {width} x {height} pixels"
            )
        image = PlannedImage(photograph.srgb, (plan,), (patch,), dark_folder=self._dark_pixels(plan))
        try:
            sample = next(image.samples())
        except ValueError as error:  # an edited manifest, whose motion leads outside
            raise DamageError(str(error)) from error
        pair = next(sample.pairs())
        return {"clean": pair.clean, "noisy": pair.noisy, **sample.targets(names, pair)}

    def _dark_pixels(self, plan: Plan) -> DarkFolder | None:
        """Give access to the dark frames; SourceChangedError if the plan needs one and there is no folder."""
        if plan.dark is None:
            return None
        if self._dark_frames is None:
            raise SourceChangedError(
                f"noise.dark_frames is missing: the row names the dark frame {plan.dark.dark_frame}; expected the "
                "folder of the dark frames; give noise.dark_frames=…"
            )
        try:
            return dark_folder(self._dark_frames)
        except ConfigError as error:
            raise SourceChangedError(str(error)) from error

    def regenerate_exactly(self, row: Row) -> Targets:
        """Make the arrays of a row; raise as `regenerate`, and DamageError if they have other digests."""
        arrays = self.regenerate(row)
        if difference := _difference(arrays, row):
            raise DamageError(difference)
        return arrays


def _difference(arrays: Targets, row: Row) -> str:
    return "; ".join(
        f"the XXH3-128 of {name} is {digest}, the row records {stored.digest}"
        for name, stored in arrays_of(row).items()
        if (digest := array_xxh3(arrays[name])) != stored.digest
    )


def source_of(row: Row) -> Source:
    """Source that a row was made from."""
    name, size = str(row["source"]), row["source_bytes"]
    path = decode_name(name)
    size, of_clip = size if isinstance(size, int) else None, row["motion_y"] is None  # frames of bursts share a source
    clip, frame = (str(row["clip"]), int(row["frame"] or 0)) if of_clip else (NO_CLIP, 0)
    return Source(int(image_key(row)), name, path, size, clip=clip, frame=frame)
