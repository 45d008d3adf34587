"""Strict parsing of numbers from text. Does not import torch."""

from __future__ import annotations

import math
import re
from typing import Any


def whole_number(text: str | None) -> int | None:
    """Returns the whole number written in a text of 1 to 18 digits 0 to 9; None for any other text.
    (`str.isdigit` accepts "²", which `int` refuses, as it does thousands of digits.)
    """
    return int(text) if text is not None and re.fullmatch("[0-9]{1,18}", text) else None


def finite_number(text: Any) -> float | None:
    """Returns a text as a float; None if it is not a number, or not finite."""
    try:
        value = float(text)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if math.isfinite(value) else None
