"""CPU budget of each node: all of them and a browser fit on two cores, with simulated devices in real time."""

from __future__ import annotations

_PERCENT = {  # of one core, while driving in the virtual space; standing needs less
    "simulator": 33.0,
    "nerf": 17.0,
    "arbiter": 10.0,
    "vlp16_driver": 9.0,
    "console": 6.0,
    "navigator": 6.0,
    "grid_slam": 5.0,
    "crawler_base": 4.0,
    "depth_scaler": 10.0,
    "depth_estimator": 2.0,
    "operator_recorder": 2.0,
    "virtual_robot": 2.0,
    "theta_camera": 1.0,
}


def cpu_budget(node: str) -> float | None:
    """CPU budget of a node, with or without a namespace, in percent of one core; None if it has none."""
    return _PERCENT.get(node.rpartition("/")[2])
