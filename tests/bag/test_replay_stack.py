"""The shipped drive, with an operator who drives and looks, replayed from LiDAR packets to commands and views."""

from __future__ import annotations

from pathlib import Path

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bag.compare import compare
from instant_ic.bag.replay import ReplayResult, make_node, replay
from instant_ic.bus import SENSOR
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    ControlState,
    ViewRequest,
    deserialize,
    header,
    pose_message,
    serialize,
    twist_stamped,
    twist_values,
    type_name,
)

BAG = Path(__file__).resolve().parents[1] / "data" / "corridor_drive"
NODES = ("vlp16_driver", "grid_slam", "depth_scaler", "nerf", "virtual_robot", "navigator", "arbiter")
PARAMETERS = ("vlp16_driver.source:=topic", "depth_scaler.source:=lidar", "nerf.space.device:=cpu")
DRIVES_AFTER_S = 3.5  # the arbiter first waits for the camera's rate, then for an operator who lets go


def with_operator(folder: Path) -> Path:
    """The bag with commands at 20 Hz and requests for views at 2 Hz."""
    with BagReader(BAG) as reader, BagWriter(folder) as writer:
        step_ns, number = 50_000_000, 0

        def write(topic: str, message: object, at_ns: int) -> None:
            writer.write(topic, type_name(message), bytes(serialize(message)), at_ns, SENSOR)

        for message in reader.messages():
            while (at_ns := reader.start_ns + number * step_ns) <= message.stamp_ns:
                speed = 0.3 if number * 0.05 > DRIVES_AFTER_S else 0.0
                write("/operator/cmd_vel", twist_stamped(speed, 0.0, at_ns), at_ns)
                if number % 10 == 0:
                    pose = pose_message(pose_matrix(0.3, 0.1, 1.1))
                    write("/view/request", ViewRequest(header("map", at_ns), number, pose, 1.5, 64, 36), at_ns)
                number += 1
            writer.write(message.topic, message.type_name, message.payload, message.stamp_ns, message.qos)
    return folder


def run(bag: Path, output: Path) -> ReplayResult:
    return replay(bag, [make_node(name, None, PARAMETERS) for name in NODES], output)


def test_the_whole_stack_replays_bit_for_bit(tmp_path: Path) -> None:
    bag, first = with_operator(tmp_path / "bag"), tmp_path / "first"
    result = run(bag, first)
    least = {"/scan": 40, "/pose": 40, "/map": 2, "/depth/scaled": 2, "/keyframe": 2, "/vspace/status": 5}
    least |= {
        "/vspace/view": 4,
        "/costmap": 10,
        "/ic/state": 50,
        "/ic/trajectory": 20,
        "/cmd_vel": 50,
        "/vbot/odom": 50,
    }
    assert {topic: count for topic, count in least.items() if result.made[topic] < count} == {}
    with BagReader(first) as reader:
        states = [deserialize(m.payload, m.type_name) for m in reader.messages({"/ic/state"})]
    assert states[-1].mode == ControlState.REAL and twist_values(states[-1].applied_command)[0] > 0.1
    run(bag, tmp_path / "second")
    assert [topic.topic for topic in compare(first, tmp_path / "second") if not topic.same] == []
