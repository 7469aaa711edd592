"""Keys of the link between two hosts: this host's key pair, and the list of allowed hosts.

A folder (default ``$XDG_CONFIG_HOME/instant_ic/keys``) holds two text files::

    identity    name and secret key of this host, mode 0600
    allowed     one host per line: NAME ROLE KEY

A key is written as ``ick_`` and 48 letters, including a checksum that detects copying errors.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from instant_ic.util.private import make_folder, open_file

ROLES = ("driver", "viewer")
"""Roles of allowed hosts: a driver's topics are accepted; a viewer only watches."""

_PREFIX = "ick_"
_KEY_SIZE = 32
_CHECK_SIZE = 4
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,62}\Z")


class KeyFileError(RuntimeError):
    """A key or key file cannot be used; the message names the file and the remedy."""


@dataclass(frozen=True)
class Peer:
    """An entry of the allow-list.

    Attributes:
        name: its name on this host.
        role: one of :data:`ROLES`.
        public_key: 32 bytes (Curve25519).
    """

    name: str
    role: str
    public_key: bytes

    @property
    def fingerprint(self) -> str:
        return fingerprint(self.public_key)


@dataclass(frozen=True)
class Identity:
    """This host's key pair; 32 bytes each."""

    name: str
    public_key: bytes
    secret_key: bytes

    @property
    def fingerprint(self) -> str:
        return fingerprint(self.public_key)


def key_dir() -> Path:
    """Return the key folder: ``$XDG_CONFIG_HOME/instant_ic/keys``, or ``~/.config/instant_ic/keys``."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "instant_ic" / "keys"


def fingerprint(public_key: bytes) -> str:
    """Return 64 bits of a key's SHA-256 for logs and reading aloud: ``1f3a-9c02-77be-d410``."""
    digits = hashlib.sha256(public_key).hexdigest()[:16]
    return "-".join(digits[i : i + 4] for i in range(0, 16, 4))


def key_text(public_key: bytes) -> str:
    check = hashlib.sha256(public_key).digest()[-_CHECK_SIZE:]
    return _PREFIX + base64.urlsafe_b64encode(public_key + check).decode()


def parse_key(text: str) -> bytes:
    """Return the 32 bytes of a public key.

    Raises:
        KeyFileError: the text is not a key, is incomplete, or contains a copying error.
    """
    word = text.strip()
    try:
        raw = base64.b64decode(word.removeprefix(_PREFIX).encode(), altchars=b"-_", validate=True)
    except ValueError:
        raw = b""
    if not word.startswith(_PREFIX) or len(raw) != _KEY_SIZE + _CHECK_SIZE:
        raise KeyFileError(f"{word[:60]!r} is not a key: it must be {_PREFIX} and 48 letters, see `ic keys list`")
    key = raw[:_KEY_SIZE]
    if hashlib.sha256(key).digest()[-_CHECK_SIZE:] != raw[_KEY_SIZE:]:
        raise KeyFileError(f"key {word} has a wrong checksum: copy it again")
    return key


def check_name(name: str) -> str:
    """Return a host's name if it is valid.

    Raises:
        KeyFileError: the name is not valid.
    """
    if not _NAME.match(name):
        raise KeyFileError(f"name {name!r} is not valid: use letters, digits, _ and -, starting with a letter")
    return name


class KeyStore:
    """The key files of one folder. Each method raises :class:`KeyFileError`, which names the file and the remedy.

    Args:
        folder: the folder; None takes :func:`key_dir`.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder if folder is not None else key_dir()
        self.identity_path = self.folder / "identity"
        self.allowed_path = self.folder / "allowed"

    # -- this host -------------------------------------------------------------------------------

    def identity(self) -> Identity:
        """Return this host's key pair, from a file that only its owner can read."""
        path = self.identity_path
        text = _text(path, 0o077, "read")
        if text is None:
            raise KeyFileError(f"{path} does not exist: create this host's key with `ic keys new`")
        try:
            name, public, secret = text.split()
            return Identity(check_name(name), parse_key(public), parse_key(secret))
        except (ValueError, KeyFileError):
            raise KeyFileError(f"{path} is damaged: create a new key with `ic keys new --force`") from None

    def create(self, name: str, force: bool = False) -> Identity:
        """Create this host's key pair; ``force`` replaces the present one."""
        import zmq
        from zmq.utils import z85

        check_name(name)
        if self.identity_path.exists() and not force:
            raise KeyFileError(
                f"{self.identity_path} already exists; --force replaces it; the other hosts must then allow the new key"
            )
        public, secret = (z85.decode(key) for key in zmq.curve_keypair())
        self._write(self.identity_path, f"{name}\n{key_text(public)}\n{key_text(secret)}\n")
        return Identity(name, public, secret)

    # -- the others ------------------------------------------------------------------------------

    def peers(self) -> list[Peer]:
        """Return the allowed hosts, from a file that only its owner can write; empty if the file is missing."""
        path = self.allowed_path
        peers: list[Peer] = []
        for number, line in enumerate((_text(path, 0o022, "written") or "").splitlines(), 1):
            words = line.partition("#")[0].split()
            if not words:
                continue
            try:
                if len(words) != 3 or words[1] not in ROLES:
                    raise KeyFileError(f"expected NAME, {' or '.join(ROLES)}, KEY")
                peer = Peer(check_name(words[0]), words[1], parse_key(words[2]))
                for other in peers:
                    if other.name == peer.name or other.public_key == peer.public_key:
                        raise KeyFileError(f"{peer.name} is listed twice, by name or by key (also as {other.name})")
            except KeyFileError as error:
                raise KeyFileError(f"{path}:{number}: {error}") from None
            peers.append(peer)
        return peers

    def peer(self, name: str = "") -> Peer:
        """Return the allowed host with a name, or the only allowed host."""
        peers = self.peers()
        found = [peer for peer in peers if not name or peer.name == name]
        if len(found) == 1:
            return found[0]
        known = ", ".join(peer.name for peer in peers) or "none"
        if found:
            raise KeyFileError(f"several hosts are allowed ({known}): name one of them")
        raise KeyFileError(
            f"{self.allowed_path} has no host {name!r}".replace(" ''", "")
            + f" (allowed: {known}): run `ic keys list` there, and `ic keys allow NAME KEY` here"
        )

    def allow(self, peer: Peer) -> str:
        """Add a host to the list, or replace the one with the same name. Return what was done."""
        check_name(peer.name)
        with self._locked():
            others = {other.name: other for other in self.peers()}
            before = others.pop(peer.name, None)
            for other in others.values():
                if other.public_key == peer.public_key:
                    raise KeyFileError(f"this key is already allowed as {other.name}: `ic keys revoke {other.name}`")
            if peer == before:
                return "as before"
            self._write_peers([*others.values(), peer])
            return "added" if before is None else "replaced"

    def revoke(self, name: str) -> Peer:
        """Remove a host from the list; a running bridge disconnects it immediately."""
        with self._locked():
            peer = self.peer(name)
            self._write_peers([other for other in self.peers() if other.name != name])
            return peer

    def _write_peers(self, peers: list[Peer]) -> None:
        lines = [f"{peer.name} {peer.role} {key_text(peer.public_key)}" for peer in peers]
        head = "# Hosts that may connect: NAME ROLE KEY; `ic keys` writes this file, the bridge reads it as it changes."
        self._write(self.allowed_path, "\n".join([head, *lines]) + "\n")

    def _write(self, path: Path, text: str) -> None:
        """Replace a file atomically; only its owner can ever read it."""
        scratch = path.with_name(f".{path.name}.{os.getpid()}")
        with _writing(path):
            make_folder(self.folder, exist_ok=True)
            try:
                scratch.unlink(missing_ok=True)
                with os.fdopen(open_file(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "w") as file:
                    file.write(text)
                    file.flush()
                    os.fsync(file.fileno())
                scratch.replace(path)
            finally:
                scratch.unlink(missing_ok=True)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the folder, so that concurrent commands do not lose each other's entry."""
        with _writing(self.folder):
            make_folder(self.folder, exist_ok=True)
            fd = open_file(self.folder / ".lock", os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX)
            yield
        finally:
            os.close(fd)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise KeyFileError(f"{path} cannot be written: {error.strerror}; give another folder with --dir") from error


def _text(path: Path, closed: int, verb: str) -> str | None:
    """Return the text of a file; None if it is missing. A file with any of the mode bits ``closed`` is refused."""
    try:
        with path.open() as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read()
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise KeyFileError(f"{path} cannot be read: {error}") from error
    if mode & closed:
        raise KeyFileError(f"{path} can be {verb} by others (mode {mode & 0o777:04o}): chmod 600 {path}")
    return text


class AllowList:
    """The current allow-list, read again when the file changes.

    A missing file allows nobody. An invalid file leaves the list unchanged, and ``problem`` says why.
    """

    def __init__(self, store: KeyStore) -> None:
        self._store = store
        self._seen: tuple[int, ...] | None = ()
        self._peers: dict[bytes, Peer] = {}
        self.problem = ""

    def refresh(self) -> bool:
        """Read the file if it changed; return True if the list is different."""
        try:
            stat = self._store.allowed_path.stat()
            seen = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        except OSError:
            seen = None
        if seen == self._seen:
            return False
        self._seen = seen
        try:
            peers = {peer.public_key: peer for peer in self._store.peers()}
        except KeyFileError as error:
            self.problem = str(error)
            return False
        self.problem = ""
        changed = peers != self._peers
        self._peers = peers
        return changed

    def get(self, public_key: bytes) -> Peer | None:
        return self._peers.get(public_key)

    def __len__(self) -> int:
        return len(self._peers)
