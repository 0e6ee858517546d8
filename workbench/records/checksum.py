"""The checksum by which a file written here is known to be as it was written."""

import json
from collections.abc import Iterable, Mapping
from typing import Any
from zlib import crc32

import numpy as np

KEY = "crc32"


def checksum(description: Mapping[str, Any], signals: Iterable[np.ndarray]) -> int:
    """CRC-32 of a record's description, without the sum itself, and of its signals."""
    text = json.dumps({key: value for key, value in description.items() if key != KEY}, sort_keys=True)
    total = crc32(text.encode())
    for values in signals:
        total = crc32(np.ascontiguousarray(values, "<f8").tobytes(), total)
    return total
