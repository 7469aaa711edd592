"""What ``ic doctor`` finds."""

from __future__ import annotations

from dataclasses import dataclass

OK, WARN, FAIL = "ok", "warn", "fail"


@dataclass(frozen=True)
class Finding:
    """Result of a check.

    Attributes:
        level: OK, WARN (a function will be missing or slow) or FAIL (the stack will not work).
        subject: what was checked.
        words: what was found.
        advice: what to do about it; empty where all is well.
    """

    level: str
    subject: str
    words: str
    advice: str = ""
