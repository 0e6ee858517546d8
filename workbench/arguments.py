"""Arguments that are numbers: what is none is refused by name, with the limit and with what was got."""

from numbers import Real
from typing import Any

import numpy as np


def whole(value: Any, what: str, *, least: int = 0) -> int:
    """The value as an int, `least` or more; `what` it is, is the subject of the message.

    Raises:
        TypeError: no number.
        ValueError: not whole, or too small.
    """
    asked = f"{what} is a whole number, {least} or more"
    if not _is_number(value):
        raise TypeError(f"{asked}; got {value!r}")
    if not np.isfinite(value) or value != int(value) or value < least:
        raise ValueError(f"{asked}; got {value}")
    return int(value)


def number(value: Any, what: str, unit: str = "") -> float:
    """The value, `what` it is in `unit`, as a float, which may be infinite or nan; a `TypeError` if it is no number."""
    if not _is_number(value):
        raise TypeError(f"{what} is a number{f' in {unit}' if unit else ''}; got {value!r}")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool | np.bool_)
