"""A small share of ``make fuzz``, the same inputs each time: no other error, no hang, no growth."""

import pytest

from tests.fuzz.harness import run
from tests.fuzz.targets import TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_parser_takes_mutated_input(name: str) -> None:
    target = TARGETS[name]
    findings = run(target, target.make(), seed=0, start=0, count=target.share)
    assert not findings, "\n\n".join(
        f"input {f.index}: {f.what} ({f.where}); python -m tests.fuzz --target {name} --start {f.index} --count 1\n"
        f"{f.trace}"
        for f in findings
    )
