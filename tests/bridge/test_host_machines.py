"""Robot and station as two machines: two network namespaces, a cable of 20 ± 5 ms with losses, real launch files."""

import shutil
import tempfile
from pathlib import Path

import pytest
from two_machines import TwoMachines, drive_and_cut, missing

from instant_ic.bus import registry
from instant_ic.experiments.stack import processes_of

pytestmark = [
    pytest.mark.system,
    pytest.mark.xdist_group("stack"),
    pytest.mark.timeout(600),
]


def test_the_operator_drives_a_robot_on_another_machine_and_a_cut_cable_stops_it():
    if why := missing():
        pytest.skip(why)
    folder = Path(tempfile.mkdtemp(prefix="ic2"))
    params = Path(__file__).with_name("busy_machine.yaml")
    try:
        with TwoMachines(folder, delay_ms=20, jitter_ms=5, loss=0.005) as machines:
            with (
                machines.robot(params=params) as robot,
                machines.station(depth=False, vspace=False, console_port=8080) as station,
            ):
                result = drive_and_cut(machines, robot, station)
                nodes = {info.name for info in registry.list_nodes(machines.run_dir("station"))}
                assert station.stop() == 0
                assert robot.stop() == 0
                logs = [stack.log_path.read_text(errors="replace") for stack in (robot, station)]
            left = [process for host in ("robot", "station") for process in processes_of(machines.run_dir(host))]
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    assert nodes == {"console", "host_bridge", "operator_recorder"} and left == []
    assert [log[log.index("Traceback") :][:3000] for log in logs if "Traceback" in log] == []
    lines = [line for log in logs for line in log.splitlines()]
    assert [line for line in lines if "host_bridge: topic /" in line] == []  # every topic of the list comes over
    assert result.picture_age_s < 5.0  # a picture of now; a busy machine makes one a second
    assert result.driven_m > 0.3
    assert result.stop_s < 5.0  # 0.3 s and 0.5 s of braking on a free machine
    assert result.drift_m < 0.05  # and no command from before the cut moved it when the cable was back
    assert result.driven_again_m > 0.2
    # One machine has one clock: what is measured is the error, which half of the round trip bounds.
    assert abs(result.offset_ms) <= result.rtt_ms / 2 + 1 and result.rtt_ms > 25, result
