"""Draw every random parameter of a pair, and decide which sensor effects to simulate."""
