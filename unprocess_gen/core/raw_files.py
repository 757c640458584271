"""Name the suffixes of files that contain mosaics."""

PICTURE_SUFFIXES = (".pgm", ".png", ".tif", ".tiff")
RAW_FILES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".gpr", ".iiq", ".kdc", ".mef", ".mos"),
    *(".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
)
"""Suffixes of files that LibRaw decodes (extra ``raw``)."""
SUFFIXES = (".npy", *PICTURE_SUFFIXES, *RAW_FILES)
