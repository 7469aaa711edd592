"""The arbiter of a study's condition ``stop``: without a virtual space, the robot stops at obstacles."""

from __future__ import annotations

from dataclasses import replace

from instant_ic.bus import main
from instant_ic.bus.node_files import node_class
from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.snapshot import ArbiterInputs, Vspace


class StopControl(Arbiter):
    """Never switches: it does not hear of the virtual space, which still gives the page its smooth camera image."""

    def step(self, inputs: ArbiterInputs, now_ns: int) -> Decision:
        """One step, as ``Arbiter.step``."""
        return super().step(replace(inputs, vspace=Vspace()), now_ns)


def run(arbiter: type[Arbiter]) -> None:
    """Run the shipped node ``arbiter`` with another arbiter."""
    shipped = node_class("arbiter")

    class OtherArbiter(shipped):  # type: ignore[valid-type, misc]
        def setup(self) -> None:
            super().setup()
            self.arbiter = arbiter(self.config)

    main(OtherArbiter)


if __name__ == "__main__":
    run(StopControl)
