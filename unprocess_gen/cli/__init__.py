"""Provide the command line ``gen-dataset``."""
