"""Control channel of a node: read and change its parameters and log level while it runs.

Each node process listens on ``RUN_DIR/nodes/<node>.sock`` (a Unix socket in a folder of mode 0700). A request is one
line of JSON, ``{"op": "set", "values": {"rate_hz": "5.0"}}`` with values as YAML text. The answer is one line too:
``{"ok": true, ...}`` or ``{"ok": false, "error": "what is wrong", "kind": "parameter"}``. Threads of the server answer,
even while the node's own thread is in a long callback. Only a change waits for the node's thread. It is dropped if it
has waited too long.
"""

from __future__ import annotations

import concurrent.futures
import difflib
import json
import logging
import os
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from instant_ic.bus import registry
from instant_ic.bus.callbacks import NodeError
from instant_ic.bus.node_report import set_log_level
from instant_ic.config.parameter_info import ParameterInfo
from instant_ic.config.params import ParameterError, yaml_value
from instant_ic.config.yaml_text import one_line

if TYPE_CHECKING:
    from instant_ic.bus.node import Node

MAX_REQUEST_BYTES = 256 * 1024
MAX_ANSWER_BYTES = 16 * 1024 * 1024
MAX_CONNECTIONS = 8
LEVELS = ("debug", "info", "warning", "error")

_IDLE_S = 5.0  # an idle connection is closed after this time
_CHANGE_S = 2.0  # how long a change waits for the node's thread

log = logging.getLogger(__name__)


class ControlError(RuntimeError):
    """The node is not running, does not answer or refuses the request."""


class NodeMissingError(ControlError):
    """The node is not running."""


class NodeBusyError(ControlError):
    """The node's own thread is in a long callback; nothing has been changed."""


class _RequestError(ControlError):
    """An invalid request."""


class ControlServer:
    """Answers requests for one node.

    Args:
        node: the node.
        path: path of the socket. An existing file is replaced, because the caller holds the node's claim.

    Raises:
        RegistryError: the path is too long for a socket or cannot be bound.
    """

    def __init__(self, node: Node[Any], path: Path) -> None:
        self.path = registry.check_socket_path(path)
        self._node = node
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
        try:
            path.unlink(missing_ok=True)
            self._listener.bind(str(path))
            self._listener.listen(MAX_CONNECTIONS)
        except OSError as error:
            self._listener.close()
            raise registry.RegistryError(f"control socket {path}: {error}") from error
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)
        self._thread.start()

    def close(self) -> None:
        try:
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread from accept()
        except OSError as error:
            log.debug("control socket %s: %s", self.path, error)
        self._listener.close()
        self.path.unlink(missing_ok=True)
        self._thread.join(1.0)

    def _run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:  # closed
                return
            if self._slots.acquire(blocking=False):
                threading.Thread(target=self._serve, args=(connection,), name="control", daemon=True).start()
                continue
            with connection:
                connection.settimeout(_IDLE_S)
                _send(connection, _refusal(f"more than {MAX_CONNECTIONS} connections at once", "request"))

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rb") as reader:
                connection.settimeout(_IDLE_S)
                while line := _read_line(reader, MAX_REQUEST_BYTES):
                    _send(connection, self.answer(line))
        except _RequestError as error:
            log.warning("control: %s", error)
        except OSError as error:  # the client disconnected or went idle
            log.debug("control: %s", error)
        finally:
            self._slots.release()

    def answer(self, line: bytes) -> dict[str, Any]:
        """Answer one request."""
        try:
            request = _parse(line)
            operation = self._operations().get(str(request.get("op")))
            if operation is None:
                known = ", ".join(self._operations())
                raise _RequestError(f"unknown op {request.get('op')!r} (known: {known})")
            return {"ok": True, **operation(request)}
        except _RequestError as error:
            return _refusal(str(error), "request")
        except ParameterError as error:
            return _refusal(str(error), "parameter")
        except NodeBusyError as error:
            return _refusal(str(error), "busy")
        except Exception as error:  # a bug in an operation is reported to the client and must not end the node
            log.exception("control")
            return _refusal(f"{type(error).__name__}: {error}", "internal")

    def _operations(self) -> dict[str, Callable[[dict[str, Any]], dict[str, Any]]]:
        return {
            "describe": self._describe,
            "set": self._set,
            "log_level": self._log_level,
            "status": self._status,
            "call": self._call,
        }

    def _describe(self, request: dict[str, Any]) -> dict[str, Any]:
        return {"parameters": [asdict(info) for info in self._node.parameters.infos()]}

    def _set(self, request: dict[str, Any]) -> dict[str, Any]:
        texts = request.get("values")
        if not isinstance(texts, dict) or not texts:
            raise _RequestError('set needs "values": {key: YAML text}')
        values = {key: yaml_value(str(text), key) for key, text in texts.items()}
        return {"changed": self._on_node(lambda: self._node.parameters.set(values))}

    def _log_level(self, request: dict[str, Any]) -> dict[str, Any]:
        level = request.get("level")
        if level is not None:
            if level not in LEVELS:
                raise _RequestError(f"level must be one of {', '.join(LEVELS)} (got {level!r})")
            set_log_level(self._node.node_name, level)
        return {"level": logging.getLevelName(self._node.log.getEffectiveLevel()).lower()}

    def _status(self, request: dict[str, Any]) -> dict[str, Any]:
        what, busy_s = self._node.callbacks.activity()
        return {"pid": os.getpid(), "threads": threading.active_count(), "busy": what, "busy_s": round(busy_s, 3)}

    def _call(self, request: dict[str, Any]) -> dict[str, Any]:
        name, arguments = str(request.get("command")), request.get("arguments", {})
        command = self._node.commands.get(name)
        if command is None and self._node.run_state == "STARTING":
            raise NodeBusyError(f"{self._node.node_name} is still starting; try again")
        if command is None:
            known = ", ".join(self._node.commands) or "none"
            raise _RequestError(f"{self._node.node_name} has no command {name!r} (known: {known})")
        if not isinstance(arguments, dict):
            raise _RequestError('call needs "arguments": {name: value}')
        try:
            return {"result": self._on_node(lambda: command(**arguments))}
        except (ValueError, TypeError, NodeError) as error:
            raise _RequestError(f"{name}: {error}") from error

    def _on_node(self, function: Callable[[], Any]) -> Any:
        """Run a function on the node's thread and return its result.

        Raises:
            NodeBusyError: the node's thread was busy for too long. The function has not run and will not run.
            _RequestError: the function has started but not finished in time. It may still take effect.
        """
        future: concurrent.futures.Future[Any] = concurrent.futures.Future()

        def run() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(function())
            except Exception as error:  # noqa: BLE001 - the client gets the exception
                future.set_exception(error)

        self._node.call_soon(run)
        try:
            return future.result(_CHANGE_S)
        except concurrent.futures.TimeoutError:
            if not future.cancel():  # the function has just started
                try:
                    return future.result(_CHANGE_S)
                except concurrent.futures.TimeoutError:
                    raise _RequestError(
                        f"{self._node.node_name} has started the change but not finished it within {_CHANGE_S:g} s; "
                        "it may still take effect: check the value before you repeat it"
                    ) from None
            what, busy_s = self._node.callbacks.activity()
            doing = f"{what} has been running for {busy_s:.1f} s" if what else "its loop is not running"
            raise NodeBusyError(f"{self._node.node_name} is busy ({doing}); nothing was changed") from None


class NodeControl:
    """Client of one running node; each call is one request with a time-out.

    Args:
        run_dir: run directory of the stack.
        node: name of the node.
        timeout_s: time to wait for each answer.

    Raises:
        ControlError: raised by each method if the node is not running, does not answer or refuses the request.
    """

    def __init__(self, run_dir: Path, node: str, timeout_s: float = 5.0) -> None:
        self.run_dir = run_dir
        self.node = node.strip("/")
        self.timeout_s = timeout_s

    def describe(self) -> list[ParameterInfo]:
        """Return a description of every parameter of the node."""
        return [ParameterInfo(**entry) for entry in self.request({"op": "describe"})["parameters"]]

    def get(self) -> dict[str, Any]:
        """Return the value of every parameter."""
        return {info.name: info.value for info in self.describe()}

    def set(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Change several parameters together, or none. Return those whose value has changed.

        Args:
            values: key to value; a plain value, or one with the spelling of its scalars (``yaml_text.spelled``).

        Raises:
            ParameterError: a value is refused for the reason in the message.
            NodeBusyError: the node's thread is busy.
        """
        texts = {key: one_line(value) for key, value in values.items()}
        changed: dict[str, Any] = self.request({"op": "set", "values": texts})["changed"]
        return changed

    def log_level(self, level: str | None = None) -> str:
        """Set the node's log level if ``level`` is given. Return the present level."""
        return str(self.request({"op": "log_level", "level": level})["level"])

    def status(self) -> dict[str, Any]:
        """Return ``pid``, ``threads``, ``busy`` (running callback, or empty) and ``busy_s`` (for how long)."""
        return self.request({"op": "status"})

    def call(self, command: str, **arguments: Any) -> Any:
        """Run one of the node's ``commands`` and return its result."""
        return self.request({"op": "call", "command": command, "arguments": arguments})["result"]

    def request(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send one request and return the answer.

        Raises:
            ParameterError: the node refused a value.
            ControlError: the node refused the request, or there is no answer.
        """
        path = self.run_dir / "nodes" / f"{self.node}.sock"
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(self.timeout_s)
            try:
                connection.connect(str(path))
                _send(connection, request)
                with connection.makefile("rb") as reader:
                    line = _read_line(reader, MAX_ANSWER_BYTES)
            except TimeoutError:
                raise ControlError(
                    f"node {self.node} did not answer within {self.timeout_s:g} s: its process hangs or is stopped "
                    f"(ic node list shows its pid)"
                ) from None
            except (FileNotFoundError, ConnectionRefusedError):
                raise NodeMissingError(self._not_there()) from None
            except OSError as error:
                raise ControlError(f"node {self.node}: {path}: {error}") from error
        if not line:
            raise ControlError(f"node {self.node} ended before it answered")
        answer = _parse(line)
        if answer.get("ok"):
            return answer
        kinds = {"parameter": ParameterError, "busy": NodeBusyError}
        raise kinds.get(str(answer.get("kind")), ControlError)(str(answer.get("error", "refused without a reason")))

    def _not_there(self) -> str:
        running = [node.name for node in registry.list_nodes(self.run_dir)]
        if self.node in running:
            return f"node {self.node} is running but accepts no requests: it is starting up, shutting down or outdated"
        close = difflib.get_close_matches(self.node, running, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"running: {', '.join(running) or 'none'}"
        return f"node {self.node!r} does not run in {self.run_dir} ({hint})"


def _read_line(reader: BinaryIO, max_bytes: int) -> bytes:
    """Return the next line. Empty if the other side has closed the connection."""
    line = reader.readline(max_bytes + 1)
    if len(line) > max_bytes:
        raise _RequestError(f"line longer than {max_bytes} bytes")
    return line if line.endswith(b"\n") else b""


def _send(connection: socket.socket, content: Mapping[str, Any]) -> None:
    connection.sendall(json.dumps(content, default=str).encode() + b"\n")


def _parse(line: bytes) -> dict[str, Any]:
    try:
        content = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise _RequestError(f"not JSON: {error}") from None
    if not isinstance(content, dict):
        raise _RequestError("expected a JSON object")
    return content


def _refusal(error: str, kind: str) -> dict[str, Any]:
    return {"ok": False, "error": error, "kind": kind}
