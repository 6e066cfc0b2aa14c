"""What a part is given, and what it gives back."""

from dataclasses import dataclass
from typing import Any

Counts = dict[str, int]  # how often a part does each thing
Rows = list[list[Any]]  # the first is the header


@dataclass
class Measured:
    """A part's table, and the promises that did not hold."""

    rows: Rows
    broken: list[str]


def totals(rows: Rows) -> list[Any]:
    """The sums of a table's columns, below their headers; "" counts as nothing."""
    return [sum(cell or 0 for cell in column) for column in list(zip(*rows[1:], strict=True))[1:]]
