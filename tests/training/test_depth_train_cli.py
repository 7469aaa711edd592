"""``ic depth train`` and ``ic depth render`` as a person calls them."""

import argparse
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from instant_ic.cli import depth_train
from instant_ic.cli.errors import UserError
from instant_ic.training.checkpoints import CheckpointError
from instant_ic.training.dataset import DatasetError, save_sample
from instant_ic.training.rooms import RoomsConfig


def ic(*words: str) -> int:
    parser = argparse.ArgumentParser(prog="ic")
    commands = parser.add_subparsers(required=True)
    depth_train.add_parser(commands)
    depth_train.add_render_parser(commands)
    fixed = ["--height", "64", *(["--encoder", "none"] if words[0] == "train" else [])]
    args = parser.parse_args([words[0], *fixed, *words[1:]])
    return int(args.func(args))


def record(checkpoint: Path) -> dict:
    return torch.load(checkpoint, weights_only=True)["record"]


def rendered_folder(root: Path) -> str:
    """Panoramas of worlds 12 to 20, of which 12 is held out; their priors are 10 % too far."""
    root.mkdir()
    for seed in range(12, 21):
        depth = np.full((64, 128), 1.0 + seed % 4, np.float32)
        channels = np.zeros((6, 64, 128), np.float32)
        channels[0], channels[1] = 1.1 * depth, 0.1
        rgb = np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=-1)
        save_sample(root / f"{seed}-0.npz", rgb, depth, [channels, channels])
    return str(root)


def test_rendered_panoramas_and_taken_up_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "runs" / "w.pt"
    words = ("train", "--data", rendered_folder(tmp_path / "p"), "--batch-size", "4", "--checkpoint", str(weights))
    assert ic(*words, "--epochs", "1") == 0
    assert record(weights)["steps"] == 4  # 8 worlds x 2 priors / 4
    assert record(weights)["history"][0]["mre"] == pytest.approx(0.1, abs=0.001)  # of the prior
    assert record(weights)["data"] == {"folder": "p", "worlds": 9, "panoramas": 16}
    said = capsys.readouterr().out
    assert "training on CPU" in said and json.loads(said.splitlines()[-1])["mre"] > 0
    assert ic(*words, "--epochs", "2", "--resume") == 0
    assert record(weights)["steps"] == 8 and len(record(weights)["history"]) == 3


def test_render_writes_what_train_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def render(recipe: RoomsConfig, folder: Path, worlds: range) -> Iterator[Path]:
        asked.append((recipe, worlds))
        yield folder / "24-1.npz"

    monkeypatch.setattr("instant_ic.training.rooms.render_rooms", render)
    words = ("render", "-o", str(tmp_path / "p"), "--worlds", "3", "--poses", "2", "--first", "24")
    assert ic(*words) == 0 and (tmp_path / "p").is_dir()
    ((recipe, worlds),) = asked
    assert worlds == range(24, 27) and (recipe.poses, recipe.height, recipe.textures) == (2, 64, "")
    with pytest.raises(UserError, match="for evaluation"):
        ic("render", "-o", str(tmp_path / "p"), "--first", "899999")
    with pytest.raises(DatasetError, match="no textures"):
        ic("render", "-o", str(tmp_path / "p"), "--textures", "/absent")


def test_ctrl_c_ends_as_the_schedule_would_and_a_second_at_once() -> None:
    trainer = SimpleNamespace(stop=False)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), depth_train.ends_early(trainer):
        signal.raise_signal(signal.SIGTERM)
        assert trainer.stop
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (("--height", "100"), UserError, "multiple of 32"),
        (("--encoder", "/absent.pth"), CheckpointError, "No such file"),
        (("--device", "tpu9"), UserError, "device 'tpu9'"),
        (("--data", "/absent"), DatasetError, "no rendered panoramas"),
        (("--checkpoint", "/tmp"), UserError, "is a folder"),
    ],
)
def test_mistakes_are_told(words: tuple[str, ...], error: type[Exception], message: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=message):
        given = () if "--data" in words else ("--data", rendered_folder(tmp_path / "p"))
        ic("train", "--checkpoint", str(tmp_path / "w.pt"), *given, *words)
