"""The shipped Foxglove layout: whole, and only of topics and fields that this stack has."""

import json
import re
from pathlib import Path

import pytest

from instant_ic.msg import message_type, typestore
from instant_ic.util import paths

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def layout():
    return json.loads(paths.shipped_file("config", "foxglove_layout.json").read_text())


@pytest.fixture(scope="module")
def types():
    """Topic → type of docs/reference.md, which the system test holds to what runs."""
    rows = re.findall(r"^\| `(/[\w/]+)` \| (\w+/\w+) \|", (ROOT / "docs/reference.md").read_text(), re.M)
    found = dict(rows)
    return found


def topics_in(value):
    """Every topic, or path into its messages, that a configuration names."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key == "topics":
                yield from inner
            elif key in ("imageTopic", "topicToRender", "topicPath", "value") and isinstance(inner, str):
                yield inner
            elif key != "publish":
                yield from topics_in(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from topics_in(inner)


def field_type(type_name, path):
    """Follows ``.twist.linear.x`` and ``[0]`` through a message's definition; KeyError where there is no such field."""
    kind = type_name
    for name in re.findall(r"\.(\w+)", re.sub(r"\[\d*:?\d*\]", "", path)):
        definition = dict(typestore().get_msgdef(message_type(kind).__msgtype__).fields)
        if name not in definition:
            raise KeyError(f"{kind} has no field {name}")
        node = definition[name]
        while not isinstance(node[1], str):  # an array: its element
            node = node[1][0]
        kind = node[1]
    return kind


def test_it_shows_only_topics_and_fields_that_there_are(layout, types):
    named = set(topics_in(layout["configById"]))
    assert len(named) > 20
    for text in named:
        topic, condition, path = re.fullmatch(r"(/[\w/]+)(?:\{(\w+)==.*?\})?((?:\.\w+|\[\d+\])*)", text).groups()
        assert topic in types, f"{text}: nobody publishes {topic}"
        field_type(types[topic], path)
        if condition:
            field_type(types[topic], f".{condition}")
