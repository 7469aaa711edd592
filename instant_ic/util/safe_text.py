"""Text that is safe to show, without control characters and passwords.

Names and texts from bags, peers and files may hold escape sequences, which a terminal would execute. Addresses may hold
a password or token, which logs, bags and parameters would spread.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, TextIO

_CONTROL = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f"
    r"\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
    r"\u200b\u2060-\u2065\ufeff\U000e0000-\U000e007f"
    r"\ud800-\udfff]"
)
"""Control characters except tab and line feed, characters that change the direction of writing or are invisible, and
halves of surrogate pairs, which terminals do not accept."""
_COLOUR = re.compile(r"(\x1b\[[\d;]*m)")
_USER = re.compile(r"(://(?!\[)[^\s/:]*):(?!\d*(?:[/?#\s\"',)\]}]|$))\S*@")
"""User and password. A slash may be part of the password, but after digits it ends a port number."""
_TOKEN = re.compile(r"([?&;#](?:token|pass(?:word|wd)?|pwd)=)(?!\{password\}(?:[\s&;#]|$))[^\s&;]+", re.IGNORECASE)
"""Password or token in a query. ``{password}`` is only a placeholder."""


def visible(text: str, *, colours: bool = False) -> str:
    r"""Return a text with its control characters written out, such as ``\x1b`` for ESC.

    Args:
        text: any text.
        colours: keep escape sequences that set colours.
    """
    if colours:
        parts = _COLOUR.split(text)  # colour sequences have odd indices
        return "".join(part if index % 2 else visible(part) for index, part in enumerate(parts))
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


def masked(text: str) -> str:
    """Return a text with the passwords and tokens in its addresses replaced by ``***``."""
    return _TOKEN.sub(r"\1***", _USER.sub(r"\1:***@", text))


def holds_password(address: str) -> bool:
    """Return whether an address contains a password or token, before the host or in its query."""
    return _USER.search(address) is not None or _TOKEN.search(address) is not None


def masked_values(value: Any) -> Any:
    """Return plain values (texts, lists, dictionaries) with every text masked."""
    if isinstance(value, str):
        return masked(value)
    if isinstance(value, dict):
        return {key: masked_values(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(masked_values(one) for one in value)
    return value


class VisibleStream:
    """Text stream that writes control characters out and masks passwords; :func:`direct` bypasses it."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(visible(masked(text)))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def direct(stream: Any) -> TextIO:
    """Return the unfiltered stream, for a program's own colours and cursor movements; filter text by `visible`."""
    below: TextIO = stream.stream if isinstance(stream, VisibleStream) else stream
    return below
