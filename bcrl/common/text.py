"""Numbers, durations and tables as the command and the report spell them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

ABSENT = "–"  # a cell without a value


def number(value: float) -> str:
    """Four significant digits, a real minus sign, a dash for nan."""
    if not math.isfinite(value):
        return ABSENT
    return f"{value:#.4g}".rstrip(".").replace("-", "−")


def estimate(value: float, interval: tuple[float, float]) -> str:
    """`0.12 [0.10, 0.14]`, without the brackets if there is no interval."""
    if not all(map(math.isfinite, interval)):
        return number(value)
    return f"{number(value)} [{number(interval[0])}, {number(interval[1])}]"


def duration(seconds: float) -> str:
    """`1.5 h`, `12 s`."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds:.0f} s"


def shorten(text: str, longest: int = 60) -> str:
    """The beginning of a text that has more characters than `longest`."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def aligned(rows: Mapping[str, Sequence[Any]], *columns: str) -> str:
    """Rows by name as aligned lines."""
    texts = [
        [name, *(f"{x:.1f}" if isinstance(x, float) else f"{x}" for x in row)]
        for name, row in {"": columns, **rows}.items()
    ]
    first, *others = (max(map(len, column)) for column in zip(*texts, strict=True))
    form = "  ".join([f"{{:<{first}}}", *(f"{{:>{width}}}" for width in others)])
    return "\n".join(form.format(*line) for line in texts)
