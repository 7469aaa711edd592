"""The arbiter of a study's condition ``shared``: the robot drives around obstacles by itself."""

from instant_ic.experiments.study.arbiter_stop import SharedOnly, run

if __name__ == "__main__":
    run(SharedOnly)
