"""Imports run one way (docs/architecture.md)."""

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "instant_ic"
ALGORITHMS = ("camera", "lidar", "base", "slam", "mapping", "depth", "vspace", "control")
"""Usable from a notebook: no bus, no files of the stack."""
NOT_RUNTIME = ("training", "experiments")
TOOLS = ("cli", "training", "experiments")
"""May import what is not part of the running stack."""


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


def wrong(folder: Path, *forbidden: str) -> dict[str, set[str]]:
    """Imports of the forbidden packages by file."""
    files = list(folder.rglob("*.py"))
    assert files, f"{folder} is empty"
    names = tuple(f"instant_ic.{name}." for name in forbidden) + ("nodes.",)
    bad = {str(file.relative_to(ROOT)): {i for i in imports(file) if i.startswith(names)} for file in files}
    return {file: found for file, found in bad.items() if found}


@pytest.mark.parametrize("folder", ALGORITHMS)
def test_algorithms_and_devices_know_no_bus(folder):
    assert not wrong(PACKAGE / folder, "bus", "msg", "launch", "bag", "cli")


def test_the_local_model_knows_no_depth_network():
    assert not wrong(PACKAGE / "mapping", "depth")


def test_nobody_imports_a_node():
    assert not wrong(PACKAGE)
    assert not wrong(ROOT / "nodes")


@pytest.mark.parametrize("folder", sorted(p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name not in TOOLS))
def test_the_runtime_imports_no_training_and_no_experiments(folder):
    if list((PACKAGE / folder).rglob("*.py")):
        assert not wrong(PACKAGE / folder, *NOT_RUNTIME)


def test_nodes_import_no_training_and_no_experiments():
    assert not wrong(ROOT / "nodes", *NOT_RUNTIME)


@pytest.mark.parametrize("folder", sorted(p.name for p in PACKAGE.iterdir() if p.is_dir()))
def test_only_training_and_experiments_import_the_simulator(folder):
    if folder not in ("sim", *TOOLS) and list((PACKAGE / folder).rglob("*.py")):
        assert not wrong(PACKAGE / folder, "sim")


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
