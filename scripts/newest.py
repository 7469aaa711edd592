#!/usr/bin/env python3
"""An environment with the newest version of everything, without pins, for the unit tests of `make newest`.

    python3.13 scripts/newest.py FOLDER

Torch is installed where it has a CPU build for that Python; its CUDA build of several gigabytes never is. Prints the
options that pytest needs.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def requirements() -> list[str]:
    """Return what the project and its tests need, without torch and triton."""
    extras = PROJECT["project"]["optional-dependencies"]
    asked = [
        *PROJECT["project"]["dependencies"],
        *extras["dev"],
        *PROJECT["build-system"]["requires"],
    ]
    (torch,) = PROJECT["tool"]["uv"]["dependency-metadata"]
    return [one for one in asked if not re.match(r"torch\b", one)] + torch["requires-dist"]


def run(what: str, command: list[str | Path]) -> None:
    """Run a command.

    Raises:
        SystemExit: it failed; says what.
    """
    if subprocess.run(command, stdout=sys.stderr).returncode:
        sys.exit(f"make newest: {what} FAILED")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the environment, made again each time")
    args = parser.parse_args()
    run("making the environment", [sys.executable, "-m", "venv", "--clear", args.folder])
    inside = str(args.folder / "bin" / "python")
    pip = [inside, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--progress-bar", "off"]
    no_torch = args.folder / "no-torch.txt"
    no_torch.write_text("torch<0\n", encoding="utf-8")  # a package that asks for torch fails instead of fetching CUDA's
    run("installing packages", [*pip, "--only-binary", ":all:", "-c", no_torch, "--upgrade", "pip", *requirements()])
    install = [str(ROOT / "scripts" / "install_torch.sh"), inside]
    torch = any(subprocess.run([*install, *spec], stdout=sys.stderr).returncode == 0 for spec in (["torch"], []))
    if torch:
        run("installing triton", [*pip, "--only-binary", ":all:", "triton"])
    else:
        print("What needs torch is skipped.", file=sys.stderr)
    run("installing the project", [*pip, "--no-deps", "--no-build-isolation", "-e", str(ROOT)])
    # The pins are for the other environment.
    print("--ignore=tests/test_lock.py" + ("" if torch else " --without-torch"))


if __name__ == "__main__":
    main()
