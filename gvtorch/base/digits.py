"""Numbers that texts tell. torch is not imported here."""

from __future__ import annotations

import math
import re
from typing import Any


def whole_number(text: str | None) -> int | None:
    """Returns the whole number that a text of digits 0 to 9 tells, at most 18 of them; None of any
    other text. (`str.isdigit` is true of "²", which `int` refuses, as it does thousands of digits.)
    """
    return int(text) if text is not None and re.fullmatch("[0-9]{1,18}", text) else None


def finite_number(text: Any) -> float | None:
    """Returns the number that a text tells; None if it is none, or not finite."""
    try:
        value = float(text)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if math.isfinite(value) else None
