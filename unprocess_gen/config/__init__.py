"""Compose, validate and serialize the configuration."""
