"""A drive through an obstacle, recorded and replayed through v-bot, navigator and arbiter: the same bytes again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from control_world import rectangle
from test_control_nodes import Stack, modes

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bag.replay import make_node, replay
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.bus.lockstep import Record
from instant_ic.geometry.poses import pose2_from_matrix
from instant_ic.msg import ControlState, deserialize, matrix_from_pose, serialize, twist_stamped, twist_values

NODES = ("virtual_robot", "navigator", "arbiter")  # in the order in which the drive starts them
MADE = ("/cmd_vel", "/ic/state", "/ic/subgoal", "/ic/trajectory", "/costmap", "/nav/cmd_vel", "/nav/path", "/vbot/odom")


class Drive:
    """What the world sent in a drive, and what the nodes made of it."""

    def __init__(self) -> None:
        stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
        self.sent: list[Record] = [stack.bus.records(topic)[0] for topic in ("/map", "/tf_static")]
        route = stack.bus.route

        def keep(topic: str, name: str, payload: bytes, node: str, *rest: object) -> None:
            if not node:
                self.sent.append(Record(topic, name, payload, stack.now, "", SENSOR))
            route(topic, name, payload, node, *rest)  # type: ignore[arg-type]

        stack.bus.route = keep  # type: ignore[method-assign]
        self.states = stack.drive(1.5, None) + stack.drive(15.0, (0.4, 0.0))
        self.contact = stack.contact
        self.made = {topic: [(r.stamp_ns, r.payload) for r in stack.bus.records(topic)] for topic in MADE}

    def replayed(
        self, folder: Path, changed: Callable[[Record], bytes] = lambda record: record.payload, seconds: float = 60.0
    ) -> dict[str, list[tuple[int, bytes]]]:
        """Messages of the nodes, by topic, when the first seconds of the drive are replayed from a bag."""
        start_ns = self.sent[0].stamp_ns
        with BagWriter(folder / "drive") as writer:
            for record in self.sent:
                if record.stamp_ns - start_ns <= seconds * 1e9:
                    qos = LATCHED if record.topic in ("/map", "/tf_static") else record.qos
                    writer.write(record.topic, record.type_name, changed(record), record.stamp_ns, qos)
        replay(folder / "drive", [make_node(name, None, []) for name in NODES], folder / "again")
        with BagReader(folder / "again") as reader:
            return {topic: [(m.stamp_ns, m.payload) for m in reader.messages({topic})] for topic in MADE}


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive()


def test_the_nodes_together_bring_the_operator_through_and_back(drive: Drive) -> None:
    said = ControlState
    assert modes(drive.states) == [said.STOPPED, said.REAL, said.ENTERING, said.VIRTUAL, said.RETURNING, said.REAL]
    assert not drive.contact and drive.states[-1].transitions == 5
    # The v-bot went straight through the box, the r-bot round it.
    virtual = [s for s in drive.states if s.mode == ControlState.VIRTUAL]
    vbot = np.array([pose2_from_matrix(matrix_from_pose(s.vbot_pose)) for s in virtual])
    robot = np.array([pose2_from_matrix(matrix_from_pose(s.robot_pose)) for s in virtual])
    assert np.abs(vbot[:, 1]).max() < 0.01
    assert ((vbot[:, 0] > 2.5) & (vbot[:, 0] < 3.0)).sum() > 10
    assert np.abs(robot[:, 1]).max() > 0.5
    # No leap of what the operator sees: 0.5 m/s for 50 ms is 2.5 cm.
    assert np.linalg.norm(np.diff(vbot[:, :2], axis=0), axis=1).max() < 0.03


def test_a_replay_makes_every_message_of_the_drive_again_bit_for_bit(drive: Drive, tmp_path: Path) -> None:
    again = drive.replayed(tmp_path)
    for topic in MADE:
        live = [made for made in drive.made[topic] if made[0] <= drive.sent[-1].stamp_ns]
        assert len(live) > 10, topic
        # At the very end the replay has the arbiter's last stop, and the live nodes may have one timer more.
        count = min(len(live), len(again[topic]))
        assert again[topic][:count] == live[:count], topic
        assert max(len(live), len(again[topic])) - count <= 1, topic


def test_another_command_of_the_operator_makes_other_messages(drive: Drive, tmp_path: Path) -> None:
    begin_ns, seconds = drive.sent[0].stamp_ns, 3.0

    def slower(record: Record) -> bytes:
        if record.topic != "/operator/cmd_vel" or record.stamp_ns - begin_ns < 2.5e9:
            return record.payload
        v, w = twist_values(deserialize(record.payload, record.type_name))
        return bytes(serialize(twist_stamped(v - 0.01, w, record.stamp_ns)))

    again = drive.replayed(tmp_path, slower, seconds)
    for topic in ("/cmd_vel", "/ic/state"):
        live = drive.made[topic]
        first = next(at for at, (new, old) in enumerate(zip(again[topic], live, strict=False)) if new != old)
        assert 2.5 <= (live[first][0] - begin_ns) / 1e9 <= 2.6, topic
