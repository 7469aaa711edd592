"""docs/reference.md names every node, topic and parameter as the code has them."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

from instant_ic.bus.node_files import node_class
from instant_ic.util.paths import node_names

ROOT = Path(__file__).resolve().parents[1]


def test_reference_is_current():
    result = subprocess.run(
        [sys.executable, str(ROOT / "scripts/make_reference.py"), "--check"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr


NEEDED = {
    "bag_player": {"bag": "recording"},
    "host_bridge": {"listen": "tcp://0.0.0.0:7450", "to_robot": ("/operator/estop",)},
}
"""Parameters without a usable default, which a configuration cannot be constructed without."""


def documented_defaults():
    """Node → key → default, as docs/reference.md writes them."""
    found = {}
    for line in (ROOT / "docs/reference.md").read_text().splitlines():
        if line.startswith("## "):
            found[line[3:]] = section = {}
        cells = re.split(r"(?<!\\)\|", line)
        if line.startswith("| `"):
            section[cells[1].strip(" `")] = cells[3].strip().removeprefix("`").removesuffix("`").replace("\\|", "|")
    return found


def constructed_defaults(config, prefix=""):
    """Key → value of a configuration, read from its attributes alone."""
    found = {}
    for name in [field.name for field in dataclasses.fields(config)]:
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            found |= constructed_defaults(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = list(value) if isinstance(value, tuple) else value
    return found


@pytest.mark.parametrize("module", node_names())
def test_documented_defaults_are_those_of_a_constructed_configuration(module):
    node = node_class(module)
    given = NEEDED.get(module, {})
    actual = {
        key: repr(str(value) if isinstance(value, Path) else value)
        for key, value in constructed_defaults(node.config_class()(**given)).items()
    }
    documented = documented_defaults()[node.name]
    for key in given:
        assert documented.pop(key) in ("''", "[]")
        actual.pop(key)
    assert documented == actual


def test_messages_of_every_topic_are_documented():
    page = (ROOT / "docs/reference.md").read_text()
    documented = {name.rsplit("/", 1)[1] for name in re.findall(r"^### (\S+/msg/\S+)$", page, re.MULTILINE)}
    lines = re.findall(r"^(?:Takes|Gives): (.*)$", page, re.MULTILINE)
    used = {kind for line in lines for kind in re.findall(r"`/\S+` ([A-Z]\w+)", line)}
    assert len(used) > 15
    assert used <= documented
