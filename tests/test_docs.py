"""The examples in the docs run as they are printed."""

import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from instant_ic.cli.main import build_parser, main
from instant_ic.launch import parameters

ROOT = Path(__file__).resolve().parents[1]
PARSER = build_parser()


def python_blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.S | re.M)


def test_the_nodes_of_the_pages_pass_the_tests_of_the_pages(tmp_path):
    for page, name in (("architecture.md", "clearance"), ("tutorial.md", "my_node")):
        node, test = python_blocks(page)[:2]
        (tmp_path / f"{name}.py").write_text(node)
        (tmp_path / f"test_{name}.py").write_text(test)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0 and "2 passed" in done.stdout, done.stdout + done.stderr


PAGES = ["README.md", *(f"docs/{file.name}" for file in sorted((ROOT / "docs").glob("*.md")))]


def commands(page: str) -> list[str]:
    """Every ``ic`` command of a page, in the order given, without its explanation."""
    text = re.sub(r"\\\n *", "", (ROOT / page).read_text(encoding="utf-8"))
    blocks = "".join(re.findall(r"^```(?:sh)?\n(.*?)^```", text, re.S | re.M))
    found = re.findall(r"^(?:\$ )?(ic [^#\n]+)", blocks, re.M)
    if page == "README.md":
        found += re.findall(r"^\|[^|]+\| `(ic [^`]+)` \|", text, re.M)
    return [re.split(r" {3,}|;| & | > |  (?=\S)", command.strip())[0] for command in found]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_of_a_page_is_understood(page, capsys):
    for command in commands(page):
        try:
            PARSER.parse_args(shlex.split(command)[1:])
        except SystemExit as end:
            assert end.code == 0, f"{page}: {command}: {capsys.readouterr().err}"


@pytest.mark.parametrize("page", ["README.md", "docs/bags.md"])
def test_commands_of_a_page_make_what_the_later_ones_read_and_nothing_twice(page):
    made = {"runs/recordings"}  # by the page's record button
    for command in commands(page):
        words = shlex.split(command)
        if words[1:3] == ["bag", "diff"]:
            assert set(words[3:5]) <= made, command
        read = words[2] if words[1] == "replay" else words[words.index("--compare") + 1] if "--compare" in words else ""
        assert not read or read in made or (ROOT / read).exists(), command
        new = [after for option, after in itertools.pairwise(words) if option in ("-o", "--out")]
        new += [word.partition(":=")[2] for word in words if word.startswith("record:=")]
        assert not made & set(new), command
        made |= set(new)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, "CHANGELOG.md", "CONTRIBUTING.md"])
def test_links_lead_to_a_file_and_a_heading(page):
    file = ROOT / page
    for target, anchor in re.findall(r"\]\((?!https?:|#)([^)#\s]+)(?:#([^)\s]+))?\)", file.read_text(encoding="utf-8")):
        linked = (file.parent / target).resolve()
        assert linked.exists(), f"{page}: {target} does not exist"
        assert not anchor or anchor in anchors(linked), f"{page}: {target} has no heading #{anchor}"


def test_explanation_stays_short():
    words = {page: len((ROOT / page).read_text(encoding="utf-8").split()) for page in PAGES}
    assert words["README.md"] <= 900
    assert sum(words.values()) - words["docs/reference.md"] - words["docs/benchmarks.md"] <= 25_000, words


@pytest.mark.parametrize("page", [page for page in PAGES if any(c.startswith("ic launch") for c in commands(page))])
def test_launch_commands_of_a_page_pass_the_check_in_the_order_given(page, tmp_path, monkeypatch, capsys):
    """All of ``ic launch`` except the start: file, arguments and every node's parameters."""
    monkeypatch.setattr(parameters, "check_parameters_apart", parameters.check_parameters)  # in this process
    monkeypatch.chdir(tmp_path)
    mount = {"theta_camera": {"ros__parameters": {"camera_mount": {"xyz": [0.0, 0.0, 1.2]}}}}
    (tmp_path / "mount.yaml").write_text(json.dumps(mount))  # by the page's `ic calibrate`
    (tmp_path / "tls.yaml").write_text("{}")
    for folder in ("drive", "tests/data/corridor_drive"):
        shutil.copytree(ROOT / "tests/data/corridor_drive", tmp_path / folder)
    for command in dict.fromkeys(commands(page)):
        words = shlex.split(command)[1:]
        if words[0] == "launch" and "FILE" not in words:
            for made in (word.removeprefix("record:=") for word in words if word.startswith("record:=")):
                shutil.rmtree(tmp_path / made, ignore_errors=True)  # other commands of the page read one that exists
            words += [] if "--show-args" in words else ["--check"]
            assert main(words) == 0, f"{page}: {command}: {capsys.readouterr().err}"


QUICK = ("info", "diff", "recover")
"""Verbs of ``ic bag`` that need no stack."""


def test_the_bag_commands_of_the_page_that_need_no_stack_run_in_the_order_given(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in ("drive", "again", "broken"):  # of `ic bag record`, of `ic replay`, and of a machine that failed
        shutil.copytree(ROOT / "tests/data/corridor_drive", tmp_path / folder)
    (tmp_path / "broken" / "metadata.yaml").unlink()
    (tmp_path / "old").symlink_to(tmp_path / "drive")
    ran = []
    for command in commands("docs/bags.md"):
        words = shlex.split(command)[1:]
        if words[0] == "bag" and words[1] in QUICK:
            assert main(words) == 0, f"{command}: {capsys.readouterr().err}"
            ran.append(words[1])
    assert set(ran) == set(QUICK)
