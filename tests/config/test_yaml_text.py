"""YAML of a few hundred bytes may stand for more than a machine holds, by aliases or by its depth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from instant_ic.bag import BagError, BagReader, BagWriter
from instant_ic.bag.metadata import profiles_of
from instant_ic.config.params import ParameterError, load_sections
from instant_ic.config.yaml_text import compose_yaml, read_yaml
from instant_ic.depth.manifest import ManifestError, load_manifest
from instant_ic.slam.map_files import MapError, load_grid

# 9 ** 9 values: each list holds the one before nine times.
BOMB = "[&a [x,x,x,x,x,x,x,x,x]" + "".join(
    f", &{chr(98 + n)} [{','.join(9 * ['*' + chr(97 + n)])}]" for n in range(8)
) + "]"  # fmt: skip
MANY = "stand for more than 100000 values"
pytestmark = pytest.mark.timeout(300)


def test_a_million_values_by_aliases_are_refused() -> None:
    with pytest.raises(yaml.MarkedYAMLError, match=MANY) as caught:
        compose_yaml("a: 1\nb: " + BOMB)
    assert caught.value.problem_mark is not None and caught.value.problem_mark.line == 1


def test_aliases_are_counted_where_they_are_used() -> None:
    # 1 + (1 + 300) + 301 + ...: 331 lists of 300 values are 99 632 values in all, 333 are more than 100 000.
    text = "[&a [" + ",".join(300 * "x") + "]" + "{}]"
    assert len(read_yaml(text.format(330 * ", *a"))) == 331
    with pytest.raises(yaml.YAMLError, match=MANY):
        read_yaml(text.format(332 * ", *a"))


@pytest.mark.parametrize("text", ["&a [*a]", "&a {b: [*a]}", "{&a x: &b {y: *b}}"])
def test_an_anchor_that_contains_itself_is_refused(text: str) -> None:
    with pytest.raises(yaml.YAMLError, match="contains itself"):
        read_yaml(text)


@pytest.mark.parametrize("text", ["\ud800", "a: \ud800"])  # as Python reads the argument $'\xff' of a command
def test_text_that_is_no_unicode_is_refused(text: str) -> None:
    with pytest.raises(yaml.YAMLError, match="surrogates"):
        read_yaml(text)


@pytest.mark.parametrize("levels", [101, 5000])
def test_depth_is_limited(levels: int) -> None:
    assert read_yaml("[" * 100 + "]" * 100) == read_yaml("- " * 99 + "[]")
    with pytest.raises(yaml.YAMLError, match=r"too deeply|nesting depth"):
        read_yaml("[" * (levels + 1) + "]" * (levels + 1))


@pytest.mark.parametrize(
    ("name", "text", "read", "error"),
    [
        ("p.yaml", f"node:\n  ros__parameters:\n    rate: {BOMB}\n", load_sections, ParameterError),
        ("map.yaml", f"image: map.pgm\nresolution: 0.05\norigin: {BOMB}\n", load_grid, MapError),
        ("m.yaml", f"name: {BOMB}\n", load_manifest, ManifestError),
    ],
)
def test_every_reader_refuses(
    tmp_path: Path, name: str, text: str, read: Callable[[Path], object], error: type[Exception]
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(error, match=MANY):
        read(tmp_path / name)


def test_depth_counts_through_aliases() -> None:
    text = f"[&a {'[' * 60}{']' * 60}, &b {'[' * 30}*a{']' * 30}, {'[' * 30}*b{']' * 30}]"
    with pytest.raises(yaml.YAMLError, match="too deeply"):
        read_yaml(text)


def test_metadata_of_a_bag(tmp_path: Path, key: str = "custom_data") -> None:
    with BagWriter(tmp_path / "bag"):
        pass
    path = tmp_path / "bag" / "metadata.yaml"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(f"  {key}: {BOMB}" if line.startswith(f"  {key}:") else line for line in lines))
    with pytest.raises(BagError, match=MANY):
        BagReader(tmp_path / "bag")


def test_profiles_of_a_topic() -> None:
    from rosbags.rosbag2 import ReaderError

    with pytest.raises(ReaderError, match=MANY):
        profiles_of(BOMB)
    with pytest.raises(ReaderError, match="not a list"):
        profiles_of("a: 1")
    assert profiles_of("") == profiles_of("[]") == []
