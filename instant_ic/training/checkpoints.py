"""Reads checkpoints of torch: tensors and plain values only."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn


class CheckpointError(ValueError):
    """A checkpoint file is missing, damaged or of another network."""


def read_checkpoint(path: Path) -> Any:
    """Read a checkpoint to the CPU; only tensors and plain values, so that a file cannot run code.

    Raises:
        CheckpointError: the file is missing or damaged, or holds other objects.
    """
    try:
        if zipfile.is_zipfile(path):  # torch's format; torch itself does not verify the checksums
            with zipfile.ZipFile(path) as archive:
                if bad := archive.testzip():
                    raise CheckpointError(f"{path}: damaged: the checksum of {bad} does not match")
        return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # torch.load raises anything from EOFError to RuntimeError
        first = str(error).split("\n")[0]
        text = f"{path}: damaged, or not a torch checkpoint of tensors and plain values ({first})"
        raise CheckpointError(text) from error


def load_state(model: nn.Module, state: dict[str, Tensor], path: str | Path) -> None:
    """Fill a network with the tensors of a checkpoint.

    Raises:
        CheckpointError: tensors are missing, unknown or have another shape; the message lists them.
    """
    try:
        model.load_state_dict(state, strict=True)
    except (RuntimeError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path}: {error}") from error
