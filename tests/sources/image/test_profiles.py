"""Colours that photographs declare: against littlecms, what counts as sRGB, what goes first, and what is refused."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
from helpers.icc import ADOBE, PROFILES, SRGB_PARAMETERS, curv, fixed, icc, para, profile_of_tags, tags_of
from PIL import Image, ImageCms

from unprocess_gen.core.errors import SourceError
from unprocess_gen.simulation.profiles import Profile, light_tables
from unprocess_gen.simulation.reference.primaries import PRIMARIES
from unprocess_gen.sources.image.decode import read_profile
from unprocess_gen.sources.image.headers import Header
from unprocess_gen.sources.image.profiles import profile_of

CHART = bytes.fromhex(
    "735244c29682627a9d576c4385 80b167bdaad67e2c505ba6c15a635e3c6c9dbc40e0a32e383d9646944 9af363ce7c71fbb5695"
    "0885a1f3f3f2c8c8c8a0a0a07a7a79555555343434".replace(" ", "")
)
"""The 24 patches of a ColorChecker in sRGB."""
PATCHES = np.frombuffer(CHART, np.uint8).reshape(1, 24, 3)

_P3 = PRIMARIES["p3"]
RAMP = [round(65535 * (n / 1023) ** 2.2) for n in range(1024)]
RAMP_OF_SRGB = [round(65535 * light) for light in light_tables(Profile(), "none", "srgb", 1024)[0]]
PROFILES_OF_CURVES = {
    "curv of 1024": icc(_P3, curv(*RAMP)),
    "curv of 0": icc(_P3, curv()),
    "three curves": icc(_P3, para(0, 1.8), para(0, 2.0), para(0, 2.2)),
    "para 1": icc(ADOBE, para(1, 2.2, 1 / 1.1, 0.1 / 1.1)),
    "para 2": icc(ADOBE, para(2, 2.2, 1 / 1.1, 0.1 / 1.1, 0.0)),
    "para 4": icc(ADOBE, para(4, 2.0, 0.9, 0.1, 0.1, 0.05, 0.0, 0.005)),
}


def declared(profile: bytes) -> Profile:
    return profile_of(Header("jpeg", 1, 1, icc=profile))


def by_littlecms(codes: np.ndarray, source: object, target: object) -> np.ndarray:
    relative = ImageCms.Intent.RELATIVE_COLORIMETRIC
    transform = ImageCms.buildTransform(source, target, "RGB", "RGB", renderingIntent=relative)
    return np.asarray(ImageCms.applyTransform(Image.fromarray(codes), transform))


def srgb_codes(codes: np.ndarray, profile: Profile) -> np.ndarray:
    """Unrounded 8-bit codes of sRGB by the table and the matrix of a profile, by formulas of this test."""
    assert profile.to_srgb is not None
    tables = light_tables(profile, "none", "srgb", 256)
    light = (
        np.stack([table[codes[..., n]] for n, table in enumerate(tables)], -1) @ np.reshape(profile.to_srgb, (3, 3)).T
    )
    light = np.clip(light, 1e-9, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) * 255


@pytest.mark.parametrize(
    "content", [*PROFILES.values(), *PROFILES_OF_CURVES.values()], ids=[*PROFILES, *PROFILES_OF_CURVES]
)
def test_charts_are_within_a_code_of_littlecms(content: bytes) -> None:
    other, srgb = ImageCms.ImageCmsProfile(io.BytesIO(content)), ImageCms.createProfile("sRGB")
    codes = by_littlecms(PATCHES, srgb, other)
    expected = by_littlecms(codes, other, srgb).astype(int)
    assert np.abs(np.rint(srgb_codes(codes, declared(content))) - expected).max() <= 1
    assert np.abs(codes.astype(int) - expected).max() > 5  # the profile matters


# sRGB, and names ------------------------------------------------------------------------------------------------------

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
S_PARAMETERS = para(3, *SRGB_PARAMETERS)
COLUMNS = (0.43585, 0.22238, 0.01392), (0.38533, 0.71704, 0.09714), (0.14302, 0.06059, 0.71384)
COLORANTS = {b"%cXYZ" % c: b"XYZ \0\0\0\0" + fixed(*xyz) for c, xyz in zip(b"rgb", COLUMNS, strict=True)}
NEARLY = profile_of_tags(tags_of(PRIMARIES["srgb"], curv(*RAMP_OF_SRGB)) | COLORANTS)
"""The profile of a photograph: colorants that are 2.2e-4 off, and a curve of 1024 values."""


@pytest.mark.parametrize("profile", [SRGB, NEARLY, icc(PRIMARIES["srgb"], S_PARAMETERS, version=2)])
def test_profiles_that_move_no_colour_by_three_codes_are_srgb(profile: bytes) -> None:
    assert declared(profile) == Profile("sRGB")


def test_names_are_those_of_profiles_in_printable_letters() -> None:
    assert [declared(profile).name for profile in PROFILES.values()] == [*PROFILES]
    names = {"sRGB": "not sRGB", "=x\u202e\n": "x??", "": "unnamed", "é" * 90: "?" * 60}
    assert {name: declared(icc(_P3, S_PARAMETERS, name=name)).name for name in names} == names


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(**chunks: bytes) -> Profile:
    """The profile of a PNG with these chunks."""
    file = io.BytesIO()
    Image.fromarray(PATCHES).save(file, "PNG")
    data = file.getvalue()
    return read_profile(data[:33] + b"".join(chunk(kind.encode(), c) for kind, c in chunks.items()) + data[33:])


def chrm(primaries: tuple[float, ...]) -> bytes:
    return struct.pack(">8I", *(round(xy * 1e5) for xy in (*primaries[6:], *primaries[:6])))


P3_CODES, SRGB_CODES, ICC = bytes((12, 13, 0, 1)), bytes((1, 13, 0, 1)), b"x\0\0" + zlib.compress(PROFILES["Adobe RGB"])
GAMMA, SRGB_GAMMA = struct.pack(">I", 55556), struct.pack(">I", 45455)


def test_cicp_precedes_icc_precedes_srgb_precedes_gamma() -> None:
    assert png(cICP=P3_CODES, iCCP=ICC, gAMA=GAMMA).name == "cICP 12/13"
    assert png(cICP=SRGB_CODES, iCCP=ICC) == Profile("sRGB")
    assert png(iCCP=ICC, sRGB=b"\0", gAMA=GAMMA).name == "Adobe RGB"
    assert png(sRGB=b"\0", gAMA=GAMMA, cHRM=chrm(_P3)) == Profile("sRGB")
    assert png(gAMA=SRGB_GAMMA, cHRM=chrm(PRIMARIES["srgb"])) == png(gAMA=SRGB_GAMMA) == png() == Profile("sRGB")


def test_code_points_and_chunks_of_p3_give_the_colours_of_its_profile() -> None:
    expected = srgb_codes(PATCHES, declared(PROFILES["Display P3"]))
    for profile in (png(cICP=P3_CODES), png(gAMA=SRGB_GAMMA, cHRM=chrm(_P3)), png(cHRM=chrm(_P3))):
        np.testing.assert_allclose(srgb_codes(PATCHES, profile), expected, atol=0.1)


def test_gamma_of_a_png_is_the_exponent() -> None:
    gray = np.arange(256)
    np.testing.assert_allclose(light_tables(png(gAMA=GAMMA), "none", "srgb", 256)[0], (gray / 255) ** (1 / 0.55556))


# Refusals -------------------------------------------------------------------------------------------------------------

TAGS = tags_of(_P3, para(3, *SRGB_PARAMETERS))


def without(name: bytes) -> bytes:
    return profile_of_tags({tag: content for tag, content in TAGS.items() if tag != name})


def with_curve(content: bytes) -> bytes:
    return profile_of_tags({**TAGS, b"gTRC": content})


REFUSED = {
    "tables": profile_of_tags({**TAGS, b"A2B0": b"mft2" + bytes(60)}),
    "Lab": profile_of_tags(TAGS, connection=b"Lab "),
    "CMYK": profile_of_tags(TAGS, space=b"CMYK"),
    "no curve": without(b"gTRC"),
    "no colorant": without(b"bXYZ"),
    "nothing": b"garbage",
    "cut": PROFILES["ProPhoto"][:-9],
    "header only": PROFILES["ProPhoto"][:130],
    "many tags": PROFILES["ProPhoto"][:128] + struct.pack(">I", 2**32 - 1) + PROFILES["ProPhoto"][132:],
    "curve of 2^32 - 1 values": with_curve(b"curv" + bytes(4) + b"\xff" * 4 + bytes(8)),
    "short curve": with_curve(curv(1, 2, 3)[:-4]),
    "unknown parametric curve": with_curve(para(5, 1, 1, 1, 1, 1, 1, 1)),
    "short parametric curve": with_curve(para(4, 1.0)),
    "unknown curve": with_curve(b"xxxx" + bytes(40)),
    "no slope": with_curve(para(1, 2.2, 0, 1)),
    "falling": with_curve(curv(65535, 0)),
    "constant": with_curve(curv(65535, 65535)),
    "black only": with_curve(curv(0, 0)),
    "negative exponent": with_curve(para(0, -2.2)),
    "up and down": with_curve(curv(0, 60000, 100, 65535)),
    "huge": with_curve(para(3, 30000, 30000, -30000, 30000, -30000)),
    "white that is not white": icc((*_P3[:6], 0.25, 0.25), S_PARAMETERS)[:-40] + bytes(40),
    "empty colorants": profile_of_tags(
        {**TAGS, **dict.fromkeys((b"rXYZ", b"gXYZ", b"bXYZ"), b"XYZ \0\0\0\0" + bytes(12))}
    ),
}


@pytest.mark.parametrize("profile", REFUSED.values(), ids=REFUSED)
def test_profiles_without_usable_matrix_and_curves_are_refused(profile: bytes) -> None:
    with pytest.raises(SourceError, match=r"icc: .*convert the picture to sRGB, or set source\.icc=ignore") as caught:
        declared(profile)
    assert caught.value.reason == "icc"


@pytest.mark.parametrize(
    "chunks",
    [
        {"gAMA": bytes(4)},
        {"cHRM": bytes(32)},
        {"cHRM": b"\xff" * 32},
        {"cHRM": b"\0" * 7},
        {"cICP": bytes((3, 13, 0, 1))},
    ],
    ids=str,
)
def test_impossible_chunks_are_refused(chunks: dict[str, bytes]) -> None:
    with pytest.raises(SourceError, match="icc: "):
        png(**chunks)


def test_damaged_profiles_are_read_or_refused() -> None:
    generator, refused = np.random.default_rng(0), 0
    for number in range(600):
        data = bytearray(list(PROFILES.values())[number % 3])
        for place in generator.integers(0, len(data), 1 + number % 5):
            data[place] = int(generator.integers(256))
        try:
            profile = declared(bytes(data))
        except SourceError as error:
            refused += error.reason == "icc"
            continue
        for table in () if profile.is_srgb else light_tables(profile, "smoothstep", 2.2, 256):
            assert table[-1] == 1 and table.min() >= 0 and (np.diff(table) >= -0.1).all()
    assert 100 < refused < 500
