#!/usr/bin/env python3
"""Lines of code by package, and the nodes' parameters; prints JSON.

    python scripts/count_lines.py

All lines of tracked ``.py``, ``.js``, ``.html``, ``.css`` and ``.sh`` files count, except for the written
report in ``docs/``. ``runtime`` is what a running stack may load: everything in ``instant_ic/`` and ``nodes/`` but
``training`` and ``experiments``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = (".py", ".js", ".html", ".css", ".sh")
NOT_RUNTIME = ("instant_ic/training", "instant_ic/experiments")


def lines_by_package() -> dict[str, int]:
    """Count the lines of ``nodes``, of each folder in ``instant_ic`` and of the other folders at the top."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    counts: Counter[str] = Counter()
    for name in listed.splitlines():
        path = Path(name)
        if path.suffix in SUFFIXES and path.parts[0] != "docs":
            deep = path.parts[0] == "instant_ic" and len(path.parts) > 2
            package = "/".join(path.parts[: 2 if deep else 1])
            counts[package] += len((ROOT / path).read_text(encoding="utf-8").splitlines())
    return dict(sorted(counts.items()))


def parameters() -> dict[str, int]:
    """Count the parameters of each node; none where the project's packages are missing."""
    try:
        from instant_ic.bus.node_files import node_class
        from instant_ic.config.parameter_info import parameter_infos
        from instant_ic.util.paths import node_names
    except ImportError as error:
        print(f"no parameters ({error}): run it with .venv/bin/python", file=sys.stderr)
        return {}

    return {name: len(parameter_infos(node_class(name).config_class())) for name in node_names()}


def main() -> int:
    """Print the counts."""
    packages, by_node = lines_by_package(), parameters()
    tests = packages.pop("tests")
    runtime = {name for name in packages if name.startswith(("instant_ic", "nodes"))} - set(NOT_RUNTIME)
    result = {
        "packages": packages,
        "runtime": sum(packages[name] for name in runtime),
        "outside_tests": sum(packages.values()),
        "tests": tests,
        "parameters": by_node,
        "parameters_in_all": sum(by_node.values()),
    }
    print(json.dumps(result, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
