"""What is kept on disk is what would be made again, to the last bit; a bad folder or file costs time only."""

import os
from pathlib import Path

import numpy as np
import pytest

from instant_ic.sim import kept as kept_module
from instant_ic.sim import lighting, textures
from instant_ic.sim.kept import Arrays, kept
from instant_ic.sim.worlds import make_world


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "instant_ic" / "sim"


class Maker:
    """Counts how often something had to be made."""

    def __init__(self, size: int = 4) -> None:
        self.made = 0
        self.size = size

    def __call__(self) -> Arrays:
        self.made += 1
        return {"a": np.arange(self.size, dtype=np.float32), "b": np.array([[1, 2]], np.uint8)}


def test_made_once_and_the_same_from_disk(folder: Path) -> None:
    make = Maker()
    first = kept("thing", ["name", np.eye(2)], make)
    second = kept("thing", ["name", np.eye(2)], make)
    assert make.made == 1 and set(first) == set(second) == {"a", "b"}
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
        assert first[name].dtype == second[name].dtype


def test_another_input_or_other_code_makes_it_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Maker()
    kept("thing", ["name", np.eye(2)], make)
    kept("thing", ["name", np.eye(2, dtype=np.float32)], make)
    assert make.made == 2
    monkeypatch.setattr(kept_module, "_code", lambda: b"another")
    kept("thing", ["name", np.eye(2)], make)
    assert make.made == 3


def test_the_least_recently_used_makes_room(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_module, "MOST_BYTES", 10_000)
    make = Maker(size=1000)  # 4 kB each: two have room
    for name in ("old", "new", "newest"):
        kept("thing", [name], make)
        for number, file in enumerate(sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)):
            os.utime(file, (number, number))
    kept("thing", ["newest"], make)
    assert make.made == 3 and len(list(folder.iterdir())) == 2
    kept("thing", ["old"], make)
    assert make.made == 4


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken"])
def test_a_broken_file_is_made_anew(folder: Path, content: bytes) -> None:
    make = Maker()
    kept("thing", ["name"], make)
    [file] = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(content or whole[: len(whole) // 2])
    np.testing.assert_array_equal(kept("thing", ["name"], make)["a"], [0, 1, 2, 3])
    assert make.made == 2 and file.read_bytes() == whole


def test_a_folder_that_cannot_be_used_costs_time_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/none")
    make = Maker()
    assert kept("thing", ["name"], make)["b"].tolist() == [[1, 2]] and make.made == 1


def test_a_world_from_disk_is_the_world_that_was_made(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    textures._packed_named.cache_clear()
    made = make_world("random:1")
    textures._packed_named.cache_clear()

    def nothing_is_made(*_: object) -> None:
        raise AssertionError("made again")

    monkeypatch.setattr(textures, "make_texture", nothing_is_made)
    monkeypatch.setattr(lighting, "_baked", nothing_is_made)
    found = make_world("random:1")
    np.testing.assert_array_equal(made.light, found.light)
    np.testing.assert_array_equal(made.textures.texels, found.textures.texels)
    np.testing.assert_array_equal(made.textures.mean, found.textures.mean)
    np.testing.assert_array_equal(made.textures.level_size, found.textures.level_size)
