"""``ic depth train`` as a person calls it."""

import argparse
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from instant_ic.cli import depth_train
from instant_ic.cli.errors import UserError
from instant_ic.training import feeds
from instant_ic.training.dataset import DatasetError, Sample
from instant_ic.training.rooms import FIRST_HELD_OUT, RoomsConfig
from instant_ic.training.slicenet import CheckpointError

SEEDS: list[int] = []


def ic(*words: str) -> int:
    parser = argparse.ArgumentParser(prog="ic")
    depth_train.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["train", "--height", "64", "--encoder", "none", *words])
    return int(args.func(args))


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worlds that are rendered at once."""

    def render(recipe: RoomsConfig, worlds: list[int]) -> Iterator[Sample]:
        for seed in worlds:
            SEEDS.append(seed)
            depth = np.full((recipe.height, 2 * recipe.height), 1.0 + seed % 4, np.float32)
            for _ in range(recipe.poses):
                yield Sample(np.repeat((depth * 50).astype(np.uint8)[..., None], 3, axis=-1), depth, seed)

    SEEDS.clear()
    monkeypatch.setattr(feeds, "render_rooms", render)


def plain_folder(root: Path) -> str:
    for index in range(6):
        for name in ("rgb", "depth"):
            (root / name).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / "rgb" / f"{index}.jpg"), np.full((64, 128, 3), 40 * index, np.uint8))
        np.save(root / "depth" / f"{index}.npy", np.full((64, 128), 1.0 + index, np.float32))
    return f"plain:{root}"


def record(checkpoint: Path) -> dict:
    return torch.load(checkpoint, weights_only=True)["record"]


def test_rendered_on_the_way_and_taken_up_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = tmp_path / "runs" / "w.pt"
    words = ("--worlds", "8", "--poses", "2", "--pool", "4", "--reuse", "2", "--batch-size", "4", "--workers", "0",
             "--held-out", "4", "--checkpoint", str(weights))  # fmt: skip
    assert ic(*words, "--epochs", "1") == 0
    assert record(weights)["steps"] == 8  # 8 worlds x 2 panoramas x 2 uses / 4
    assert record(weights)["data"]["first_world"] == 100_000
    assert set(SEEDS) <= {*range(100_000, 100_008), FIRST_HELD_OUT - 2, FIRST_HELD_OUT - 1}
    said = capsys.readouterr().out
    assert "training on 1 x CPU" in said and json.loads(said.splitlines()[-1])["mre"] > 0
    assert weights.with_suffix(".csv").read_text().splitlines()[-1].startswith("8,")
    assert ic(*words, "--epochs", "2", "--resume") == 0
    assert record(weights)["steps"] == 16 and len(record(weights)["history"]) == 2


def test_own_folder_and_worlds_mixed_and_started_from_weights(tmp_path: Path) -> None:
    data = plain_folder(tmp_path / "mine")
    first, second = tmp_path / "a.pt", tmp_path / "b.pt"
    words = ("--data", data, "--batch-size", "3", "--epochs", "1", "--workers", "0")
    assert ic(*words, "--checkpoint", str(first)) == 0
    made = record(first)
    assert made["data"] == {"kind": "plain", "folder": "mine", "count": 6, "scenes": 6, "panoramas": 5}
    assert made["held_out"] == 1 and not SEEDS
    more = ("--generated", "wide", "--generated-share", "0.34", "--worlds", "2", "--poses", "2", "--pool", "2",
            "--held-out", "4", "--init", str(first), "--checkpoint", str(second))  # fmt: skip
    assert ic(*words, *more) == 0
    made = record(second)
    assert [part["batch_size"] for part in made["data"]["mixed"]] == [2, 1]
    assert made["held_out"] == 1 + 4
    assert made["start"]["file"] == "a.pt" and made["start"]["record"]["steps"] == record(first)["steps"]


def test_ctrl_c_ends_as_the_schedule_would_and_a_second_at_once() -> None:
    trainer = SimpleNamespace(stop=False)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), depth_train._ends_early(trainer):
        signal.raise_signal(signal.SIGTERM)
        assert trainer.stop
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (("--height", "100"), UserError, "multiple of 32"),
        (("--encoder", "/absent.pth"), CheckpointError, "no such file"),
        (("--textures", "/absent"), DatasetError, "no textures"),
        (("--device", "tpu9"), UserError, "device 'tpu9'"),
        (("--data", "m3d:/absent"), DatasetError, "no such folder"),
        (("--generated", "none"), UserError, "nothing to train on"),
        (("--worlds", "899999"), UserError, "for evaluation"),
        (("--init", "/absent.pt"), CheckpointError, "no such file"),
        (("--checkpoint", "/tmp"), UserError, "is a folder"),
    ],
)
def test_mistakes_are_told(words: tuple[str, ...], error: type[Exception], message: str, tmp_path: Path) -> None:
    with pytest.raises(error, match=message):
        ic("--checkpoint", str(tmp_path / "w.pt"), "--workers", "0", *words)


@pytest.mark.system
def test_two_processes_train_one_network(tmp_path: Path) -> None:
    data, weights = plain_folder(tmp_path / "mine"), tmp_path / "w.pt"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m",
               "instant_ic.cli.main", "depth", "train", "--height", "64", "--encoder", "none", "--data", data,
               "--batch-size", "1", "--epochs", "1", "--checkpoint", str(weights), "--device", "cpu"]  # fmt: skip
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=280, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert record(weights)["device"].startswith("2 x CPU") and record(weights)["steps"] == 2  # 5 panoramas, 2 a step
    assert done.stdout.count("training on 2 x CPU") == 1 and done.stdout.count("held-out panoramas:") == 1


def test_preset_sets_what_is_not_given(tmp_path: Path) -> None:
    data = plain_folder(tmp_path / "mine")
    words = ("--data", data, "--workers", "0", "--epochs", "1", "--checkpoint", str(tmp_path / "w.pt"))
    assert ic("--preset", "gpu", "--batch-size", "2", *words) == 0
    made = record(tmp_path / "w.pt")["training"]
    assert (made["batch_size"], made["minutes"], made["learning_rate"]) == (2, 20.0, 2e-3)
