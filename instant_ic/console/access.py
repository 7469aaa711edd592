"""Access control of the page, independent of the HTTP server: sign-in by token, session cookies, TLS.

The caller passes the time, in seconds of one monotonic clock, so that tests need not wait.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import ssl
from collections import OrderedDict
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

from instant_ic.config.ranges import Positive, Range, check_ranges
from instant_ic.util.private import read_secret
from instant_ic.util.web_access import SIGN_IN, AccessError, AddressBuckets, is_loopback, sign_in_needed

COOKIE = "instant_ic_session"
MIN_TOKEN = 16
MAX_WAIT_S = 4.0  # delay of the answer to a wrong token if its address has sent too many wrong tokens
_MOST_SESSIONS = 256  # per role


class Role(Enum):
    """Rights of a signed-in page. Both roles may set the emergency stop."""

    DRIVE = "drive"
    WATCH = "watch"


@dataclass(frozen=True)
class AccessConfig:
    """Sign-in and TLS.

    Attributes:
        sign_in: ``auto`` (required unless ``simulated``), ``always`` or ``never``.
        simulated: true if the page drives only simulated robots. With ``auto``, this machine then needs no sign-in,
            unless there is a token file. The simulator's launch files set it.
        token_file: file with the token to drive, readable only by its owner. If empty, each start makes a token and
            shows it on the terminal and in a file readable only by its owner, never in the log.
        watch_token_file: file with the token that only permits to watch and stop the robot; empty: no such token.
        session_hours: lifetime of a sign-in in hours.
        tries_per_minute: number of wrong tokens per address that are answered at once. Answers to further wrong tokens
            are delayed by ``MAX_WAIT_S``. A correct token never waits.
        tls_certificate: PEM file of the certificate; empty for plain HTTP.
        tls_key: PEM file of its key.
    """

    sign_in: str = "auto"
    simulated: bool = False
    token_file: str = ""
    watch_token_file: str = ""
    session_hours: Positive = 12.0
    tries_per_minute: Annotated[int, Range(1, 1000)] = 10
    tls_certificate: str = ""
    tls_key: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.sign_in not in SIGN_IN:
            raise ValueError(f"sign_in must be one of {', '.join(SIGN_IN)} (got {self.sign_in!r})")
        if bool(self.tls_certificate) != bool(self.tls_key):
            raise ValueError("tls_certificate and tls_key must be given together")


def read_token(file: str) -> str:
    """Read the token from a file.

    Raises:
        AccessError: the file is missing, other users may read it, or its token is too easy to guess.
    """
    path = Path(file).expanduser()
    try:
        text = read_secret(path)
    except (OSError, UnicodeDecodeError) as error:
        raise AccessError(f"token file {path}: {getattr(error, 'strerror', None) or error}") from error
    if len(text) < MIN_TOKEN or not text.isascii() or any(c.isspace() for c in text):
        raise AccessError(
            f"token file {path}: a token must have at least {MIN_TOKEN} ASCII characters and no spaces; make one with "
            f"`python3 -c 'import secrets; print(secrets.token_urlsafe())' > {path}`"
        )
    return text


def tls_context(config: AccessConfig) -> ssl.SSLContext | None:
    """Return the server's TLS context; None for plain HTTP.

    Raises:
        AccessError: certificate or key cannot be used.
    """
    if not config.tls_certificate:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION  # otherwise a client could force handshakes with a few bytes
    files = [str(Path(file).expanduser()) for file in (config.tls_certificate, config.tls_key)]
    try:
        context.load_cert_chain(*files)
    except (OSError, ssl.SSLError) as error:
        raise AccessError(f"TLS certificate {files[0]} with key {files[1]}: {error}") from error
    return context


class Access:
    """Tokens, sessions and counts of wrong tokens.

    Args:
        config: parameters.
        host: address to which the server is bound.

    Attributes:
        required: true if a sign-in is required.
        unguarded: true if the parameters let anyone who reaches the server drive a robot.
        made_token: token to drive that was made at this start; empty with a token file.

    Raises:
        AccessError: a token file cannot be used.
    """

    def __init__(self, config: AccessConfig, host: str) -> None:
        self.config = config
        open_to_network = not is_loopback(host)
        protected = bool(config.token_file or config.watch_token_file)
        self.required = sign_in_needed(config.sign_in, host, config.simulated and not protected)
        self.unguarded = not self.required and (open_to_network or not config.simulated)
        self.made_token = ""
        self._digests: dict[Role, bytes] = {}
        self._sessions: OrderedDict[bytes, tuple[Role, float]] = OrderedDict()
        self._tries = AddressBuckets(config.tries_per_minute / 60.0, config.tries_per_minute)
        if not self.required:
            return
        drive = read_token(config.token_file) if config.token_file else secrets.token_urlsafe(24)
        self.made_token = "" if config.token_file else drive
        self._digests[Role.DRIVE] = _digest(drive)
        if config.watch_token_file:
            watch = read_token(config.watch_token_file)
            if hmac.compare_digest(watch, drive):
                raise AccessError(
                    "token_file and watch_token_file contain the same token, so watchers could drive; use two tokens"
                )
            self._digests[Role.WATCH] = _digest(watch)

    def role_of_token(self, token: str) -> Role | None:
        """Return the role of a token; None for a wrong one."""
        digest = _digest(token)
        # Compare every token, each in constant time, so that the duration reveals nothing.
        roles = [role for role, known in self._digests.items() if hmac.compare_digest(known, digest)]
        return roles[0] if roles else None

    def role_of(self, token: str, cookie: str, now_s: float) -> Role | None:
        """Return the role of a request. Programs send a token, pages send the cookie of their sign-in."""
        return self.role_of_token(token) if token else self.role_of_session(cookie, now_s)

    def count_wrong_token(self, address: str, now_s: float) -> float:
        """Count a wrong token of an address, and return the seconds to wait before answering it.

        Only wrong tokens wait, because an emergency stop must not queue behind a guesser with the same address.
        """
        return 0.0 if self._tries.of(address).take(now_s) else MAX_WAIT_S

    def open_session(self, role: Role, now_s: float) -> str:
        """Open a session and return the value of its cookie. If a role has too many sessions, its oldest one ends."""
        value = secrets.token_urlsafe(32)
        same = [digest for digest, (other, _) in self._sessions.items() if other is role]
        if len(same) >= _MOST_SESSIONS:
            del self._sessions[same[0]]
        self._sessions[_digest(value)] = (role, now_s + self.config.session_hours * 3600.0)
        return value

    def role_of_session(self, cookie: str, now_s: float) -> Role | None:
        """Return the role of a cookie; None if it is unknown or expired."""
        found = self._sessions.get(_digest(cookie))
        return found[0] if found is not None and now_s < found[1] else None

    def close_session(self, cookie: str) -> None:
        """Sign a page out."""
        self._sessions.pop(_digest(cookie), None)


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()
