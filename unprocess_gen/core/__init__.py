"""Provide types, errors, random streams, lookup tables, compilation and files to all other packages."""
