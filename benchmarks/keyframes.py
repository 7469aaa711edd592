"""Several keyframes against one, 2 m from the nearest, in simulated worlds with true depth; prints JSON.

    python benchmarks/keyframes.py [--mesh house.glb]

PSNR (dB) and SSIM of views ahead and aside by one keyframe, three behind each other, and three round the place.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

import numpy as np
from skimage.metrics import structural_similarity

from instant_ic.geometry.poses import pose_matrix
from instant_ic.nerf import VirtualSpace, VirtualSpaceConfig

SIZE, FOV, PANORAMA = (320, 180), math.pi / 2, 1024
VIEWS = (pose_matrix(2.0), pose_matrix(2.0, 0.3, yaw=0.5), pose_matrix(2.0, yaw=-1.2))
PLACES = {"one": (0.0,), "three behind": (-1.5, -0.75, 0.0), "three round": (-1.5, 4.0, 0.0)}
"""Of the keyframes along x, in the order in which they are taken."""


def score(picture: Any, truth: Any) -> tuple[float, float]:
    """PSNR and SSIM (7 × 7 uniform window)."""
    mse = float(np.mean((picture.astype(float) - truth) ** 2))
    ssim = float(structural_similarity(picture, truth, channel_axis=2))
    return round(10 * math.log10(255**2 / mse), 2), round(ssim, 3)


def measure(renderer: Any, base: Any) -> dict[str, Any]:
    """All arrangements in one world."""
    truth = [renderer.render_perspective(base @ v, *SIZE, FOV, supersample=2).rgb for v in VIEWS]
    result = {}
    for name, places in PLACES.items():
        space = VirtualSpace(VirtualSpaceConfig(source="warp", keyframes=3))
        for x in places:
            pose = base @ pose_matrix(x)
            picture = renderer.render(pose, PANORAMA, PANORAMA // 2, supersample=2)
            space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
        space.render(base, *SIZE, FOV)
        start = time.process_time()
        drawn = [space.render(base @ v, *SIZE, FOV) for v in VIEWS]
        spent = (time.process_time() - start) / len(VIEWS)
        result[name] = {
            "psnr_ssim": [score(view.rgb, real) for view, real in zip(drawn, truth, strict=True)],
            "known": [round(view.mean_confidence, 3) for view in drawn],
            "cpu_ms": round(spent * 1e3),
        }
    return result


def main() -> None:
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import corridor_world, load_world

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", help="small_house.glb, to measure in it as well")
    arguments = parser.parse_args()
    result = {"corridor": measure(EquirectRenderer(corridor_world()), pose_matrix(3.0, z=1.2))}
    if arguments.mesh:
        start = pose_matrix(6.3, -2.4, 1.0, yaw=math.pi)
        result["mesh"] = measure(EquirectRenderer(load_world(arguments.mesh)), start)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
