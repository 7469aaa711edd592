"""The file system as registry: who publishes what, and which nodes run, in one run directory.

Layout::

    RUN_DIR/topics/<topic, "/" as ".">/<node>.{sock,json,lock}
    RUN_DIR/nodes/<node>.{json,lock}

A lock (``flock``) is held for as long as its owner lives; the kernel lets go of it even after SIGKILL. So a JSON whose
lock can be taken belongs to a dead process and is swept.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")
_MAX_IPC_PATH = 107  # sockaddr_un.sun_path less its final zero


class RegistryError(RuntimeError):
    """The run directory cannot be used, or a name in it is taken."""


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
    module: str
    pid: int
    started_ns: int
    params: dict[str, Any]
    publishes: dict[str, str] = field(default_factory=dict)
    subscribes: dict[str, str] = field(default_factory=dict)


def check_topic(topic: str) -> str:
    """The topic itself, if its name is legal (``/a/b_c``).

    Raises:
        RegistryError: otherwise.
    """
    if not _TOPIC.match(topic):
        raise RegistryError(f"topic name {topic!r} is not legal: it must look like /camera/image")
    return topic


def check_node_name(name: str) -> str:
    """The node's name itself, if it is legal (letters, digits, underscores).

    Raises:
        RegistryError: otherwise.
    """
    if not _NAME.match(name):
        raise RegistryError(f"node name {name!r} is not legal: letters, digits and underscores only")
    return name


def prepare(run_dir: Path) -> Path:
    """Makes the run directory with mode 0700, or checks that it is ours.

    Raises:
        RegistryError: it cannot be made or written, or it belongs to someone else.
    """
    try:
        run_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        owner = run_dir.stat().st_uid
        if owner != os.getuid():
            raise RegistryError(
                f"run directory {run_dir} belongs to user {owner}: set INSTANT_IC_RUN_DIR to one of yours"
            )
        run_dir.chmod(0o700)
        for name in ("topics", "nodes", "dev", "log"):
            (run_dir / name).mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise RegistryError(
            f"run directory {run_dir} cannot be used: {error}; set INSTANT_IC_RUN_DIR to another"
        ) from error
    return run_dir


def topic_dir(run_dir: Path, topic: str) -> Path:
    """Folder of a topic's publishers."""
    return run_dir / "topics" / check_topic(topic)[1:].replace("/", ".")


class Claim:
    """A name in the registry, held by a lock until it is released or the process ends.

    Args:
        stem: path without suffix; ``.lock`` and ``.json`` stand beside each other.
        what: for the error message.
        timeout_s: how long to wait for a predecessor that is just ending.

    Raises:
        RegistryError: another live process holds the name.
    """

    def __init__(self, stem: Path, what: str, timeout_s: float = 2.0) -> None:
        self.stem = stem
        self._what = what
        self.json_path = stem.with_name(stem.name + ".json")
        lock_path = stem.with_name(stem.name + ".lock")
        try:
            stem.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._fd = os.open(lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise RegistryError(f"{what}: {error}") from error
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() > deadline:
                    os.close(self._fd)
                    raise RegistryError(f"{what} is already there: another process holds {lock_path}") from None
                time.sleep(0.02)

    def write(self, content: dict[str, Any]) -> None:
        """Replaces the JSON in one step, so that a reader never sees half of it.

        Raises:
            RegistryError: the disk is full, or the run directory is gone.
        """
        scratch = self.json_path.with_suffix(".tmp")
        try:
            scratch.write_text(json.dumps(content, default=str))
            scratch.replace(self.json_path)
        except OSError as error:
            scratch.unlink(missing_ok=True)
            raise RegistryError(f"{self._what} cannot be told to others: {error}") from error

    def release(self) -> None:
        """Takes the JSON away and gives the lock back; twice does no harm."""
        if self._fd >= 0:
            self.json_path.unlink(missing_ok=True)
            os.close(self._fd)
            self._fd = -1


def check_socket_path(path: Path) -> Path:
    """The path itself, if a socket can be bound there.

    Raises:
        RegistryError: it is too long.
    """
    if len(os.fsencode(path)) > _MAX_IPC_PATH:
        raise RegistryError(
            f"socket path {path} is longer than {_MAX_IPC_PATH} bytes: set INSTANT_IC_RUN_DIR to a shorter folder"
        )
    return path


def claim_socket(run_dir: Path, topic: str, node: str) -> tuple[Claim, Path]:
    """Claims a publisher's place; the socket path is free to bind.

    Raises:
        RegistryError: the place is taken, or the path is too long for a socket.
    """
    stem = topic_dir(run_dir, topic) / check_node_name(node)
    socket = check_socket_path(stem.with_name(stem.name + ".sock"))
    claim = Claim(stem, f"publisher of {topic} by node {node}")
    socket.unlink(missing_ok=True)
    return claim, socket


def _alive(json_path: Path) -> bool:
    """Whether the owner of a JSON holds its lock."""
    lock_path = json_path.with_suffix(".lock")
    try:
        fd = os.open(lock_path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _entries(folder: Path) -> Iterator[dict[str, Any]]:
    for path in sorted(folder.glob("*.json")):
        if not _alive(path):
            continue
        try:
            content = json.loads(path.read_text())
        except (OSError, ValueError):  # gone in this moment, or the disk is full: the next look decides
            continue
        yield content


def topic_publishers(run_dir: Path, topic: str) -> list[PublisherInfo]:
    """Live publishers of one topic."""
    return [_publisher(entry) for entry in _entries(topic_dir(run_dir, topic))]


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


def list_topics(run_dir: Path) -> list[TopicInfo]:
    """Topics with a live publisher, by name."""
    topics = []
    root = run_dir / "topics"
    for folder in sorted(root.iterdir()) if root.is_dir() else []:
        entries = list(_entries(folder))
        if entries:
            publishers = [_publisher(entry) for entry in entries]
            topics.append(TopicInfo(entries[0]["topic"], publishers[0].type_name, publishers))
    return topics


def list_nodes(run_dir: Path) -> list[NodeInfo]:
    """Live nodes, by name."""
    return [NodeInfo(**entry) for entry in _entries(run_dir / "nodes")]


def sweep(run_dir: Path) -> int:
    """Takes away what dead processes left; returns how many places were cleared."""
    swept = 0
    for lock_path in [*(run_dir / "topics").glob("*/*.lock"), *(run_dir / "nodes").glob("*.lock")]:
        fd = os.open(lock_path, os.O_RDWR | os.O_CLOEXEC)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        else:
            stem = lock_path.with_suffix("")
            # The lock file itself stays: a process that waits for it would lock a file that no path names.
            leftovers = [p for s in (".json", ".sock", ".tmp") if (p := stem.with_name(stem.name + s)).exists()]
            for path in leftovers:
                path.unlink(missing_ok=True)
            swept += bool(leftovers)
        finally:
            os.close(fd)
    return swept
