"""Show what settings do to a photograph, in a page of the browser."""
