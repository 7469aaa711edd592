"""docs/safety.md names the test of each hazard: every test that it names is there."""

import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
PAGE = (TESTS.parent / "docs/safety.md").read_text(encoding="utf-8")


def named_tests() -> list[tuple[str, str]]:
    """File and function of each pytest node id on the page; an ellipsis stands for the file before."""
    found, file = [], ""
    for path, function in re.findall(r"`((?:[\w/]+\.py)|…)?(?:::(\w+)(?:\[[^`]*\])?)?`", PAGE):
        file = file if path in ("", "…") else path
        if path:
            found.append((file.removeprefix("tests/"), function))
    return [(file, function) for file, function in found if not file.startswith("benchmarks/")]


def test_every_test_on_the_safety_page_exists() -> None:
    named = named_tests()
    assert len(named) > 50 and len({file for file, _ in named}) > 20
    missing = [
        f"{file}::{function}"
        for file, function in named
        if not (TESTS / file).is_file() or (function and f"def {function}(" not in (TESTS / file).read_text())
    ]
    assert not missing


def test_every_hazard_names_a_test() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and line.count("|") > 3]
    hazards = [row for row in rows if ".py" in row or re.search(r"`(stand|virtual)\[", row)]
    tables = [row for row in rows if re.match(r"\| (Hazard|Lost|Quantity) ", row)]
    times = [row for row in rows if re.search(r" s, [\d.]+ s, [\d.]+ m", row)]
    assert len(hazards) + len(tables) + len(times) == len(rows)
