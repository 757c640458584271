"""Types, errors, random streams, lookup tables, compilation and files: what every other package uses."""
