"""Access of browsers to a server of this machine: Host and Origin headers, and the rate of one client."""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Sequence
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Whether a host name or address is reachable only from this machine; only localhost is recognised by name."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def host_allowed(host: str, allowed: Sequence[str]) -> bool:
    """Whether a Host header names this machine: an address, ``localhost`` or one of ``allowed``.

    A foreign site can point its own name at this machine (DNS rebinding); then its Origin equals its Host. But it
    cannot make a browser send an address or ``localhost``.
    """
    name = _hostname(f"//{host}")
    return name is not None and (name in ("localhost", *(entry.lower() for entry in allowed)) or _is_address(name))


def refusal(origin: str | None, host: str | None, origins: Sequence[str], hosts: Sequence[str]) -> str:
    """Return why a request is refused; empty if it is allowed.

    Args:
        origin: Origin header; None if there is none, as for programs other than browsers.
        host: Host header.
        origins: pages that may connect in addition to those of this machine; ``*`` allows every page.
        hosts: see :func:`host_allowed`.
    """
    if not host_allowed(host or "", hosts):
        return f"Host {host!r:.100} is not an address, localhost or one of allowed_hosts"
    if origin is None or origin in origins or "*" in origins:
        return ""
    page = _hostname(origin)
    if page is not None and is_loopback(page) and origin.startswith(("http://", "https://")):
        return ""
    return f"Origin {origin!r:.100} is not one of allowed_origins"


class TokenBucket:
    """Token bucket: ``rate`` tokens a second on average, ``burst`` at once. The caller passes the time.

    Args:
        rate: tokens added each second.
        burst: capacity.
        first: tokens at the start; default ``burst``.
    """

    __slots__ = ("_at", "_tokens", "burst", "rate")

    def __init__(self, rate: float, burst: float, first: float | None = None) -> None:
        self.rate, self.burst = rate, burst
        self._tokens, self._at = burst if first is None else first, -math.inf

    def take(self, now: float, amount: float = 1.0) -> bool:
        """Take ``amount`` tokens if available, else none; return whether they were taken."""
        if self._at > -math.inf:
            self._tokens = min(self.burst, self._tokens + (now - self._at) * self.rate)
        self._at = now
        if amount > self._tokens:
            return False
        self._tokens -= amount
        return True

    def give_back(self) -> None:
        """Return one token to the bucket."""
        self._tokens = min(self.burst, self._tokens + 1.0)

    def wait_s(self) -> float:
        """Seconds from the last :meth:`take` until one token is available."""
        return max(0.0, 1.0 - self._tokens) / self.rate


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
