"""Describe datasets and runs for people: estimates, pictures, pages and measurements."""
