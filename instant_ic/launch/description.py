"""Contents of a launch file after reading and checking (docs/launch.md lists its keys)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from instant_ic.util import paths

HANG_TIMEOUT_S = 10.0
"""Default hang time-out: a node without a heartbeat for longer than this counts as hung."""


@dataclass(frozen=True)
class LaunchArgument:
    """An ``arg`` of a launch file.

    Attributes:
        default: default value; None if a value must be given.
        description: text for ``--show-args``.
        type: ``str``, ``int``, ``float``, ``bool`` or ``path``.
        choices: allowed values; empty if any value is allowed.
    """

    name: str
    default: str | None
    description: str
    line: int
    type: str = "str"
    choices: tuple[str, ...] = ()
    file: Path = Path()


@dataclass(frozen=True)
class NodeSpec:
    """One process to start.

    Attributes:
        name: its name on the bus, unique in its run directory whatever its namespace.
        exec: name of a shipped node, or the path of a program.
        command: the whole command line, without the run directory.
        namespace: prefix of its topics.
        env: environment variables to add; None removes one.
        respawn: restart it when it ends.
        respawn_delay_s: wait before the first restart; doubles with each further one within the window.
        required: when it ends, the whole stack ends.
        file: the launch file that contains it.
        respawn_max_retries: total number of restarts before it is given up; -1: limited by the window only.
        run_dir: its run directory; None: the stack's own.
        group: name of that run directory within the stack's, shown before the node's name; else empty.
        heartbeat: whether the process is a node that sends heartbeats (an ``executable`` does not).
        hang_timeout_s: without a heartbeat for longer than this it counts as hung; 0: never.
        start_delay_s: wait after the start of the stack (``timer``).
        sigterm_timeout_s: wait between SIGINT and SIGTERM at shutdown; None: the stack's.
        sigkill_timeout_s: wait between SIGTERM and SIGKILL; None: the stack's.
        to_terminal: whether its output goes to the terminal, besides the log file.
        cwd: working directory; None: the launcher's.
        places: ``file:line`` of each ``-p`` argument of the command.
    """

    name: str
    exec: str
    command: tuple[str, ...]
    namespace: str = ""
    env: Mapping[str, str | None] = field(default_factory=dict)
    respawn: bool = False
    respawn_delay_s: float = 1.0
    required: bool = False
    file: Path = Path()
    line: int = 0
    respawn_max_retries: int = -1
    run_dir: Path | None = None
    group: str = ""
    heartbeat: bool = True
    hang_timeout_s: float = HANG_TIMEOUT_S
    start_delay_s: float = 0.0
    sigterm_timeout_s: float | None = None
    sigkill_timeout_s: float | None = None
    to_terminal: bool = True
    cwd: Path | None = None
    places: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name shown to users: ``NODE``, or ``GROUP/NODE`` in a run directory of its own."""
        return f"{self.group}/{self.name}" if self.group else self.name


@dataclass(frozen=True)
class Announcement:
    """Text to print some seconds after the start (``log``)."""

    text: str
    delay_s: float = 0.0


@dataclass(frozen=True)
class Shutdown:
    """Clean end of the stack some seconds after its start (``shutdown``)."""

    reason: str
    delay_s: float = 0.0


@dataclass(frozen=True)
class LaunchDescription:
    """Everything that a launch file starts and does, with its arguments applied.

    Attributes:
        shutdown: when the stack ends by itself; None: never.
    """

    file: Path
    arguments: tuple[LaunchArgument, ...]
    values: Mapping[str, str]
    nodes: tuple[NodeSpec, ...]
    announcements: tuple[Announcement, ...] = ()
    shutdown: Shutdown | None = None

    @property
    def simulated(self) -> bool:
        """Whether the devices are simulated, so that the stack's time need not be the machine's."""
        return any(node.exec == "simulator" for node in self.nodes)

    def run_dirs(self, run_dir: Path) -> list[Path]:
        """All run directories of the stack, its own first."""
        others = {node.run_dir for node in self.nodes if node.run_dir is not None}
        return [run_dir, *sorted(others - {run_dir})]


def find_launch_file(name: str) -> Path:
    """Find a launch file by path, or by the name of a shipped one (``sim`` or ``sim.yaml``).

    Raises:
        FileNotFoundError: neither; the message lists the shipped ones.
    """
    path = Path(name)
    if paths.is_file(path):
        return path.resolve()
    if path.name == name:
        return paths.shipped_file("launch", name if path.suffix else f"{name}.yaml")
    raise FileNotFoundError(f"{name} does not exist")
