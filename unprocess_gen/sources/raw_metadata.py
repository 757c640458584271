"""Read what raw files state about themselves without their pixels: levels, CFA pattern, ISO, exposure and noise.

Raw files with the structure of TIFF (DNG, ARW, CR2, NEF, PEF) are read with tifffile; LibRaw (rawpy) gives what tags do
not. A fact that neither gives is None.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from unprocess_gen.core.errors import ConfigError, MachineError
from unprocess_gen.core.libraries import require

CFA = 32803
"""Value of PhotometricInterpretation for mosaics (TIFF/EP)."""
RATIONALS = (5, 10)
"""Types of fractions (TIFF 6.0, section 2)."""


@dataclass(frozen=True, slots=True)
class RawMetadata:
    """Facts of a raw file; None for those that it does not state.

    Attributes
    ----------
    pattern
        CFA pattern of the top-left 2x2 sites of the visible part, such as RGGB
    black_dn
        black levels of these four sites, row by row
    white_dn, bits
        white level, and bits that hold it
    iso, exposure_s, model
        ISO and exposure time of the frame, and name of the camera
    noise_profile
        S and O of each colour plane, variance = S·x + O with x = 0 at black and 1 at white (NoiseProfile of DNG)
    """

    pattern: str | None = None
    black_dn: tuple[float, ...] | None = None
    white_dn: float | None = None
    bits: int | None = None
    iso: float | None = None
    exposure_s: float | None = None
    model: str | None = None
    noise_profile: tuple[float, ...] | None = None


def read_metadata(path: Path, key: str) -> RawMetadata:
    """Read the facts of a raw file; ``key`` begins messages.

    Raises ConfigError or MachineError.
    """
    tags, decoder = read_tags(path, key), _from_decoder(path, key)
    stated = {name: value for name in RawMetadata.__slots__ if (value := getattr(tags, name)) is not None}
    facts = replace(decoder, **stated)
    return replace(facts, bits=None if facts.white_dn is None else int(facts.white_dn).bit_length())


def read_tags(path: Path, key: str) -> RawMetadata:
    """Read the facts that tags of TIFF, EXIF and DNG state, whatever the compression; none if the file is no TIFF.

    Raises ConfigError or MachineError.
    """
    _require("tifffile", path, key)
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            pages: list[Any] = [page for first in file.pages for page in (first, *(getattr(first, "pages", ()) or ()))]
            raw = next((page for page in pages if page.tags.valueof(262) == CFA), pages[0])
            exif = pages[0].tags.valueof(34665)
            tags = {tag.code: _numbers(tag) for page in (pages[0], raw) for tag in page.tags}
            text = pages[0].tags.valueof(50708) or pages[0].tags.valueof(272) or ""
            return _facts(tags, exif if isinstance(exif, Mapping) else {}, str(text).strip("\0 "))
    except OSError as error:
        raise MachineError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (tifffile.TiffFileError, ValueError, KeyError, IndexError, TypeError):
        return RawMetadata()


def _require(library: str, path: Path, key: str) -> None:
    """Refuse a raw file without the library that reads it."""
    use = f"{key}: {path} is a raw file, which needs {library}"
    require(library, use, "calibrate", ", or convert the frames to NPY")


def _facts(tags: Mapping[int, tuple[float, ...]], exif: Mapping[str, Any], model: str) -> RawMetadata:
    """Collect facts from the tags of TIFF and DNG by code, and from those of EXIF by name."""
    black, white = tags.get(50714, ()), tags.get(50717)
    names = ("ISOSpeedRatings", "PhotographicSensitivity", "ISOSpeed", "RecommendedExposureIndex")
    stated = [exif[name] for name in names if name in exif] + [*tags.get(34855, ()), *tags.get(34867, ())]
    isos = [max(iso) if isinstance(iso, tuple) else iso for iso in stated]
    seconds = exif.get("ExposureTime", tags.get(33434))
    if isinstance(seconds, tuple):
        seconds = seconds[0] / seconds[1] if len(seconds) == 2 else seconds[0]
    return RawMetadata(
        black_dn=(black * 4)[:4] if black and len(set(black)) == 1 else black if len(black) == 4 else None,
        white_dn=max(white) if 50706 in tags and white else None,
        # the largest of 16 bits means that another tag has the ISO
        iso=next((float(iso) for iso in isos if 0 < iso != 65535), None),
        exposure_s=float(seconds) if seconds else None,
        model=model or None,
        noise_profile=tags.get(51041),
    )


def _numbers(tag: Any) -> tuple[float, ...]:
    """Return the values of a tag as numbers, rationals divided; none for text."""
    values = tag.value if isinstance(tag.value, tuple) else (tag.value,)
    if not all(isinstance(value, int | float) for value in values):
        return ()
    if tag.dtype in RATIONALS:
        return tuple(top / bottom if bottom else 0.0 for top, bottom in zip(values[::2], values[1::2], strict=True))
    return tuple(map(float, values))


def _from_decoder(path: Path, key: str) -> RawMetadata:
    """Read levels, pattern, ISO and exposure with LibRaw."""
    _require("rawpy", path, key)
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None or raw.raw_pattern.shape != (2, 2):
                raise ConfigError(f"{key}: {path} contains no Bayer mosaic; expected a raw file with a 2x2 CFA pattern")
            colours, names = raw.raw_colors_visible[:2, :2].ravel().tolist(), raw.color_desc.decode("ascii")
            return RawMetadata(
                pattern="".join(names[colour] for colour in colours),
                black_dn=tuple(float(raw.black_level_per_channel[colour]) for colour in colours),
                white_dn=float(raw.white_level),
                iso=float(raw.other.iso_speed) or None,
                exposure_s=float(raw.other.shutter_speed) or None,
            )
    except OSError as error:
        raise MachineError(f"{path}: cannot be read ({error.strerror or error})") from error
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        raise ConfigError(f"{key}: {path} cannot be decoded ({reason})") from error
