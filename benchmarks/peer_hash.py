"""Peer of our hash encoding in benchmarks: all levels at once in plain torch, gradients by autograd.

This is not nerfstudio's code. It reimplements the operations of its ``HashEncoding(implementation="torch")`` (one flat
table for all levels; per point and level, the eight corners are hashed, looked up and interpolated axis by axis), so
that the benchmark does not need nerfstudio. If nerfstudio is installed, its own encoding is used.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor


class TorchHashEncoding(torch.nn.Module):
    """Maps points of the unit cube (N, 3) to features (N, levels · features)."""

    def __init__(self, levels: int, features: int, log2_table: int, coarsest: int, finest: int) -> None:
        super().__init__()
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.scale: Tensor
        self.first: Tensor
        self.primes: Tensor
        self.register_buffer("scale", torch.floor(coarsest * growth ** torch.arange(levels)))
        self.register_buffer("first", torch.arange(levels) << log2_table)
        self.register_buffer("primes", torch.tensor([1, 2654435761, 805459861]))
        self.size = 1 << log2_table
        self.table = torch.nn.Parameter((torch.rand(levels << log2_table, features) * 2 - 1) * 1e-3)

    def forward(self, points: Tensor) -> Tensor:
        place = points[:, None] * self.scale[:, None]  # (N, L, 3)
        low, high = place.floor().long(), place.ceil().long()
        share = place - low
        rows = {}
        for corner in itertools.product((0, 1), repeat=3):
            cell = torch.stack([(high if side else low)[..., axis] for axis, side in enumerate(corner)], dim=-1)
            mixed = cell * self.primes
            index = (mixed[..., 0] ^ mixed[..., 1] ^ mixed[..., 2]) % self.size + self.first
            rows[corner] = self.table[index]  # (N, L, F)
        for axis in range(3):
            weight = share[..., axis, None]
            rest = itertools.product((0, 1), repeat=2 - axis)
            rows = {tail: rows[(0, *tail)] * (1 - weight) + rows[(1, *tail)] * weight for tail in rest}
        return rows[()].flatten(1)


def peer_encoding(
    levels: int, features: int, log2_table: int, coarsest: int, finest: int
) -> tuple[str, torch.nn.Module]:
    """Name and encoding: nerfstudio's if it is installed."""
    try:
        from nerfstudio.field_components.encodings import HashEncoding
    except ImportError:
        return "torch, as nerfstudio's", TorchHashEncoding(levels, features, log2_table, coarsest, finest)
    settings = {
        "num_levels": levels, "min_res": coarsest, "max_res": finest,
        "log2_hashmap_size": log2_table, "features_per_level": features,
    }  # fmt: skip
    return "nerfstudio", HashEncoding(**settings, implementation="torch")
