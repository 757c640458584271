"""Draw contact sheets: pictures of pairs, and of each step of the simulation."""
