"""Parameters that no bridge may set: one rule for all bridges."""

from __future__ import annotations

import fnmatch

NEVER_SET = (
    # nodes between a command and the tracks, and the sensors they rely on
    *("arbiter.*", "crawler_base.*", "virtual_robot.*", "navigator.*"),
    *("vlp16_driver.*", "theta_camera.*", "grid_slam.*"),
    # command inputs, and sources of simulated or recorded data
    *("console.*", "host_bridge.*", "foxglove_bridge.*", "zenoh_*.*", "bag_player.*", "simulator.*"),
    # any node, including those of other projects
    *("*timeout*", "*time_out*", "*max_age*", "*silence*", "*limit*", "*footprint*", "*collision*", "*estop*"),
    *("*e_stop*", "*emergency*", "*command*", "*cmd_vel*", "*watchdog*", "*max_speed*", "*max_vel*", "*max_acc*"),
    *("*deceleration*", "*use_sim_time"),
)
"""Patterns of ``NODE.KEY``. NODE is the node's executable, which does not change when the node is renamed."""


def never_set(executable: str, key: str) -> bool:
    """Whether a parameter can be changed only on this machine (``ic param set``).

    Args:
        executable: executable of the node (``arbiter``); the node's name may differ.
        key: parameter key, with dots between groups.
    """
    name = f"{executable}.{key}".lower()
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in NEVER_SET)
