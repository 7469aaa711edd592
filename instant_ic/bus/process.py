"""One node as a process: command line, parameters, signals, registry."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from instant_ic.bus import registry
from instant_ic.bus.callbacks import NodeError
from instant_ic.bus.clock import Clock, ManualClock, SystemClock
from instant_ic.bus.control import ControlServer
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import Node
from instant_ic.config import params
from instant_ic.msg import MessageError
from instant_ic.util import pace, paths
from instant_ic.util.safe_text import masked, visible

_SETUP_ENDS_S = 1.0
"""Time that a node's ``setup`` gets to end after a signal. The launcher sends its next signal after 2.5 s."""


def argument_parser(node_class: type[Node[Any]]) -> argparse.ArgumentParser:
    """Return the command line parser of a node."""
    parser = argparse.ArgumentParser(
        prog=f"ic run {node_class.name}",
        description=(sys.modules[node_class.__module__].__doc__ or "").strip(),
        epilog=f"example: ic run {node_class.name} --params-file my_{node_class.name}.yaml -p use_sim_time:=true\n"
        f"parameters: docs/reference.md, or ic config show {node_class.name}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--name", default=node_class.name, help="name of this node (default: %(default)s)")
    parser.add_argument("--namespace", default="", help="put before every topic")
    parser.add_argument(
        "--params-file", action="append", default=[], type=Path, metavar="FILE", help="ROS 2 parameter file; repeatable"
    )
    parser.add_argument(
        "-p", "--param", action="append", default=[], metavar="KEY:=VALUE", help="one parameter; repeatable"
    )
    parser.add_argument(
        "-r", "--remap", action="append", default=[], metavar="FROM:=TO", help="other name for a topic; repeatable"
    )
    parser.add_argument("--run-dir", type=Path, default=None, help="run directory (default: $INSTANT_IC_RUN_DIR)")
    parser.add_argument(
        "--log-level", default="info", choices=["debug", "info", "warning", "error"], help="default: %(default)s"
    )
    return parser


def parse_remaps(words: Sequence[str]) -> dict[str, str]:
    """Parse ``from:=to`` arguments into names and their replacements.

    Raises:
        ParameterError: an argument has no ``:=``.
    """
    remaps = {}
    for word in words:
        source, separator, target = word.partition(":=")
        if not separator or not source or not target:
            raise params.ParameterError(f"-r {word}: expected from:=to")
        remaps[source] = target
    return remaps


def _stop_on_signals(node: Node[Any]) -> None:
    """End the loop on SIGINT and SIGTERM. Teardown then runs on the node's own thread.

    A signal handler interrupts the main thread, which may hold the lock that :meth:`Node.stop` needs. Calling it there
    would deadlock. The handler therefore does nothing, and a thread that reads the signal from a pipe stops the node.
    """
    heard, written = os.pipe()
    os.set_blocking(written, False)
    signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)

    def wait_for_signal() -> None:
        os.read(heard, 1)
        node.stop()
        time.sleep(_SETUP_ENDS_S)
        if node.run_state == "STARTING":  # in a compiler, or waiting for a device; no motor or bag is in use yet
            leave(0)

    threading.Thread(target=wait_for_signal, name="signals", daemon=True).start()


def main(node_class: type[Node[Any]], argv: Sequence[str] | None = None) -> None:
    """Run a node until SIGINT or SIGTERM. Exit with 0, with 1 on failure, or with 2 on wrong usage or parameters.

    If ``argv`` is None, the process's own command line is used and the process exits without interpreter shutdown.
    """
    status = run(node_class, argv)
    if argv is None:
        leave(status)
    sys.exit(status)


def leave(status: int) -> NoReturn:
    """End the process at once, without interpreter shutdown.

    Shutdown takes 0.7 s of CPU with numba's compiler loaded, and waits for threads that a library has left running. The
    node has already closed its motors, bag, sockets and registry entries. Only memory is left to free.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # the reader is gone, or the stream is closed
            stream.flush()
    os._exit(status)


class SafeFormatter(logging.Formatter):
    """Formats log lines without control characters and passwords."""

    def format(self, record: logging.LogRecord) -> str:
        return masked(visible(super().format(record)))


def run(node_class: type[Node[Any]], argv: Sequence[str] | None = None) -> int:
    """Run a node as :func:`main` does, but return the exit status."""
    args = argument_parser(node_class).parse_args(argv)
    handler = logging.StreamHandler(sys.stderr)
    text = f"%(asctime)s.%(msecs)03d %(levelname)-7s {args.name}: %(message)s"
    handler.setFormatter(SafeFormatter(text, datefmt="%Y-%m-%d %H:%M:%S"))
    # Debug output of other packages would flood the node's log.
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    log = logging.getLogger(args.name)
    for logger in (log, logging.getLogger("instant_ic")):
        logger.setLevel(args.log_level.upper())
    try:
        values = params.gather(args.name, args.params_file, args.param)
        config, process = params.configure(node_class.config_class(), values)
        remaps = parse_remaps(args.remap)
        registry.check_node_name(args.name)
    except (params.ParameterError, registry.RegistryError) as error:
        log.error("%s", error)
        return 2
    run_dir = args.run_dir or paths.run_dir()
    try:
        registry.prepare(run_dir)  # checks the folder before any file in it is trusted
        pace.use(pace.read(run_dir))
        clock: Clock = ManualClock() if process.use_sim_time else SystemClock()
        transport = LocalTransport(run_dir, args.name, clock.now_ns, clock.steady_ns)
        claim = registry.Claim(run_dir / "nodes" / args.name, f"node {args.name}")
    except (registry.RegistryError, pace.PaceError) as error:
        log.error("%s", error)
        return 1
    node = node_class(config, transport, clock, args.name, args.namespace, remaps, use_sim_time=process.use_sim_time)
    os.nice(process.nice)
    node.nice = process.nice
    started_ns = time.time_ns()
    _stop_on_signals(node)
    status = 0
    control: ControlServer | None = None
    try:
        control = ControlServer(node, run_dir / "nodes" / f"{args.name}.sock")
        node.on_registry_change = lambda: claim.write({**node.describe(), "started_ns": started_ns})
        node.start()
        claim.write({**node.describe(), "started_ns": started_ns})
        log.info("running")
        node.spin()
        log.info("stopping")
    except (NodeError, registry.RegistryError, MessageError) as error:
        log.error("%s", error)
        status = 1
    except Exception:  # log the traceback as a last resort; teardown still runs
        log.exception("failed")
        status = 1
    finally:
        if control is not None:
            control.close()
        try:
            node.close()
        finally:
            claim.release()
    return status
