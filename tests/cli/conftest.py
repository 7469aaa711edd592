"""What the tests of the verbs share: ``ic`` in this process, and a node to look at."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cli_helpers import talking

from instant_ic.cli.main import main


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run directory of a talker."""
    run_dir = tmp_path_factory.mktemp("r")
    with talking(run_dir, "-p", "inner.depth:=7"):
        yield run_dir


@pytest.fixture
def ic(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command in this process: status, output, error output."""

    def run(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main(words)
        except SystemExit as end:
            status = int(end.code or 0)
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run
