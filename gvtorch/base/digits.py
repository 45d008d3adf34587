"""`whole_number`: a number of digits 0 to 9, as in a key or a flag. `str.isdigit` is true of "²",
which `int` refuses, as it does what has thousands of digits. torch is not imported here.
"""

from __future__ import annotations

import re


def whole_number(text: str | None) -> int | None:
    """Returns the whole number that a text tells, at most 18 digits; None of any other text."""
    return int(text) if text is not None and re.fullmatch("[0-9]{1,18}", text) else None
