"""Parameters: typed, checked, and every mistake with its place."""

from dataclasses import dataclass, field
from typing import Literal

import pytest

from instant_ic.config import params


@dataclass(frozen=True)
class Matcher:
    window_m: float = 0.3

    def __post_init__(self):
        if self.window_m <= 0:
            raise ValueError(f"window_m must be > 0 (got {self.window_m})")


@dataclass(frozen=True)
class Config:
    rate: float = 10.0
    beams: int = 720
    frame: str = "velodyne"
    source: Literal["udp", "pcap"] = "udp"
    mount: tuple[float, float, float] = (0.0, 0.0, 0.6)
    names: list[str] = field(default_factory=list)
    enabled: bool = True
    limit: float | None = None
    matcher: Matcher = field(default_factory=Matcher)


def load(tmp_path, text, *overrides, node="driver"):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    values = params.load_file(path, node)
    values.update(params.parse_override(o) for o in overrides)
    return params.build(Config, values)


def test_files_sections_and_overrides(tmp_path):
    text = """
/**:
  ros__parameters: {rate: 5, frame: laser}
driver:
  ros__parameters:
    frame: top
    mount: [1, 2, 3.5]
    matcher:
      window_m: 1
    limit: null
other:
  ros__parameters: {nonsense: 1}
"""
    config = load(tmp_path, text, "beams:=360", "matcher.window_m:=0.5", "names:=[a, b]")
    assert config == Config(
        rate=5.0, frame="top", mount=(1.0, 2.0, 3.5), beams=360, names=["a", "b"], matcher=Matcher(0.5)
    )
    assert isinstance(config.rate, float) and isinstance(config.mount, tuple)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("    raet: 5", r"p\.yaml:3: unknown parameter 'raet'; did you mean 'rate'\?"),
        ("    rate: fast", r"p\.yaml:3: rate must be float \(got 'fast'\)"),
        ("    beams: 1.5", r"p\.yaml:3: beams must be int \(got 1\.5\)"),
        ("    enabled: 1", r"p\.yaml:3: enabled must be bool"),
        ("    source: tcp", r"p\.yaml:3: source must be one of udp, pcap"),
        ("    mount: [1, 2]", r"p\.yaml:3: mount must have 3 values \(got 2\)"),
        ("    mount: [1, 2, x]", r"p\.yaml:3: mount\[2\] must be float"),
        ("    beams: 3\n    matcher:\n      window_m: -0.1", r"p\.yaml:5: window_m must be > 0 \(got -0\.1\)"),
        ("    matcher: 3", r"p\.yaml:3: parameter 'matcher' is a group"),
        ("    rate.x: 3", r"p\.yaml:3: parameter 'rate' has no part 'x'"),
        ("    rate: 1\n    rate: 2", r"p\.yaml:4: 'rate' is given twice"),
        ("    rate: [1", r"p\.yaml:\d+: not YAML"),
        ("    rate: !!timestamp x", r"p\.yaml:3: not YAML"),
        ("    rate: 2001-13-45", r"p\.yaml:3: rate must be float \(got 2001-13-45\)"),
        ("    ? [1]\n    : 2", r"p\.yaml:3: expected a single value, got a list"),
        ("    - 3", r"p\.yaml:3: expected keys and values, got a list"),
    ],
)
def test_mistakes_say_where(tmp_path, body, message):
    with pytest.raises(params.ParameterError, match=message):
        load(tmp_path, f"driver:\n  ros__parameters:\n{body}\n")


def test_other_mistakes(tmp_path):
    with pytest.raises(params.ParameterError, match=r"p\.yaml:2: expected ros__parameters under 'driver'"):
        load(tmp_path, "driver:\n  rate: 3\n")
    with pytest.raises(params.ParameterError, match="expected key:=value"):
        load(tmp_path, "", "rate=3")
    with pytest.raises(params.ParameterError, match="-p rate:=x: rate must be float"):
        load(tmp_path, "", "rate:=x")
    with pytest.raises(params.ParameterError, match="cannot be read"):
        params.load_file(tmp_path / "none.yaml", "driver")


def test_change_keeps_the_rest():
    config = Config(rate=5.0, matcher=Matcher(0.7))
    changed, different = params.change(config, {"matcher": {"window_m": 0.4}, "beams": 720}, lambda key: True, "set")
    assert changed == Config(rate=5.0, matcher=Matcher(0.4)) and different == {"matcher.window_m": 0.4}
    with pytest.raises(params.ParameterError, match="set: beams, rate takes effect at start"):
        params.change(config, {"rate": 6.0, "beams": 3}, lambda key: key == "frame", "set")
    assert params.change(config, {"rate": 5.0}, lambda key: False, "set") == (config, {})


@dataclass(frozen=True)
class Span:
    low: float = 0.0
    high: float = 10.0
    step: float = 1.0

    def __post_init__(self):
        if self.low >= self.high:
            raise ValueError("the span is empty")
        if self.step > 5:
            raise ValueError("it is too coarse")


def test_all_mistakes_at_once_each_at_the_value_without_which_it_disappears():
    @dataclass(frozen=True)
    class Spans:
        first: Span = field(default_factory=Span)
        rate: float = 1.0

    given = {"rate": "fast", "first.step": 9.0, "first.low": 20.0, "secnd": 1, "first.high": float("nan")}
    values = {key: params.Value(value, f"f:{line}") for line, (key, value) in enumerate(given.items(), 1)}
    with pytest.raises(params.ParameterError) as caught:
        params.build(Spans, values)
    assert [(problem.where, problem.key, problem.text) for problem in caught.value.problems] == [
        ("f:1", "rate", "rate must be float (got 'fast')"),
        ("f:4", "secnd", "unknown parameter 'secnd'; known: first, rate"),
        ("f:5", "first.high", "first.high must be a finite number (got nan)"),
        ("f:3", "first.low", "the span is empty"),
        ("f:2", "first.step", "it is too coarse"),
    ]
