"""For all tests: no time limit for one example of a property, and ``--without-torch`` for a Python that has none."""

import sys
import traceback
from importlib.abc import MetaPathFinder
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("stack", deadline=None)
settings.load_profile("stack")


class _NoTorch(MetaPathFinder):
    """Skips the module or test that imports torch."""

    def find_spec(self, name: str, *_: object) -> None:
        if name == "torch":
            files = (Path(frame.filename).name for frame in reversed(traceback.extract_stack()))
            test = next((file for file in files if file.startswith("test_")), "this test")
            pytest.skip(f"{test} needs torch, which has no CPU build for this Python", allow_module_level=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--without-torch", action="store_true", help="skip what imports torch, instead of failing")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--without-torch"):
        sys.meta_path.insert(0, _NoTorch())
