"""The examples in the docs run as they are printed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def python_blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.S | re.M)


@pytest.mark.parametrize(("page", "name"), [("architecture.md", "clearance"), ("tutorial.md", "my_node")])
def test_the_node_of_the_page_passes_the_test_of_the_page(page, name, tmp_path):
    node, test = python_blocks(page)[:2]
    (tmp_path / f"{name}.py").write_text(node)
    (tmp_path / f"test_{name}.py").write_text(test)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
