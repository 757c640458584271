"""Draw the figures of the article for a photograph."""
