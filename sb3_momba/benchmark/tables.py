"""Tables in Markdown."""

from collections.abc import Sequence

from sb3_momba.benchmark.statistics import Estimate


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """The first row is the header."""
    header, *body = ["| " + " | ".join(one_line(cell).replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([header, "|" + "---|" * len(rows[0]), *body]) + "\n"


def one_line(text: str) -> str:
    return " ".join(text.split())


def as_text(estimate: Estimate) -> str:
    """value [low, high]; of a single run the value alone."""
    if not estimate.low < estimate.high:
        return f"{estimate.value:,.4g}"
    return f"{estimate.value:,.4g} [{estimate.low:,.4g}, {estimate.high:,.4g}]"
