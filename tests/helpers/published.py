"""Published numbers that tests of several packages compare with."""

CRVD = {
    1600: (3.513262, 11.917691),
    3200: (6.955588, 38.117816),
    6400: (13.486051, 130.818508),
    12800: (26.585953, 484.539790),
    25600: (52.032536, 1819.818657),
}
"""Gain and read variance of the IMX385 by ISO, DN above black (Yue et al. 2020)."""
