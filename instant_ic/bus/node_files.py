"""Loading of the node class in a node file: a shipped ``nodes/NAME.py`` or a user's own file."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

from instant_ic.bus.node import Node
from instant_ic.util import paths


class NodeFileError(ValueError):
    """The file is missing or does not define exactly one node."""


def node_class(name: str) -> type[Node[Any]]:
    """Return the class of a shipped node.

    Raises:
        NodeFileError: there is no such node.
    """
    if name not in (names := paths.node_names()):
        raise NodeFileError(f"there is no node {name!r}; the nodes are {', '.join(names)}")
    return load(paths.node_file(name), f"nodes.{name}")


def load(file: Path, module_name: str = "") -> type[Node[Any]]:
    """Return the node class that a file defines. The file is executed once per process.

    Args:
        file: Python source with one subclass of `Node`.
        module_name: key in ``sys.modules``; empty uses the file's stem.

    Raises:
        NodeFileError: the file is missing, or does not define exactly one node.
    """
    name = module_name or file.stem
    module = sys.modules.get(name)
    if module is None:
        spec = importlib.util.spec_from_file_location(name, file)
        if spec is None or spec.loader is None or not file.is_file():
            raise NodeFileError(f"{file} {'is not a Python file' if file.is_file() else 'does not exist'}")
        module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up there
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Node) and value.__module__ == name
    ]
    if len(found) != 1:
        there = ", ".join(cls.__name__ for cls in found) or "none"
        raise NodeFileError(f"{file} must define one node class (it has: {there})")
    return found[0]
