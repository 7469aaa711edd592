"""Chromium for the benchmarks of the operator's page."""

from __future__ import annotations

import shutil
from typing import Any

FLAGS = [
    "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
]  # fmt: skip


def launch_chromium(playwright: Any) -> Any:
    """Launch the machine's Chromium, which renders WebGL on the CPU."""
    return playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
