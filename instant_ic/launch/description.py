"""Contents of a launch file after reading and checking. docs/launch.md lists its keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from instant_ic.config.yaml_place import YamlProblem
from instant_ic.util import paths

HANG_TIMEOUT_S = 10.0
"""Default time-out after which a node without a heartbeat counts as hung."""


class LaunchFileError(ValueError):
    """A launch file or its includes have mistakes; ``problems`` lists them."""

    def __init__(self, problems: Sequence[YamlProblem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = list(problems)


@dataclass(frozen=True)
class LaunchArgument:
    """An ``arg`` of a launch file.

    Attributes:
        default: default value; None if a value must be given.
        description: text for ``--show-args``.
        type: ``str``, ``int``, ``float``, ``bool`` or ``path``.
    """

    name: str
    default: str | None
    description: str = ""
    type: str = "str"


@dataclass(frozen=True)
class NodeSpec:
    """One node to start.

    Attributes:
        name: name on the bus, unique in its run directory.
        exec: name of a shipped node, or the path of a program.
        command: the whole command line, without the run directory.
        env: environment variables to add.
        respawn: restart the node when it ends.
        respawn_delay_s: wait before the first restart; doubles with each further restart within the window.
        required: true if the stack ends with this node.
        file: the launch file that contains the node.
        line: line of the node in that file.
        run_dir: run directory of the node; None: the stack's own.
        group: name of that run directory within the stack's, shown before the node's name; empty for the stack's own.
        hang_timeout_s: time without a heartbeat after which the node counts as hung; 0: never.
        places: ``file:line`` of each ``-p`` argument of the command.
    """

    name: str
    exec: str
    command: tuple[str, ...]
    env: Mapping[str, str] = field(default_factory=dict)
    respawn: bool = False
    respawn_delay_s: float = 1.0
    required: bool = False
    file: Path = Path()
    line: int = 0
    run_dir: Path | None = None
    group: str = ""
    hang_timeout_s: float = HANG_TIMEOUT_S
    places: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name shown to users: ``NODE``, or ``GROUP/NODE`` in a run directory of its own."""
        return f"{self.group}/{self.name}" if self.group else self.name


@dataclass(frozen=True)
class LaunchDescription:
    """All nodes that a launch file starts, with its arguments applied."""

    file: Path
    nodes: tuple[NodeSpec, ...]

    @property
    def simulated(self) -> bool:
        """True if the devices are simulated, so that the stack's time may run slower than the machine's."""
        return any(node.exec == "simulator" for node in self.nodes)

    def run_dirs(self, run_dir: Path) -> list[Path]:
        """Return all run directories of the stack, its own first."""
        others = {node.run_dir for node in self.nodes if node.run_dir is not None}
        return [run_dir, *sorted(others - {run_dir})]


def find_launch_file(name: str) -> Path:
    """Find a launch file by path, or by the name of a shipped one (``sim`` or ``sim.yaml``).

    Raises:
        FileNotFoundError: neither exists.
    """
    path = Path(name)
    if paths.is_file(path):
        return path.resolve()
    if path.name == name:
        return paths.shipped_file("launch", name if path.suffix else f"{name}.yaml")
    raise FileNotFoundError(f"{name} does not exist")
