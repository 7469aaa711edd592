"""The file system as registry: publishers and running nodes of one run directory.

Layout::

    RUN_DIR/topics/<topic, "/" as ".">/<node>.{sock,json,lock}
    RUN_DIR/nodes/<node>.{json,lock}

A process holds its lock (``flock``) until it ends. The kernel releases the lock even after SIGKILL. A JSON file whose
lock can be taken therefore belongs to a dead process and is removed.
"""

from __future__ import annotations

import errno
import fcntl
import functools
import json
import os
import re
import stat
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from instant_ic.util.files import replacing
from instant_ic.util.private import make_folder

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")
_FILE_TIME_STEP_NS = 50_000_000  # more than the kernel's step
_PREDECESSOR_S = 2.0  # time for which a claim waits for a predecessor that is shutting down
# A killed process changes no folder, so processes are checked every second and locks less often.
_LOOK_S = 1.0
_FULL_LOOK_S = 5.0
_MAX_IPC_PATH = 107  # bytes of sockaddr_un.sun_path without its final zero


class RegistryError(RuntimeError):
    """The run directory cannot be used, or a name in it is already taken."""


@dataclass(frozen=True)
class PublisherInfo:
    """A live publisher."""

    node: str
    pid: int
    qos: str
    socket: Path
    type_name: str
    id: str
    started_ns: int


@dataclass(frozen=True)
class TopicInfo:
    """A topic with at least one live publisher."""

    topic: str
    type_name: str
    publishers: list[PublisherInfo]


@dataclass(frozen=True)
class NodeInfo:
    """A live node."""

    name: str
    executable: str
    pid: int
    started_ns: int
    params: dict[str, Any]
    publishes: dict[str, str] = field(default_factory=dict)
    subscribes: dict[str, str] = field(default_factory=dict)


def check_topic(topic: str) -> str:
    """Return the topic if its name is valid (``/a/b_c``).

    Raises:
        RegistryError: the name is invalid.
    """
    if not _TOPIC.match(topic):
        raise RegistryError(f"topic name {topic!r} is not legal: it must look like /camera/image")
    return topic


def check_node_name(name: str) -> str:
    """Return the node's name if it is valid (letters, digits, underscores).

    Raises:
        RegistryError: the name is invalid.
    """
    if not _NAME.match(name):
        raise RegistryError(f"node name {name!r} is not legal: letters, digits and underscores only")
    return name


def prepare(run_dir: Path) -> Path:
    """Create the run directory and its folders with mode 0700, or check that no other user can write to them.

    Raises:
        RegistryError: the run directory cannot be created or written; the directory or a folder in it is a symbolic
            link or belongs to another user; or other users can write to a folder above it and so replace it.
    """
    try:
        for folder in (run_dir, *(run_dir / name for name in ("topics", "nodes", "dev", "log"))):
            own_folder(folder)
        for parent in (folder := run_dir.absolute().parent.resolve(), *folder.parents):
            mode, group = (status := parent.stat()).st_mode, status.st_gid
            # A home folder is often writable for the user's own primary group.
            by_others = mode & stat.S_IWOTH or (mode & stat.S_IWGRP and group != os.getegid())
            if by_others and not mode & stat.S_ISVTX:
                raise RegistryError(
                    f"run directory {run_dir} is not safe: other users can write to {parent} (mode "
                    f"{stat.S_IMODE(mode):04o}) and so replace it; chmod go-w {parent}, or set INSTANT_IC_RUN_DIR to "
                    "another folder"
                )
    except OSError as error:
        raise RegistryError(
            f"run directory {run_dir} cannot be used: {error}; set INSTANT_IC_RUN_DIR to another"
        ) from error
    return run_dir


def own_folder(folder: Path) -> None:
    """Create a folder with mode 0700, or check that an existing one belongs to this user, and set its mode.

    Raises:
        RegistryError: the path is a symbolic link, is not a folder or belongs to another user.
        OSError: the folder cannot be created.
    """
    with suppress(FileExistsError):
        make_folder(folder)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        what = "a symbolic link" if stat.S_ISLNK(status.st_mode) else "not a folder"
        raise RegistryError(f"{folder} is {what}: remove it, or set INSTANT_IC_RUN_DIR to a folder of your own")
    if status.st_uid != os.getuid():
        raise RegistryError(
            f"{folder} belongs to user {status.st_uid}, not to you ({os.getuid()}): set INSTANT_IC_RUN_DIR to a folder "
            "of your own"
        )
    if stat.S_IMODE(status.st_mode) & 0o777 != 0o700:
        folder.chmod(0o700)


def open_lock(path: Path | str, create: bool = False) -> int:
    """Open a lock file and return its descriptor.

    Raises:
        RegistryError: the path is a symbolic link, is not a regular file or belongs to another user.
        OSError: the file cannot be opened.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC | (os.O_CREAT if create else 0)
    try:
        descriptor = os.open(path, flags, 0o600)
    except OSError as error:
        if error.errno != errno.ELOOP:
            raise
        raise RegistryError(f"{path} is a symbolic link, which this program did not create: remove it") from None
    status = os.fstat(descriptor)
    if stat.S_ISREG(status.st_mode) and status.st_uid == os.getuid():
        return descriptor
    os.close(descriptor)
    raise RegistryError(f"{path} is not a file of yours (owner {status.st_uid}): remove it")


def topic_dir(run_dir: Path, topic: str) -> Path:
    """Return the folder of a topic's publishers."""
    return run_dir / "topics" / check_topic(topic)[1:].replace("/", ".")


class Claim:
    """A name in the registry, locked until it is released or the process ends.

    Args:
        stem: path of the ``.lock`` and the ``.json`` file without suffix.
        what: description for error messages.

    Raises:
        RegistryError: another live process holds the name.
    """

    def __init__(self, stem: Path, what: str) -> None:
        self.stem = stem
        self._what = what
        self.json_path = stem.with_name(stem.name + ".json")
        self._lock_path = stem.with_name(stem.name + ".lock")
        self._writing = threading.Lock()
        deadline = time.monotonic() + _PREDECESSOR_S
        while not self._lock():
            if time.monotonic() > deadline:
                raise RegistryError(f"{what} already exists: another process holds {self._lock_path}")
            time.sleep(0.02)

    def _lock(self) -> bool:
        """Try to lock the file at the path. Return False if the previous holder has removed the opened file."""
        try:
            own_folder(self.stem.parent)
            self._fd = open_lock(self._lock_path, create=True)
        except FileNotFoundError:  # the empty folder was removed in between
            return False
        except OSError as error:
            raise RegistryError(f"{self._what}: {error}") from error
        with suppress(BlockingIOError):
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(self._fd, self._lock_path):
                return True
        os.close(self._fd)
        self._fd = -1
        return False

    def write(self, content: dict[str, Any]) -> None:
        """Replace the JSON file atomically. Any thread may call this.

        Raises:
            RegistryError: the disk is full, or the run directory is gone.
        """
        with self._writing:
            try:
                with replacing(self.json_path, private=True) as file:
                    file.write(json.dumps(content, default=str).encode())
            except OSError as error:
                raise RegistryError(f"{self._what} cannot be registered: {error}") from error

    def release(self) -> None:
        """Remove the JSON file and the lock. A second call does nothing."""
        if self._fd >= 0:
            self.json_path.unlink(missing_ok=True)
            self._lock_path.unlink(missing_ok=True)
            os.close(self._fd)
            self._fd = -1


def check_socket_path(path: Path) -> Path:
    """Return the path if it is short enough for a socket.

    Raises:
        RegistryError: the path is too long.
    """
    if len(os.fsencode(path)) > _MAX_IPC_PATH:
        raise RegistryError(
            f"socket path {path} is longer than {_MAX_IPC_PATH} bytes: set INSTANT_IC_RUN_DIR to a shorter folder"
        )
    return path


def claim_socket(run_dir: Path, topic: str, node: str) -> tuple[Claim, Path]:
    """Claim a publisher's name for a topic. Return the claim and a socket path that is free to bind.

    Raises:
        RegistryError: the name is taken, or the path is too long for a socket.
    """
    stem = topic_dir(run_dir, topic) / check_node_name(node)
    socket = check_socket_path(stem.with_name(stem.name + ".sock"))
    claim = Claim(stem, f"publisher of {topic} by node {node}")
    socket.unlink(missing_ok=True)
    return claim, socket


def announce(claim: Claim, topic: str, type_name: str, qos: str, node: str, socket: Path, identity: bytes) -> None:
    """Write the entry of a publisher whose socket is bound. Readers find the publisher from now on.

    Raises:
        RegistryError: the disk is full, or the run directory is gone.
    """
    claim.write(
        {
            "topic": topic,
            "type": type_name,
            "qos": qos,
            "node": node,
            "pid": os.getpid(),
            "socket": str(socket),
            "id": identity.hex(),
            "started_ns": time.time_ns(),
        }
    )


def _is_at(fd: int, path: Path) -> bool:
    """Return whether this path still names the open file."""
    try:
        return os.fstat(fd).st_ino == path.lstat().st_ino
    except FileNotFoundError:
        return False


def _alive(lock_path: Path | str) -> bool:
    """Return whether the owner of an entry holds its lock."""
    try:
        fd = open_lock(lock_path)
    except (FileNotFoundError, RegistryError):  # a file of another user is not an entry
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


@functools.lru_cache(1024)
def _content(path: str, written: tuple[int, int]) -> dict[str, Any]:
    """Return the content of a JSON file. A written file is never changed, only replaced."""
    entry: dict[str, Any] = json.loads(Path(path).read_text())
    return entry


def _entries(folder: Path | str) -> Iterator[dict[str, Any]]:
    try:
        names = sorted(name for name in os.listdir(folder) if name.endswith(".json"))  # noqa: PTH208 - faster, as below
    except FileNotFoundError:
        return
    for name in names:
        path = f"{folder}/{name}"
        if not _alive(f"{path.removesuffix('.json')}.lock"):
            continue
        try:
            status = os.stat(path)  # noqa: PTH116 - faster, for some hundred files a second
            content = _content(path, (status.st_ino, status.st_mtime_ns))
        except (OSError, ValueError):  # just removed, or incomplete on a full disk; read again next time
            continue
        yield content


def topic_publishers(run_dir: Path, topic: str) -> list[PublisherInfo]:
    """Return the live publishers of one topic."""
    return [_publisher(entry) for entry in _entries(topic_dir(run_dir, topic))]


class TopicFolder:
    """Live publishers of one topic. They are read again when its folder changes or a publisher's process has ended.

    Args:
        folder: folder of the topic, see :func:`topic_dir`.

    Attributes:
        publishers: publishers found at the last :meth:`read`.
    """

    def __init__(self, folder: Path) -> None:
        self.publishers: list[PublisherInfo] = []
        self._folder = str(folder)
        self._seen_mtime = -1
        self._next_look_s = self._next_full_look_s = 0.0

    def look(self) -> bool:
        """Read the entries if they may have changed. Return whether they were read.

        Raises:
            OSError: the run directory is gone.
        """
        try:
            mtime = os.stat(self._folder).st_mtime_ns  # noqa: PTH116 - faster, five times a second per topic
        except FileNotFoundError:  # removed while empty; the next publisher creates it again
            os.stat(os.path.dirname(self._folder))  # noqa: PTH116, PTH120
            mtime = 0
        now = time.monotonic()
        same = mtime == self._seen_mtime
        if same and now < self._next_look_s:
            return False
        self._next_look_s = now + _LOOK_S
        if same and now < self._next_full_look_s and all(map(running, self.publishers)):
            return False
        self._seen_mtime, self._next_full_look_s = mtime if settled(mtime) else -1, now + _FULL_LOOK_S
        self.read()
        return True

    def read(self) -> None:
        """Read the entries."""
        self.publishers = [_publisher(entry) for entry in _entries(self._folder)]


class TopicWatch:
    """Topics of a run directory, which can be polled at low cost."""

    def __init__(self, run_dir: Path) -> None:
        self._root = run_dir / "topics"
        self._folders: dict[Path, TopicFolder] = {}

    def topics(self) -> list[TopicInfo]:
        """Return the topics that have a live publisher, sorted by name."""
        paths = sorted(self._root.iterdir()) if self._root.is_dir() else []
        self._folders = {path: self._folders.get(path) or TopicFolder(path) for path in paths}
        found = []
        for path, folder in self._folders.items():
            with suppress(OSError):  # just removed; the next call notices
                folder.look()
            if publishers := folder.publishers:
                found.append(TopicInfo("/" + path.name.replace(".", "/"), publishers[0].type_name, publishers))
        return found


def list_topics(run_dir: Path) -> list[TopicInfo]:
    """Return the topics that have a live publisher, sorted by name."""
    return TopicWatch(run_dir).topics()


def _publisher(entry: dict[str, Any]) -> PublisherInfo:
    return PublisherInfo(
        node=entry["node"],
        pid=entry["pid"],
        qos=entry["qos"],
        socket=Path(entry["socket"]),
        type_name=entry["type"],
        id=entry["id"],
        started_ns=entry["started_ns"],
    )


def settled(mtime_ns: int) -> bool:
    """Return whether the next change of a folder with this modification time will change that time.

    The kernel's file times advance in steps of up to 10 ms, so two changes in one step have the same time.
    """
    return not -_FILE_TIME_STEP_NS < time.time_ns() - mtime_ns < _FILE_TIME_STEP_NS


def running(publisher: PublisherInfo) -> bool:
    """Return whether a publisher's process exists. This is cheaper than testing its lock, but less certain."""
    try:
        os.kill(publisher.pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # a process of another user has this id
        return True
    return True


def list_nodes(run_dir: Path) -> list[NodeInfo]:
    """Return the live nodes, sorted by name. Unknown keys of an entry are ignored.

    Raises:
        RegistryError: an entry is incomplete, for example of a node of another version. It is not skipped, because the
            node could be a base.
    """
    known = {item.name for item in fields(NodeInfo)}
    found = []
    for entry in _entries(run_dir / "nodes"):
        try:
            found.append(NodeInfo(**{key: value for key, value in entry.items() if key in known}))
        except TypeError as error:
            name, pid = entry.get("name", "?"), entry.get("pid", "?")
            raise RegistryError(
                f"{run_dir / 'nodes'}: entry of node {name} (pid {pid}) is incomplete: stop that node, "
                "which may be of another version"
            ) from error
    return found


def sweep(run_dir: Path) -> int:
    """Remove the entries of dead processes and the empty folders of topics. Return the number of entries removed."""
    swept = 0
    for lock_path in [*(run_dir / "topics").glob("*/*.lock"), *(run_dir / "nodes").glob("*.lock")]:
        try:
            fd = open_lock(lock_path)
        except FileNotFoundError:  # the process has just ended and removed it
            continue
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        else:
            if not _is_at(fd, lock_path):  # the process has just removed it, and another may have claimed the name
                continue
            stem = lock_path.with_suffix("")
            leftovers = [p for s in (".json", ".sock") if (p := stem.with_name(stem.name + s)).exists()]
            leftovers += stem.parent.glob(f".{stem.name}.json.*.part")
            for path in (*leftovers, lock_path):
                path.unlink(missing_ok=True)
            swept += bool(leftovers)
        finally:
            os.close(fd)
    for folder in (run_dir / "topics").glob("*"):
        with suppress(OSError):  # not empty
            folder.rmdir()
    return swept
