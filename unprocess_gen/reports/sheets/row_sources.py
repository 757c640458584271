"""Load the source pixels that a manifest row was made from.

`pairs` imports this module when it needs a source, because the decoders of `sources` import Numba.
"""

from __future__ import annotations

from unprocess_gen.config.schema import SourceConfig
from unprocess_gen.core.errors import ConfigError, MachineError, SourceError
from unprocess_gen.core.types import Row, Srgb
from unprocess_gen.pipeline.replay import ADVICE, NO_LIMIT, source_of
from unprocess_gen.sources.loader import load_source


def load_row_source(row: Row, root: str | None) -> tuple[Srgb | None, str]:
    """Return the full source image of a row, or None and the reason why it is not available.

    ``root`` is the folder of the photographs; built-in scenes need none.
    """
    is_scene = row["source_bytes"] == 0
    if root is None and not is_scene:
        return None, "the dataset does not record where its photographs are; give --source ROOT"
    config = SourceConfig(root=None if is_scene else root, max_pixels=NO_LIMIT, downscale=int(row["downscale"] or 1))
    try:
        sha256, photograph = load_source(config, source_of(row))
    except (SourceError, MachineError, ConfigError) as error:  # the sheet is drawn without this photograph
        return None, f"{str(error).partition(';')[0]}; {ADVICE}"
    if sha256 != row["source_sha256"]:
        return None, f"it has changed: its SHA-256 differs from the row's; {ADVICE}"
    return photograph.srgb, ""
