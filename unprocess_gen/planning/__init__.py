"""Draw every random parameter of a pair and decide which effects to simulate."""
