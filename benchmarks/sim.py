"""CPU time of the simulator: milliseconds per panorama and per LiDAR revolution, as JSON.

    python benchmarks/sim.py --world corridor

Each figure is CPU time of the calling thread (``time.thread_time``), the median over poses spread over the world, after
a warm-up call. ``cores_at_5_and_10_hz`` is the load of 5 panoramas and 10 revolutions per second together.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from reporting import parser_of, report

from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.robot import RobotConfig
from instant_ic.sim.simulation import Simulation, SimulationConfig
from instant_ic.sim.worlds import make_world, random_world


def cpu_ms(call: Callable[[], object]) -> float:
    """CPU milliseconds of this thread in one call."""
    began = time.thread_time()
    call()
    return 1e3 * (time.thread_time() - began)


def measure(world_name: str, poses: int, seed: int) -> dict[str, object]:
    """All figures for one world."""
    random_world(0)
    build_ms = cpu_ms(lambda: make_world(world_name))
    random_ms = [cpu_ms(lambda s=s: random_world(s)) for s in range(seed, seed + 8)]  # type: ignore[misc]
    simulation = Simulation(SimulationConfig(world=world_name, robot=RobotConfig(slip=0.0)))
    world, renderer = simulation.world, EquirectRenderer(simulation.world)
    renderer.render(pose_matrix(*world.spawn[:2], 1.2), 1024, 512)
    panorama_ms, jpeg_ms, quality_db = [], [], []
    for number, (x, y, yaw) in enumerate(world.sample_free_poses(np.random.default_rng(seed), poses)):
        pose = pose_matrix(x, y, 1.2, 0.0, 0.0, yaw)
        panorama_ms.append(cpu_ms(lambda p=pose: renderer.render(p, 1024, 512)))  # type: ignore[misc]
        picture = renderer.render(pose, 1024, 512).rgb
        jpeg_ms.append(cpu_ms(lambda p=picture: cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, 92])))  # type: ignore[misc]
        if number < 5:
            quality_db.append(psnr_db(picture, renderer.render(pose, 1024, 512, supersample=4).rgb))

    def seconds(duration_s: float) -> None:
        for _ in range(round(duration_s * 100)):
            simulation.step(0.01)
            simulation.scan_packets()

    seconds(0.5)
    revolution_ms = cpu_ms(lambda: seconds(4.0)) / 40
    panorama = float(np.median(panorama_ms)) + float(np.median(jpeg_ms))
    return {
        "world": world_name,
        "triangles": len(world.faces),
        "world_build_ms": round(build_ms, 1),
        "random_world_build_ms": round(float(np.median(random_ms)), 1),
        "panorama_1024x512_ms": round(float(np.median(panorama_ms)), 1),
        "panorama_1024x512_ms_worst": round(max(panorama_ms), 1),
        "jpeg_ms": round(float(np.median(jpeg_ms)), 1),
        "panorama_db_against_16_samples_a_pixel": round(float(np.mean(quality_db)), 1),
        "revolution_with_dynamics_ms": round(revolution_ms, 2),
        "cores_at_5_and_10_hz": round((5 * panorama + 10 * revolution_ms) / 1e3, 3),
    }


if __name__ == "__main__":
    parser = parser_of(__doc__)
    parser.add_argument("--world", default="corridor", help="corridor, random:SEED or a mesh file")
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    report(measure(arguments.world, arguments.poses, arguments.seed), arguments.json)
