"""Fits the uncertainty of depth from LiDAR, and checks that |error| / sigma is below 1 in 68 % of the pixels.

    python benchmarks/depth_sigma.py --mesh ../shared/data/worlds/small_house.glb

The worlds are used neither for training nor in the evaluations. The printed table is ``_SIGMA`` in
instant_ic/depth/lidar_depth.py, the last line ``_NETWORK_SIGMA`` in instant_ic/depth/sources.py; run the script again
after changing the model.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from instant_ic.depth.lidar_depth import Origin, structure_sigma
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.sources import DepthSource
from instant_ic.experiments.depth_lidar import Errors, measure_world
from instant_ic.experiments.depth_worlds import LIDAR_HEIGHT_M
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import World
from instant_ic.sim.worlds import corridor_world, load_world, random_world
from instant_ic.util.paths import shipped_file

FIRST_SEED = 990_000
UP = np.array([0.0, 0.0, 1.0])
SHARE = 0.683
MOST_M = 16.0


def worlds(count: int, mesh: Path | None) -> Iterator[tuple[str, World, int]]:
    """Kind, world and number of positions."""
    for seed in range(FIRST_SEED, FIRST_SEED + count):
        yield "random", random_world(seed), 1
    yield "corridor", corridor_world(5), count // 2
    if mesh is not None:
        yield "mesh", load_world(mesh), count // 2


def samples(model: DepthModel, count: int, mesh: Path | None) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Kind, and data of some pixels of a panorama: origin, features and relative errors, each (N,)."""
    rng = np.random.default_rng(99)
    source = DepthSource()
    for kind, world, places in worlds(count, mesh):
        renderer = EquirectRenderer(world)
        try:
            poses = world.sample_free_poses(rng, places)
        except ValueError:  # no free position
            continue
        for number, (x, y, yaw) in enumerate(poses):
            height = float(rng.uniform(0.9, 1.4))
            pose = pose_matrix(x, y, height, yaw=yaw)
            frame = renderer.render(pose, model.manifest.input_width, model.manifest.input_height)
            errors = Errors(outliers=0.05 * (number % 2), seed=number)
            points = measure_world(renderer, pose, LIDAR_HEIGHT_M, height, errors)
            fit = source.scaler.fit(model.estimate(frame.rgb), points)
            if not fit.ok:
                continue
            network, _ = source.network(fit, points, UP, height)
            alone = source.structure.estimate(points, UP, height, frame.depth_m.shape)
            truth = frame.depth_m
            valid = np.flatnonzero((truth > 0) & (truth < MOST_M) & (network.depth_m > 0))
            chosen = rng.choice(valid, 6000)
            columns = {
                "origin": alone.origin, "gap": alone.gap_rad, "alone": alone.depth_m, "network": network.depth_m,
            }  # fmt: skip
            picked = {name: column.ravel()[chosen] for name, column in columns.items()}
            t = truth.ravel()[chosen]
            yield kind, picked | {name: np.abs(picked[name] - t) / t for name in ("alone", "network")}


def fit_sigma(features: np.ndarray, error: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients (K,) >= 0 of sigma = root of sum (k features)², features (N, K), with SHARE of the errors below it.

    Quantile regression of log error: the pinball loss is minimal where the share is met everywhere.
    """
    used = np.ptp(features, axis=0) > 1e-6
    used[0] = True
    features, target = features[:, used], np.log(np.maximum(error, 1e-4))

    def loss(logs: np.ndarray) -> float:
        sigma = np.sqrt(((features * np.exp(logs)) ** 2).sum(axis=1))
        left = target - np.log(np.maximum(sigma, 1e-4))
        return float((weight * np.maximum(SHARE * left, (SHARE - 1) * left)).sum() / weight.sum())

    start = np.log(np.full(features.shape[1], max(float(np.quantile(error, SHARE)), 1e-3)))
    found = minimize(loss, start, method="Nelder-Mead", options={"maxfev": 800, "xatol": 0.02, "fatol": 1e-6})
    every = np.zeros(len(used))
    every[used] = np.exp(np.clip(found.x, np.log(1e-4), np.log(9.0)))
    return every


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=30, help="random worlds; half as many places in the others")
    parser.add_argument("--mesh", type=Path, help="a mesh world besides")
    parser.add_argument("--model", type=Path, help="ONNX file (default: the shipped one)")
    args = parser.parse_args()
    model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=1)
    taken: dict[str, list[dict[str, np.ndarray]]] = {}
    for kind, one in samples(model, args.count, args.mesh):
        taken.setdefault(kind, []).append(one)
    weight = np.concatenate([np.full(len(one["alone"]), 1 / len(ones)) for ones in taken.values() for one in ones])
    every = {name: np.concatenate([one[name] for ones in taken.values() for one in ones]) for name in _names(taken)}
    features = np.stack([np.ones(len(weight)), every["gap"]], axis=1)
    for each in Origin:
        of = every["origin"] == each
        if each == Origin.UNKNOWN:
            row = np.array([np.inf, 0.0])
        elif of.sum() < 200:
            print(f"  # {each.name}: only {of.sum()} pixels, left as it is")
            continue
        else:
            row = fit_sigma(features[of], every["alone"][of], weight[of])
        print(f"  ({', '.join(f'{value:.4f}' for value in row)}),  # {each.name}")
    print("share of errors under sigma with the table as it is in the code:")
    start = 0
    for kind, ones in taken.items():
        part = slice(start, start := start + sum(len(each["alone"]) for each in ones))
        origin = every["origin"][part]
        below = every["alone"][part] < structure_sigma(origin, every["gap"][part])
        known, floor = origin > 0, origin == Origin.FLOOR
        print(f"  {kind:9} lidar {below[known].mean():.3f}, without the floor {below[known & ~floor].mean():.3f}")
    unknown = every["origin"] == Origin.UNKNOWN
    if unknown.any():
        print(f"network where the structure is unknown: {np.quantile(every['network'][unknown], SHARE):.3f}")


def _names(taken: dict[str, list[dict[str, np.ndarray]]]) -> list[str]:
    """Column names."""
    return list(next(iter(taken.values()))[0])


if __name__ == "__main__":
    main()
