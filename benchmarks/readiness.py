#!/usr/bin/env python3
"""The PSNR that the virtual space expects against the PSNR measured on the operator's page; prints JSON.

    python benchmarks/readiness.py [--world W[,W]] [--seed S] [--episodes N] [--fit]

The frames are those of ``ic evaluate illusion``. ``--fit`` prints the base and the gains of ``vspace/readiness.py``
that fit them best: fit on some worlds and seeds, test on others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from reporting import parser_for, report

from instant_ic.control.warmup import warm_up
from instant_ic.experiments.illusion import TeleopSettings
from instant_ic.experiments.illusion_stack import FOV_RAD, LIVE, FilmedStack, IllusionFrame
from instant_ic.experiments.teleop import run_episode
from instant_ic.vspace import readiness
from instant_ic.vspace.view import View, perspective_rays

if TYPE_CHECKING:
    from instant_ic.experiments.teleop_stack import StackConfig
    from instant_ic.sim.world import World

COLUMNS = 64
"""Columns of the rays from which readiness is computed, as in ``VirtualSpace``."""


class _JudgedStack(FilmedStack):
    """A filmed stack that keeps the terms of each live view."""

    terms: tuple[float, float] = (0.0, 0.0)

    def on_view(self, view: View, map_from_camera: NDArray[np.float64]) -> None:
        assert self.space is not None
        height, width = view.depth_m.shape
        rays = perspective_rays(map_from_camera, width, height, FOV_RAD)
        step = max(1, width // COLUMNS)
        rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
        chosen = (rows[:, None] * width + columns).reshape(-1)
        depth, confidence = (image.reshape(-1)[chosen] for image in (view.depth_m, view.confidence))
        prior = self.space.keyframes[0]
        texture = readiness.Texture.of(prior.rgb)
        self.terms = readiness.error_terms(prior, texture, rays.some(chosen), depth, confidence)


def samples(world: str, seed: int, episodes: int) -> list[dict[str, Any]]:
    """Return terms, expected and measured PSNR of the frames of a world."""
    settings, rows = TeleopSettings(episodes, seed, world, ("ic",), pictures=False), []
    stacks: list[_JudgedStack] = []

    def note(frame: IllusionFrame, *_: Any) -> None:
        shown, expected = frame.scores[LIVE].psnr_db, frame.expected_psnr_db
        rows.append({"terms": stacks[-1].terms, "psnr_db": shown, "expected_db": expected})

    for index in range(episodes):
        course = settings.course(index)

        def make_stack(world: World, config: StackConfig, course: Any = course, index: int = index) -> FilmedStack:
            stacks.append(_JudgedStack(world, config, course, index, note))
            return stacks[-1]

        run_episode(settings, index, methods=("ic",), make_stack=make_stack)
    return rows


def fit(rows: list[dict[str, Any]]) -> list[float]:
    """Fit base and non-negative gains so that the squared error has the least relative error, unbiased in dB."""
    from scipy.optimize import nnls

    mse = np.array([10 ** (-row["psnr_db"] / 10) for row in rows])
    matrix = np.array([[1e-3, *row["terms"]] for row in rows])
    weight: NDArray[np.float64] = mse
    for _ in range(20):  # weighted by measured and fitted error alike, so that errors in dB count the same
        gains = nnls(matrix / weight[:, None], mse / weight)[0]
        weight = np.sqrt(mse * np.maximum(matrix @ gains, 1e-6))
    gains /= np.exp(np.mean(np.log(matrix @ gains / mse)))
    return [float(gains[0] * 1e-3), *map(float, gains[1:])]


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--world", default="corridors", help="worlds, by comma (default corridors)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the courses (default 0)")
    parser.add_argument("--episodes", type=int, default=4, help="courses in each world (default 4)")
    parser.add_argument("--fit", action="store_true", help="fit base and gains to these frames")
    arguments = parser.parse_args()
    warm_up()
    frames = {world: samples(world, arguments.seed, arguments.episodes) for world in arguments.world.split(",")}
    result: dict[str, Any] = {}
    for world, rows in frames.items():
        measured, expected = (np.array([row[key] for row in rows]) for key in ("psnr_db", "expected_db"))
        error = expected - measured
        result[world] = {
            "frames": len(rows),
            "correlation": round(float(np.corrcoef(measured, expected)[0, 1]), 3),
            "mean_error_db": round(float(error.mean()), 2),
            "rms_error_db": round(float(np.sqrt(np.mean(error**2))), 2),
            "share_within_2_db": round(float(np.mean(np.abs(error) <= 2)), 3),
        }
    if arguments.fit:
        result["base_and_gains"] = fit([row for rows in frames.values() for row in rows])
    report(result, arguments.json)


if __name__ == "__main__":
    main()
