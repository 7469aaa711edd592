"""Access to a server on this machine: sign-in, Host and Origin headers, and a rate limit per client."""

from __future__ import annotations

import ipaddress
import logging
import math
import os
import sys
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from instant_ic.util.safe_text import direct

_MOST_ADDRESSES = 1024
SIGN_IN = ("auto", "always", "never")
logger = logging.getLogger(__name__)


class AccessError(ValueError):
    """A token or certificate cannot be used."""


def sign_in_needed(sign_in: str, host: str, simulated: bool) -> bool:
    """Return whether a server asks for a token.

    Args:
        sign_in: one of ``SIGN_IN``; ``auto`` asks unless the server is on loopback and its robots are simulated. Even
            on loopback, other users of this machine must not drive a real robot.
        host: listen address.
        simulated: true if it is certain that nothing real can move.
    """
    return sign_in == "always" or (sign_in == "auto" and not (simulated and is_loopback(host)))


def offer_sign_in(address: str, file: Path) -> None:
    """Write an address with its token to a file that only its owner can read, and print it if on a terminal.

    The token is never logged, because the log goes to ``/rosout`` and into bags.

    Raises:
        AccessError: the file cannot be written.
    """
    try:
        file.unlink(missing_ok=True)
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
            out.write(f"{address}\n")
    except OSError as error:
        raise AccessError(f"cannot write the address with the token to {file}: {error.strerror}") from error
    logger.info("the address with the token is in %s", file)
    if sys.stdout.isatty():  # `ic run`; the launcher shows the address itself
        direct(sys.stdout).write(f"sign in at {address}\n")
        sys.stdout.flush()


def is_loopback(host: str) -> bool:
    """Return whether a host is reachable only from this machine; only localhost is recognised by name."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def host_allowed(host: str, allowed: Sequence[str]) -> bool:
    """Return whether a Host header names this machine: an address, ``localhost`` or one of ``allowed``.

    A foreign site can point its own name at this machine (DNS rebinding), and then its Origin equals its Host. It
    cannot make a browser send an IP address or ``localhost``, however.
    """
    name = _hostname(f"//{host}")
    return name is not None and (name in ("localhost", *(entry.lower() for entry in allowed)) or _is_address(name))


def refusal(origin: str | None, host: str | None, origins: Sequence[str], hosts: Sequence[str]) -> str:
    """Return why a request is refused; empty if it is allowed.

    Args:
        origin: Origin header; None if there is none, as from programs other than browsers.
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
        rate: tokens added per second.
        burst: capacity.
        first: tokens at the start; None starts with ``burst``.
    """

    __slots__ = ("_at", "_tokens", "burst", "rate")

    def __init__(self, rate: float, burst: float, first: float | None = None) -> None:
        self.rate, self.burst = rate, burst
        self._tokens, self._at = burst if first is None else first, -math.inf

    def take(self, now: float, amount: float = 1.0) -> bool:
        """Take ``amount`` tokens if they are available. Return whether they were taken."""
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
        """Return the seconds from the last :meth:`take` until one token is available."""
        return max(0.0, 1.0 - self._tokens) / self.rate


class AddressBuckets:
    """A token bucket for each address. The least recently used address is dropped first."""

    def __init__(self, rate: float, burst: float) -> None:
        self._rate, self._burst = rate, burst
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()

    def of(self, address: str) -> TokenBucket:
        """Return the bucket of an address."""
        bucket = self._buckets.setdefault(address, TokenBucket(self._rate, self._burst))
        self._buckets.move_to_end(address)
        while len(self._buckets) > _MOST_ADDRESSES:
            self._buckets.popitem(last=False)
        return bucket


def network_of(host: str) -> str:
    """Return the limited network of an address: the whole IPv4 address, or the /64 of an IPv6 subscriber."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(address, ipaddress.IPv4Address):
        return str(address)
    return str(address.ipv4_mapped or ipaddress.IPv6Network((int(address) >> 64 << 64, 64)))


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
