"""Tables in Markdown that read well in a terminal too."""

from collections.abc import Sequence


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The cells in columns of equal width; a bar within a cell is escaped, a line break is a space."""
    header, *rows = [[_escaped(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = [_line(header, widths), "|" + "|".join("-" * (w + 2) for w in widths) + "|"]
    return "\n".join(lines + [_line(row, widths) for row in rows])


def decimals(value: float | None) -> str:
    """Four places; of less than that only the order of magnitude, of nothing a dash."""
    if value is None:
        return "-"
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 0.001 else f"{value:.1e}"


def _escaped(cell: str) -> str:
    return " ".join(cell.splitlines()).replace("|", "\\|")


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    return "| " + " | ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)) + " |"
