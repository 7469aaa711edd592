"""Which web pages may speak to a server of this machine: a browser names the page in Origin, the server in Host."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a host name or address; names other than localhost are never looked up."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def refusal(origin: str | None, host: str | None, origins: Sequence[str], hosts: Sequence[str]) -> str:
    """Why a request is refused; empty where it may pass.

    Args:
        origin: the header; None where there is none, as programs that are no browsers send it.
        host: the header.
        origins: pages that may connect beside those of this machine; ``*`` lets every page in.
        hosts: names by which the server may be reached beside localhost; an address is always one. A foreign page
            can point a name of its own at this machine (DNS rebinding), never an address.
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
