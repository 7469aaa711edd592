"""Imports run one way (docs/architecture.md)."""

import ast
import functools
import graphlib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "instant_ic"
ALGORITHMS = ("camera", "lidar", "base", "slam", "mapping", "depth", "vspace", "control")
"""Usable from a notebook: no bus, no files of the stack."""
TOOLS = ("cli", "training", "experiments")
"""May import what is not part of the running stack."""


@functools.cache
def imports(path: Path) -> set[str]:
    """Absolute names of the package's own modules that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith(("instant_ic.", "nodes."))}


def forbidden(folder: str) -> set[str]:
    """Packages that a folder of the package, or ``nodes``, must not import."""
    found = {"bus", "msg", "launch", "bag", "cli"} if folder in ALGORITHMS else set()
    found |= {"depth"} if folder == "mapping" else set()  # the local model knows no depth network
    found |= set() if folder in TOOLS else {"training", "experiments"}
    return found | (set() if folder in ("sim", "nodes", *TOOLS) else {"sim"})


def test_imports_run_one_way_and_nobody_imports_a_node():
    folders = {path.name: path for path in (*PACKAGE.iterdir(), ROOT / "nodes") if path.is_dir()}
    assert set(ALGORITHMS) < set(folders)
    wrong = {}
    for folder, path in folders.items():
        names = tuple(f"instant_ic.{name}." for name in forbidden(folder)) + ("nodes.",)
        for file in path.rglob("*.py"):
            if bad := {name for name in imports(file) if name.startswith(names)}:
                wrong[str(file.relative_to(ROOT))] = bad
    assert not wrong


def test_geometry_msg_config_and_bus_import_only_downwards():
    allowed = {
        "util": {"util"},
        "geometry": {"geometry", "util"},
        "msg": {"msg", "geometry", "util"},
        "config": {"config", "geometry", "util"},
        "bus": {"bus", "config", "geometry", "msg", "util"},
    }
    for folder, targets in allowed.items():
        for file in (PACKAGE / folder).rglob("*.py"):
            upward = {i for i in imports(file) if i.split(".")[1] not in targets}
            assert not upward, file


def test_modules_import_each_other_in_no_circle():
    modules = {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in PACKAGE.rglob("*.py")}
    graph = {name: set() for name in modules}
    for name, file in modules.items():
        for target in imports(file):
            module = target if target in modules else target.rpartition(".")[0]
            if module in modules and module != name:
                graph[name].add(module)
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle
