"""Results as JSON files: numbers that JSON has, written atomically."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any


def finite(value: Any, digits: int | None = None) -> Any:
    """Replace NaN and infinity by None, which JSON has; with ``digits``, round other numbers to so many places."""
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
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
