"""Compares the expected PSNR of the virtual space with the measured one in simulated worlds; prints JSON.

    python benchmarks/readiness.py [--mesh house.glb] [--fit]

Keyframes have the true depth with a smooth error of known size. ``--fit`` fits the gains of ``vspace/readiness.py`` to
the random worlds; the corridor and the mesh are for testing only.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from scipy.optimize import nnls

from instant_ic.experiments.depth_worlds import Scene, scenes
from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig, readiness
from instant_ic.vspace.view import perspective_rays

SIZE, FOV = (160, 90), math.pi / 2
DISTANCES_M = (0.0, 0.4, 0.8, 1.4, 2.0)
SIGMAS = (0.01, 0.04, 0.1)


def places(mesh: str | None, count: int) -> Iterator[tuple[str, Scene]]:
    """Held-out panoramas with their kind: of the corridor, of the mesh, of random worlds."""
    kinds: list[tuple[str, int, str | None]] = [("corridor", 2, None), ("random", count, None)]
    for kind, number, file in [*kinds, ("mesh", 2, mesh)] if mesh else kinds:
        yield from ((kind, scene) for scene in scenes(kind, number, file, height=512))


def wrong_depth(depth_m: Any, sigma: float, seed: int) -> Any:
    """Depth with a smooth relative error of standard deviation ``sigma``."""
    noise = np.random.default_rng(seed).normal(size=(8, 16)).astype(np.float32)
    smooth = cv2.resize(noise, depth_m.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return depth_m * (1 + sigma * smooth / smooth.std())


def samples(kind: str, scene: Scene) -> list[dict[str, Any]]:
    """Terms and measured PSNR of views ahead and to the side."""
    rows = []
    pose = scene.map_from_camera
    reach = float(scene.depth_m[250:262, 500:524].min()) - 0.5
    for sigma in SIGMAS:
        space = VirtualSpace(VirtualSpaceConfig(source="warp"))
        space.set_keyframe(scene.rgb, wrong_depth(scene.depth_m, sigma, 1), pose, sigma)
        for index, distance in enumerate(d for d in DISTANCES_M if d < reach):
            view = pose @ pose_matrix(distance, yaw=(0.0, 0.9, -0.9)[index % 3])
            picture = space.render(view, *SIZE, FOV)
            real = scene.renderer.render_perspective(view, *SIZE, FOV, supersample=2).rgb
            rays = perspective_rays(view, *SIZE, FOV)
            terms = readiness.error_terms(
                [space.keyframe], readiness.Texture.of(scene.rgb), rays,
                picture.depth_m.reshape(-1), picture.confidence.reshape(-1),
            )  # fmt: skip
            mse = float(np.mean((picture.rgb.astype(float) - real) ** 2)) / 255**2
            rows.append({
                "world": kind, "sigma": sigma, "distance_m": distance, "terms": terms,
                "psnr_db": psnr_of_mse(mse), "expected_db": space.expected_psnr_db(view),
            })  # fmt: skip
    return rows


def fit(rows: list[dict[str, Any]]) -> list[float]:
    """Base and non-negative gains with the least relative error of the squared error; unbiased in dB."""
    mse = np.array([10 ** (-row["psnr_db"] / 10) for row in rows])
    matrix = np.array([[1e-3, *row["terms"]] for row in rows]) / mse[:, None]
    gains = nnls(matrix, np.ones(len(rows)))[0]
    gains /= np.exp(np.mean(np.log(matrix @ gains)))
    return [float(gains[0] * 1e-3), *map(float, gains[1:])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", help="mesh world to test on as well")
    parser.add_argument("--count", type=int, default=5, help="random worlds (default 5)")
    parser.add_argument("--fit", action="store_true", help="fit base and gains on the random worlds")
    arguments = parser.parse_args()
    rows = [row for place in places(arguments.mesh, arguments.count) for row in samples(*place)]
    result: dict[str, Any] = {}
    for kind in dict.fromkeys(row["world"] for row in rows):
        measured, expected = (np.array([r[k] for r in rows if r["world"] == kind]) for k in ("psnr_db", "expected_db"))
        error = expected - measured
        result[kind] = {
            "views": len(measured),
            "correlation": round(float(np.corrcoef(measured, expected)[0, 1]), 3),
            "mean_error_db": round(float(error.mean()), 2),
            "rms_error_db": round(float(np.sqrt(np.mean(error**2))), 2),
        }
    if arguments.fit:
        result["base_and_gains"] = fit([row for row in rows if row["world"] == "random"])
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
