"""A scalar is read by the type that it is for, not by its spelling: files, words, launch files, messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.cli.errors import UserError
from instant_ic.cli.message_input import build as build_message
from instant_ic.cli.message_input import parse
from instant_ic.config import params
from instant_ic.config.params import ParameterError, Value, parse_override
from instant_ic.config.scalars import Scalar
from instant_ic.config.yaml_text import one_line, read_spelled
from instant_ic.launch import read_launch_file
from instant_ic.slam.map_files import load_grid


@dataclass(frozen=True)
class Mixed:
    text: str = ""
    number: float = 0.0
    count: int = 0
    flag: bool = False
    words: tuple[str, ...] = ()
    numbers: tuple[float, ...] = ()
    maybe: str | None = "x"
    mode: Literal["on", "off", "1:30"] = "on"
    path: Path = Path()
    anything: Any = None


def from_word(word: str) -> Mixed:
    key, value = parse_override(word)
    return params.build(Mixed, {key: value})


def from_file(tmp_path: Path, word: str) -> Mixed:
    key, _, text = word.partition(":=")
    file = tmp_path / "p.yaml"
    file.write_text(f"node:\n  ros__parameters:\n    {key}: {text}\n")
    return params.build(Mixed, params.load_file(file, "node"))


TEXTS = ["0123", "1:30", "5e-06", "1_000", "0x1F", "2001-13-45", "no", "~", ".nan", "1.0", "<<"]


@pytest.mark.parametrize("text", TEXTS)
def test_fault_a_text_in_a_list_changes_on_its_way_to_a_node(text: str) -> None:
    """``ic param set`` sends a list as one line, in which ``1:30`` must be quoted."""
    sent = one_line(read_spelled(f"[{text}, 5]"))
    assert params.build(Mixed, {"words": Value(read_spelled(sent), "ic param set")}).words == (text, "5")


@pytest.mark.parametrize("text", TEXTS)
def test_text_keeps_its_spelling(tmp_path: Path, text: str) -> None:
    for made in (from_word(f"text:={text}"), from_file(tmp_path, f"text:={text}")):
        assert made.text == text
    assert from_word(f"words:=[{text}, '{text}']").words == (text, text)
    assert from_word(f"path:={text}").path == Path(text)


@pytest.mark.parametrize(
    ("text", "number"),
    [
        *(("5e-06", 5e-6), ("+5e+3", 5000), ("-.5e1", -5), ("1_000", 1000), ("010.5", 10.5), ("0x10", 16)),
    ],
)
def test_a_number_takes_every_spelling(tmp_path: Path, text: str, number: float) -> None:
    for made in (from_word(f"number:={text}"), from_file(tmp_path, f"number:={text}")):
        assert made.number == number and isinstance(made.number, float)
    assert from_word(f"numbers:=[{text}, 1]").numbers == (number, 1.0)


@pytest.mark.parametrize(
    ("word", "text"),
    [
        ("number:=1:30", r"number must be float \(got 1:30\)"),
        ("number:=.inf", r"number must be a finite number \(got .inf\)"),
        ("number:='5'", r"number must be float \(got '5'\)"),
        ("number:=yes", r"number must be float \(got 'yes'\)"),
        ("count:=0123", r"count must be int, without a leading zero \(got 0123\)"),
        ("count:=1e3", r"count must be int \(got 1e3\)"),
        ("count:=0x1ffffffffffffffff", "count must have at most 64 bits"),
        ("flag:=1", r"flag must be bool \(got 1\)"),
        ("text:=", r"text must be str \(\"\" for empty text\)"),
        ("mode:=maybe", "mode must be one of on, off, 1:30"),
        ("anything:=2001-13-45", "anything: the value is not YAML: month must be in"),
    ],
)
def test_what_does_not_fit_its_type_is_refused(word: str, text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        from_word(word)


def test_the_other_types() -> None:
    assert [from_word(f"count:={word}").count for word in ("1_000", "0x1F", "0b11", "-3")] == [1000, 31, 3, -3]
    assert [from_word(f"flag:={word}").flag for word in ("yes", "On", "TRUE", "no", "off", "False")] == [True] * 3 + [
        False
    ] * 3
    assert [from_word(f"maybe:={word}").maybe for word in ("~", "null", "", "'~'")] == [None, None, None, "~"]
    assert [from_word(f"mode:={word}").mode for word in ("on", "off", "1:30", "'on'")] == ["on", "off", "1:30", "on"]
    assert from_word("anything:=[1, yes, ~]").anything == [1, True, None]


@given(st.from_regex(r"[-+.:_0-9a-zA-Z~=<]{1,20}", fullmatch=True).filter(lambda text: text not in ("-", "---", "...")))
def test_each_word_arrives_in_its_spelling(text: str) -> None:
    try:
        value = read_spelled(text)
    except yaml.YAMLError:  # no word, such as `a:`
        return
    if isinstance(value, Scalar):
        assert params.build(Mixed, {"text": Value(value, "here")}).text == text.strip()
        assert read_spelled(one_line([value])) in ([value], [value.text])
        assert parse_override(f"text:={one_line(value)}")[1].given in (value, value.text)


LAUNCH = """launch:
- arg: {name: name, default: "0123"}
- arg: {name: third, default: 2e-1}
- node:
    exec: vlp16_driver
    param:
    - {name: frame, value: 0017}
    - {name: sensor, value: $(var name)}
    - {name: silence_s, value: 5e-1}
    - {name: lidar_mount.xyz, value: [1e-1, $(var third), .5]}
"""


def test_launch_files_and_their_arguments_keep_the_spelling(tmp_path: Path) -> None:
    file = tmp_path / "stack.yaml"
    file.write_text(LAUNCH)
    for given_arguments, name in (({}, "0123"), ({"name": "1:30"}, "1:30"), ({"name": "no"}, "no")):
        words = read_launch_file(file, given_arguments).nodes[0].command
        values = dict(parse_override(word) for word in words if ":=" in word)
        assert params.typed_value(Mixed, "text", values["sensor"].given) == name
        assert params.typed_value(Mixed, "text", values["frame"].given) == "0017"
        assert params.typed_value(Mixed, "number", values["silence_s"].given) == 0.5
        assert params.typed_value(Mixed, "numbers", values["lidar_mount.xyz"].given) == (0.1, 0.2, 0.5)


def test_messages_and_maps_take_the_same_spellings(tmp_path: Path) -> None:
    assert build_message("String", parse("{data: 0123}", "String"), 0).data == "0123"
    assert build_message("Float64", parse("{data: 5e-06}", "Float64"), 0).data == 5e-6
    assert build_message("Float64", parse("{data: -.inf}", "Float64"), 0).data == -math.inf
    with pytest.raises(UserError, match="data must be float64"):
        build_message("Float64", parse("{data: '.inf'}", "Float64"), 0)
    assert build_message("UInt64", parse("{data: 18446744073709551615}", "UInt64"), 0).data == 2**64 - 1
    assert build_message("Header", parse("{stamp: now, frame_id: no}", "Header"), 7).frame_id == "no"
    (tmp_path / "0123").write_bytes(b"P5 1 1 255\n\0")
    (tmp_path / "m.yaml").write_text("image: 0123\nresolution: 5e-2\norigin: [-1e1, 2e-1, 0]\nnegate: 0\n")
    grid = load_grid(tmp_path / "m.yaml")
    assert grid.resolution == 0.05 and grid.origin.tolist() == [-10.0, 0.2] and grid.values.tolist() == [[100]]
