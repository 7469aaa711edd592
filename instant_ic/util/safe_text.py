"""Text that is safe to show: no control characters of strangers, no passwords.

Names and texts of bags, peers and files may hold escape sequences, which a terminal would obey. Addresses may hold a
password or token, which logs, bags and parameters would spread.
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
"""Control characters but tab and line feed, those that change the direction of writing, those that show nothing, and
halves of surrogate pairs, which no terminal takes."""
_COLOUR = re.compile(r"(\x1b\[[\d;]*m)")
_USER = re.compile(r"(://(?!\[)[^\s/:]*):(?!\d*(?:[/?#\s\"',)\]}]|$))\S*@")
"""User and password. A slash may be in the password, but behind digits it ends a port."""
_TOKEN = re.compile(r"([?&;#](?:token|pass(?:word|wd)?|pwd)=)(?!\{password\}(?:[\s&;#]|$))[^\s&;]+", re.IGNORECASE)
"""Password or token in a query; ``{password}`` is only the place for one."""


def visible(text: str, *, colours: bool = False) -> str:
    """Return a text with its control characters written out, such as ``ESC`` as backslash, x1b.

    Args:
        text: any text.
        colours: keep the sequences that set colours.
    """
    if colours:
        parts = _COLOUR.split(text)  # colours at the odd places
        return "".join(part if index % 2 else visible(part) for index, part in enumerate(parts))
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


def masked(text: str) -> str:
    """Return a text with the passwords and tokens of its addresses replaced by ``***``."""
    return _TOKEN.sub(r"\1***", _USER.sub(r"\1:***@", text))


def holds_password(address: str) -> bool:
    """Return whether an address has a password or token in it, before the host or in its query."""
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
    """Text stream that shows control characters and hides passwords; :func:`direct` returns the stream below it."""

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
    """Return the stream for a program's own colours and cursor movements; what it gets must be ``visible``."""
    below: TextIO = stream.stream if isinstance(stream, VisibleStream) else stream
    return below
