"""The arbiter of a study's condition ``shared``: the robot drives around obstacles by itself."""

from instant_ic.experiments.study.arbiter_stop import StopControl, run
from instant_ic.experiments.teleop_shared import SharedControl


class SharedOnly(StopControl, SharedControl):
    """``SharedControl`` beside a running virtual space, which it does not hear of."""


if __name__ == "__main__":
    run(SharedOnly)
