"""A Zenoh session that provides our topics as ROS 2 nodes, publishers and subscriptions, as rmw_zenoh does.

Independent of our bus: bytes in, bytes out. Zenoh is an extra, imported when a session is opened.
"""

from __future__ import annotations

import itertools
import json
import logging
import os
import queue
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from instant_ic.bridge.zenoh_format import (
    ADMIN_SPACE,
    SENDER_SIZE,
    FormatError,
    Kind,
    Token,
    TopicQoS,
)
from instant_ic.util.closing import Closing
from instant_ic.util.paths import shipped_file

DEFAULT_ROUTER = "tcp/localhost:7447"

_OPEN_S = 10.0

SESSION_DEFAULTS = {
    "mode": '"peer"',
    "connect/endpoints": f'["{DEFAULT_ROUTER}"]',
    "listen/endpoints": '["tcp/localhost:0"]',
    "scouting/multicast/enabled": "false",
    "scouting/gossip/enabled": "true",
    # The cache of a latched topic sorts by time.
    "timestamping/enabled": "{router: true, peer: true, client: true}",
}
"""Configuration of rmw_zenoh's sessions: peers of the router on their host, which introduces them; no multicast."""

CLIENT_DEFAULTS = {**SESSION_DEFAULTS, "mode": '"client"', "listen/endpoints": "[]"}
"""For a router on another host: Zenoh routers do not forward messages between peers without a direct link."""

ROUTER_DEFAULTS = {
    **SESSION_DEFAULTS,
    "mode": '"router"',
    "connect/endpoints": "[]",
    "listen/endpoints": f'["{DEFAULT_ROUTER}"]',
}

log = logging.getLogger(__name__)


class ZenohError(RuntimeError):
    """Zenoh is not installed, or rejects its configuration; the message says what to do."""


def zenoh() -> Any:
    """Return the zenoh package.

    Raises:
        ZenohError: the extra is not installed.
    """
    try:
        import zenoh
        import zenoh.ext
    except ImportError as error:
        raise ZenohError(f"Zenoh is not installed ({error}): pip install 'instant-ic[zenoh]'") from None
    return zenoh


def config_path(name: str) -> Path | None:
    """Return a configuration file by path, or by name among the files of config/; None for an empty name.

    Raises:
        FileNotFoundError: there is no such file in either place.
    """
    if not name:
        return None
    path = Path(name).expanduser()
    return path if path.is_file() or "/" in name else shipped_file("config", name)


def load_config(
    path: Path | None,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    defaults: Mapping[str, str] = SESSION_DEFAULTS,
) -> Any:
    """Load a Zenoh configuration.

    Args:
        path: a Zenoh JSON5 file, used unchanged; None uses ``defaults``.
        connect: endpoints to connect to (``tcp/10.0.0.1:7447``), instead of those of the file.
        listen: endpoints to listen on, instead of those of the file.
        defaults: Zenoh configuration keys → JSON5 values.

    Raises:
        ZenohError: the file cannot be read or is not a Zenoh configuration, or an endpoint is invalid.
    """
    package = zenoh()
    try:
        if path is not None:
            config = package.Config.from_json5(path.read_text())
        else:
            config = package.Config()
            for key, value in defaults.items():
                config.insert_json5(key, value)
    except OSError as error:
        raise ZenohError(f"{path}: cannot be read: {error.strerror}") from None
    except package.ZError as error:
        raise ZenohError(f"{path or 'defaults'}: not a Zenoh configuration: {_words(error)}") from None
    for key, endpoints in (("connect/endpoints", connect), ("listen/endpoints", listen)):
        if endpoints:
            try:
                config.insert_json5(key, json.dumps(list(endpoints)))
            except package.ZError as error:
                raise ZenohError(f"{key} {list(endpoints)}: {_words(error)}") from None
    return config


def is_client(config: Any) -> bool:
    """Return whether the configuration is a client's; a client cannot open before its router runs."""
    return bool(json.loads(config.get_json("mode")) == "client")


def open_zenoh(config: Any) -> Any:
    """Open a Zenoh session. In peer mode it searches for a missing router in the background.

    Raises:
        ZenohError: an endpoint or certificate cannot be used, or a client finds no router.
    """
    package = zenoh()
    package.init_log_from_env_or("error")
    opened: queue.SimpleQueue[Any] = queue.SimpleQueue()
    given_up = threading.Event()

    def work() -> None:
        try:
            session = package.open(config)
        except package.ZError as error:
            opened.put(error)
            return
        opened.put(session)
        if given_up.is_set():
            session.close()

    # Depending on its configuration, Zenoh may wait forever.
    threading.Thread(target=work, name="zenoh open", daemon=True).start()
    try:
        session = opened.get(timeout=_OPEN_S)
    except queue.Empty:
        given_up.set()
        raise ZenohError(
            f"Zenoh session: not open after {_OPEN_S:g} s; a client waits for its router: is it running?"
        ) from None
    if isinstance(session, package.ZError):
        raise ZenohError(f"Zenoh session: {_words(session)}")
    return session


def _words(error: Exception) -> str:
    """Return the text of a Zenoh error without source locations."""
    return re.sub(r"\s+at /\S+\.rs:\d+\.?", "", str(error)).strip()


class RosSession(Closing):
    """Nodes of the ROS graph in one Zenoh session. A context manager.

    Args:
        config: see :func:`load_config`.
        domain: ROS domain.

    Raises:
        ZenohError: see :func:`open_zenoh`.
    """

    def __init__(self, config: Any, domain: int = 0) -> None:
        self.domain = domain
        self.zenoh = open_zenoh(config)
        self.id = str(self.zenoh.info.zid())
        self.gid_head = os.urandom(SENDER_SIZE)
        self._ids = itertools.count()
        self._watch: Any = None

    def close(self) -> None:
        """Close the session with all its tokens, publishers and subscriptions."""
        if not self.zenoh.is_closed():
            self.zenoh.close()

    def routers(self) -> list[str]:
        return [str(zid) for zid in self.zenoh.info.routers_zid()]

    def peers(self) -> list[str]:
        return [str(zid) for zid in self.zenoh.info.peers_zid()]

    def token(self, kind: Kind, node: RosNode | None, namespace: str, name: str, *endpoint: Any) -> tuple[Token, Any]:
        """Create the token of a new entity; return it with its declaration."""
        entity = next(self._ids)
        token = Token(
            kind, self.domain, self.id, entity if node is None else node.id, entity, namespace, name, *endpoint
        )
        return token, self.zenoh.liveliness().declare_token(token.key())

    def watch(self, on_token: Callable[[Token, bool], None]) -> None:
        """Call ``on_token(token, alive)`` for current and future entities of other sessions, on a Zenoh thread."""
        put = zenoh().SampleKind.PUT

        def heard(sample: Any) -> None:
            try:
                token = Token.parse(str(sample.key_expr))
            except FormatError as error:
                log.warning("%s", error)
                return
            if token is not None and token.session != self.id:
                on_token(token, sample.kind == put)

        self._watch = self.zenoh.liveliness().declare_subscriber(f"{ADMIN_SPACE}/{self.domain}/**", heard, history=True)


class RosNode:
    """A node of the ROS graph, as shown by ``ros2 node list``.

    Args:
        session: session of the node.
        namespace: ``/robot1``, or ``/``.
    """

    def __init__(self, session: RosSession, namespace: str, name: str) -> None:
        self.session = session
        self.namespace = namespace
        self.name = name
        token, self._declaration = session.token("NN", None, namespace, name)
        self.id = token.node_id

    def endpoint(self, kind: Kind, topic: str, type_name: str, type_hash: str, qos: TopicQoS) -> Any:
        """Declare the token of one of the node's publishers or subscriptions."""
        return self.session.token(kind, self, self.namespace, self.name, topic, type_name, type_hash, qos)[1]

    def close(self) -> None:
        self._declaration.undeclare()
