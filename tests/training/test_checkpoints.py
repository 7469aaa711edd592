"""Checkpoints: damage is seen, and a file cannot run code."""

import os
import pickle
from pathlib import Path

import pytest
import torch

from instant_ic.training.checkpoints import CheckpointError, load_state, read_checkpoint


class Evil:
    def __reduce__(self) -> tuple[object, ...]:
        return os.system, ("exit 3",)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    with pytest.raises(CheckpointError, match="No such file"):
        read_checkpoint(path)
    for content in (b"<html>404 not found", pickle.dumps(Evil())):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="not a torch checkpoint"):
            read_checkpoint(path)
    torch.save({"config": Evil()}, path)
    with pytest.raises(CheckpointError, match="not a torch checkpoint of tensors and plain values"):
        read_checkpoint(path)


def test_damage_anywhere_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    torch.save({"weight": torch.rand(10_000)}, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CheckpointError, match=r"damaged|cannot be read"):
        read_checkpoint(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1  # one bit of a weight
    path.write_bytes(flipped)
    with pytest.raises(CheckpointError, match="does not match"):
        read_checkpoint(path)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"weight": torch.zeros(1, 2)}, "Missing key.*bias"),
        ({"weight": torch.zeros(1, 2), "bias": torch.zeros(3)}, "size mismatch for bias"),
        ([1], "x.pt"),
    ],
)
def test_tensors_that_do_not_fit_are_listed(state: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(CheckpointError, match=f"(?s){message}"):
        load_state(torch.nn.Linear(2, 1), state, "x.pt")
