"""Compilation of the kernels before the first keyframe needs them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from instant_ic.util.jit import leave_out_blas
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.space import VirtualSpace


def warm_up(config: VirtualSpaceConfig | None = None) -> None:
    """Render, and if necessary train, a test space once, so that numba compiles and caches all kernels.

    This takes about 8 s of CPU time in the first run of an installation, and below 1 s afterwards.
    """
    config = config or VirtualSpaceConfig()
    if config.source == "mesh":  # a mesh space renders its first view when it is created
        return
    leave_out_blas()
    small = dataclasses.replace(
        config,
        field=dataclasses.replace(config.field, log2_table=10),
        train=dataclasses.replace(config.train, ray_columns=16, ray_rows=16),
    )
    space = VirtualSpace(small)
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[::2] = 255
    below = np.sin((np.arange(32) - 15.5) * (math.pi / 32))[:, None]
    depth = np.repeat(np.minimum(4.0, 1.2 / np.maximum(below, 0.1)), 64, 1).astype(np.float32)  # walls and a floor
    depth[12:20, 28:36] = 2.0  # an object in front of a wall
    aside = np.eye(4)
    aside[1, 3] = 1.0
    for pose in (aside, np.eye(4))[-config.keyframes :]:
        space.set_keyframe(rgb, depth, pose, np.full_like(depth, 0.05))
    space.render(aside, 32, 16, math.pi / 2)
    if space.config.source == "field":
        space.train(iterations=1)
        space.render_equirect(np.eye(4), 64)
        space.config = dataclasses.replace(space.config, view=dataclasses.replace(config.view, field_alone=True))
        space.render(aside, 32, 16, math.pi / 2)
