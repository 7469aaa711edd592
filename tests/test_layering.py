"""Imports run one way (docs/architecture.md)."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "instant_ic"
LIBRARIES = ("camera", "lidar", "base", "slam", "depth", "nerf", "control")


def imports(path: Path) -> set[str]:
    """Absolute names of the package's own modules that a file imports."""
    module = list(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = module[: -node.level] if node.level else []
            target = ".".join([*base, *([node.module] if node.module else [])])
            found |= {target} | {f"{target}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("instant_ic")}


@pytest.mark.parametrize("folder", LIBRARIES)
def test_algorithms_and_devices_know_no_bus(folder):
    files = list((PACKAGE / folder).rglob("*.py"))
    assert files, f"{folder}/ is empty"
    forbidden = tuple(f"instant_ic.{name}" for name in ("bus", "msg", "nodes", "launch", "bag", "cli"))
    wrong = {str(f): i for f in files for i in imports(f) if i.startswith(forbidden)}
    assert not wrong


def test_nobody_imports_a_node():
    files = [f for f in PACKAGE.rglob("*.py") if f.parent.name != "nodes"]
    wrong = {str(f): i for f in files for i in imports(f) if i.startswith("instant_ic.nodes")}
    assert not wrong


def test_geometry_msg_and_bus_import_only_downwards():
    allowed = {
        "geometry": {"geometry", "limits"},
        "msg": {"msg", "geometry"},
        "bus": {"bus", "msg", "geometry", "pace", "paths", "private", "ranges"},
    }
    for folder, targets in allowed.items():
        for file in (PACKAGE / folder).rglob("*.py"):
            wrong = {i for i in imports(file) if len(i.split(".")) > 1 and i.split(".")[1] not in targets}
            assert not wrong, file
