"""Provide errors, random streams, exact distributions, limits of fields, and local and remote files to all packages."""
