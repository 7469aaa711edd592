"""Parameters that nobody outside may set, by whatever bridge: one rule for all of them."""

from __future__ import annotations

import fnmatch

NEVER_SET = (
    # nodes between a command and the tracks, and what they measure the world with
    *("arbiter.*", "crawler_base.*", "virtual_robot.*", "navigator.*"),
    *("vlp16_driver.*", "theta_camera.*", "grid_slam.*"),
    # ways in, and what stands in for the world
    *("console.*", "host_bridge.*", "foxglove_bridge.*", "zenoh_*.*", "bag_player.*", "simulator.*"),
    # of any node, also of one that is not ours
    *("*timeout*", "*time_out*", "*max_age*", "*silence*", "*limit*", "*footprint*", "*collision*", "*estop*"),
    *("*e_stop*", "*emergency*", "*command*", "*cmd_vel*", "*watchdog*", "*max_speed*", "*max_vel*", "*max_acc*"),
    *("*deceleration*", "*use_sim_time"),
)
"""Patterns of ``NODE.KEY``, where NODE is the node's executable: a node keeps it under any name."""


def never_set(executable: str, key: str) -> bool:
    """Whether a parameter can be changed only on this machine (``ic param set``).

    Args:
        executable: of the node, ``arbiter``; its own name may be another.
        key: of the parameter, groups with dots.
    """
    name = f"{executable}.{key}".lower()
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in NEVER_SET)
