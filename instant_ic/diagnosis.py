"""State of a device or an algorithm, as its node publishes it in diagnostics."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


class Level(enum.IntEnum):
    """Severity, as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Diagnosis:
    """One named state.

    Attributes:
        name: the same name replaces the previous diagnosis.
        level: severity.
        text: what happened, then what to do.
        values: figures beside the text.
    """

    name: str
    level: Level
    text: str
    values: Mapping[str, Any] = field(default_factory=dict)
