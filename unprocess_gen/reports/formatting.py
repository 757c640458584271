"""Format numbers for tables, figures and pages."""

from __future__ import annotations

NOT_MEASURED = "–"


def short_number(value: float | None, digits: int = 2) -> str:
    """A number with some significant digits, without an exponent if it is short; a dash for None."""
    return NOT_MEASURED if value is None else f"{float(f'{value:.{digits}g}'):g}"


def percentage(fraction: float | None, digits: int = 2) -> str:
    """A fraction as a percentage; a dash for None."""
    return NOT_MEASURED if fraction is None else f"{short_number(fraction * 100, digits)} %"


def byte_size(count: int) -> str:
    """A number of bytes in decimal megabytes or gigabytes."""
    return f"{count / 1e9:,.2f} GB" if count >= 1e9 else f"{count / 1e6:,.1f} MB"


def counted(number: int, noun: str) -> str:
    """A number and a noun with its plural s, such as ``1 pair`` or ``1200 pairs``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
