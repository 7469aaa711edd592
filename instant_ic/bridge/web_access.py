"""Decides which web pages may access a server of this machine, by the browser's Origin and Host headers."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Whether a host name or address is reachable only from this machine; only localhost is recognised by name."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refusal(origin: str | None, host: str | None, origins: Sequence[str], hosts: Sequence[str]) -> str:
    """Return why a request is refused; empty if it is allowed.

    Args:
        origin: Origin header; None if there is none, as for programs other than browsers.
        host: Host header.
        origins: pages that may connect in addition to those of this machine; ``*`` allows every page.
        hosts: names of the server in addition to localhost; addresses are always allowed. A foreign page can point its
            own name at this machine (DNS rebinding), but never an address.
    """
    name = _hostname(f"//{host or ''}")
    if name is None or not (name in ("localhost", *hosts) or _is_address(name)):
        return f"Host {host!r:.100} is not an address, localhost or one of allowed_hosts"
    if origin is None or origin in origins or "*" in origins:
        return ""
    page = _hostname(origin)
    if page is not None and is_loopback(page) and origin.startswith(("http://", "https://")):
        return ""
    return f"Origin {origin!r:.100} is not one of allowed_origins"


def _hostname(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
