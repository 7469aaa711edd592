"""Results as JSON files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from instant_ic.util.files import replacing


def finite(value: Any, digits: int | None = None) -> Any:
    """Replace NaN and infinity, which JSON lacks, by None; with ``digits``, round other numbers to that many places."""
    if isinstance(value, dict):
        return {key: finite(one, digits) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [finite(one, digits) for one in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return None
    return value if digits is None else round(value, digits)


def save_json(path: Path, value: Any) -> None:
    """Write a value as JSON."""
    save_text(path, json.dumps(value, indent=2) + "\n")


def save_text(path: Path, text: str) -> None:
    """Write a file atomically: an interrupted program leaves the old file or the new one."""
    with replacing(path) as stream:
        stream.write(text.encode())
