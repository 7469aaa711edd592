"""The page's modules under Node's own test runner: what needs no browser."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

TESTS = Path(__file__).with_name("js")
NODE = shutil.which("node")


def test_the_modules_of_the_page():
    """Runs tests/console/js; each failure is in the message."""
    version = subprocess.run([NODE, "--version"], capture_output=True, text=True).stdout if NODE else ""
    if not NODE or [int(part) for part in re.findall(r"\d+", version)[:2]] < [20, 19]:  # detects modules by itself
        pytest.skip("Node.js 20.19 or newer is missing: the page's modules are tested in the browser only")
    files = sorted(str(file) for file in TESTS.glob("*.test.js"))
    run = subprocess.run(
        [NODE, "--test", "--test-reporter=tap", *files],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "NO_COLOR": "1"},
    )
    failed = re.findall(r"^ *not ok .*(?:\n +(?!\d|ok).*)*", run.stdout, re.MULTILINE)
    assert run.returncode == 0, "\n".join(failed) or run.stdout + run.stderr
    assert int(re.search(r"^# pass (\d+)", run.stdout, re.MULTILINE)[1]) >= len(files)
