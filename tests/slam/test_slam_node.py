"""The node grid_slam in lockstep: topics, transforms, waiting for odometry, faults."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from slam_planar_world import PlanarWorld, box_room

from instant_ic.bus import ERROR, OK, WARN
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.poses import compose2, matrix_from_pose2, pose2_from_matrix, pose_matrix, relative2
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.msg import (
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TFMessage,
    grid_array,
    header,
    matrix_from_pose,
    odometry_message,
    pose_message,
    scan_message,
    stamp_ns,
    transform_matrix,
    transform_message,
)
from instant_ic.util.contradiction import Contradiction
from nodes.grid_slam import GridSlamConfig, GridSlamNode

START_NS = 1_700_000_000_000_000_000
MOUNT = np.array([0.1, 0.0, 0.0])


class Rig:
    """A lockstep bus with the node, a laser at 10 Hz and wheels at 30 Hz."""

    def __init__(self, config: GridSlamConfig | None = None, mount: bool = True) -> None:
        self.bus = LockstepBus(start_ns=START_NS)
        self.node = self.bus.add(GridSlamNode, config or GridSlamConfig())
        self.world: PlanarWorld = box_room()
        self.now_ns = START_NS
        self.true = np.zeros(3)
        self.odometry: np.ndarray = np.zeros(3)
        self.truths: dict[int, np.ndarray] = {}
        if mount:
            base_from_laser = pose_matrix(x=MOUNT[0], z=0.6)
            transform = transform_message(base_from_laser, "base_link", "velodyne", START_NS)
            self.bus.publish("/tf_static", TFMessage([transform]), latched=True)

    def drive(self, v: float, w: float, scans: int, slip: float = 1.0, wheels: bool = True) -> None:
        """As the devices do: the scan is measured and sent, odometry newer than it comes a little later."""
        for _ in range(scans):
            for third in range(3):
                self.now_ns += 33_333_333 if third < 2 else 33_333_334
                self.true = compose2(self.true, np.array([v, 0.0, w]) / 30)
                self.odometry = compose2(self.odometry, np.array([v, 0.0, w]) / 30 * slip)
                if third == 2:
                    self.scan()
                if wheels:
                    self.wheel()

    def wheel(self) -> None:
        message = odometry_message(matrix_from_pose2(self.odometry), 0.0, 0.0, "odom", "base_link", self.now_ns)
        self.bus.publish("/wheel/odom", message, stamp_ns=self.now_ns)

    def scan(self, ranges: np.ndarray | None = None, stamp: int | None = None) -> None:
        stamp = self.now_ns if stamp is None else stamp
        scan = self.world.scan(compose2(self.true, MOUNT), stamp, noise_m=0.01)
        values = scan.ranges if ranges is None else ranges
        message = scan_message(values, scan.angle_min, scan.angle_increment, 0.3, 30.0, "velodyne", stamp)
        self.truths[stamp] = self.true.copy()
        self.bus.publish("/scan", message, stamp_ns=self.now_ns)

    def transforms(self, child: str) -> list[tuple[int, np.ndarray]]:
        every = [t for message in self.bus.messages("/tf") for t in message.transforms if t.child_frame_id == child]
        return [(stamp_ns(t), pose2_from_matrix(transform_matrix(t))) for t in every]

    def pose_errors(self) -> list[float]:
        errors = []
        for message in self.bus.messages("/pose"):
            truth = self.truths[stamp_ns(message)]
            error = relative2(truth, pose2_from_matrix(matrix_from_pose(message)))
            errors.append(math.hypot(error[0], error[1]))
        return errors


def test_pose_map_and_transform_of_a_drive_on_slipping_tracks() -> None:
    rig = Rig()
    rig.wheel()
    rig.scan()
    rig.drive(0.4, 0.2, 40, slip=1.2)
    errors = rig.pose_errors()
    assert len(errors) == 41
    assert max(errors) < 0.02
    pose = rig.bus.last("/pose")
    assert pose.header.frame_id == "map"
    covariance = np.asarray(pose.pose.covariance).reshape(6, 6)
    assert (np.diag(covariance)[[0, 1, 5]] > 0).all() and np.all(covariance[[2, 3, 4]] == 0)

    # map→odom ∘ odom→base_link is the pose, at the scan's stamp.
    stamp, map_from_odom = rig.transforms("odom")[-1]
    assert stamp == stamp_ns(pose)
    assert np.allclose(compose2(map_from_odom, rig.odometry), pose2_from_matrix(matrix_from_pose(pose)), atol=1e-6)
    assert len(rig.transforms("odom")) == 41
    assert rig.transforms("base_link") == []  # odometry is the wheels' own

    maps = rig.bus.messages("/map")
    assert 4 <= len(maps) <= 6  # one at once, then at most one a second
    grid, resolution, _ = grid_array(maps[-1])
    assert resolution == pytest.approx(0.05)
    assert {int(v) for v in np.unique(grid)} <= set(range(-1, 101))
    assert (grid > 65).sum() > 200 and (grid == -1).sum() > 1000
    assert rig.node.diagnostics.worst[0] == OK


def test_without_wheels_the_node_completes_the_transforms() -> None:
    rig = Rig(GridSlamConfig(use_wheel_odom=False))
    rig.scan()
    rig.drive(0.4, 0.1, 30, wheels=False)
    assert max(rig.pose_errors()) < 0.02
    buffer = TransformBuffer()
    for child, parent in (("base_link", "odom"), ("odom", "map")):
        for stamp, pose in rig.transforms(child):
            buffer.set(parent, child, stamp, matrix_from_pose2(pose))
    found = pose2_from_matrix(buffer.lookup("map", "base_link", rig.now_ns))
    assert np.hypot(*relative2(rig.true, found)[:2]) < 0.02
    assert rig.node.diagnostics.worst[0] == OK


def test_no_wheel_odometry_at_all_is_told_and_bridged() -> None:
    rig = Rig()
    rig.scan()
    rig.drive(0.3, 0.0, 5, wheels=False)
    assert rig.bus.messages("/pose") == []  # within STARTUP_WAIT_S
    rig.drive(0.3, 0.0, 15, wheels=False)
    assert len(rig.bus.records("/pose")) == 21  # none of those that waited is lost
    assert len(rig.transforms("base_link")) == 21
    level, text, _ = rig.node.diagnoses()["odometry"]
    assert level == WARN and "/wheel/odom" in text
    assert max(rig.pose_errors()) < 0.02


def test_scans_that_cannot_be_used_are_counted_and_told() -> None:
    rig = Rig()
    rig.wheel()
    rig.scan()
    rig.drive(0.2, 0.0, 5)
    count = len(rig.bus.records("/pose"))

    rig.scan(stamp=rig.now_ns - 2_000_000_000)
    level, text, values = rig.node.diagnoses()["scan"]
    assert (level, values["dropped"]) == (WARN, 1) and "2.00 s old" in text
    rig.scan(stamp=rig.now_ns + 2_000_000_000)
    assert "in the future" in rig.node.diagnoses()["scan"][1]
    rig.scan(stamp=rig.now_ns)
    assert rig.node.diagnoses()["scan"][2]["dropped"] == 3
    assert len(rig.bus.records("/pose")) == count

    rig.drive(0.2, 0.0, 1)
    assert rig.node.diagnoses()["scan"][0] == OK
    rig.now_ns += 33_333_333
    rig.scan(ranges=np.full(720, np.inf))
    rig.now_ns += 33_333_333
    rig.wheel()
    assert "too few points" in rig.node.diagnoses()["slam"][1]
    assert len(rig.bus.records("/pose")) == count + 2
    rig.bus.advance(5.0)
    assert rig.node.diagnoses()["scan"][0] == ERROR


def test_an_unknown_mount_is_told_until_it_is_known() -> None:
    rig = Rig(mount=False)
    rig.wheel()
    rig.drive(0.2, 0.0, 3)
    assert rig.bus.messages("/pose") == []
    level, text, _ = rig.node.diagnoses()["scan"]
    assert level == WARN and "velodyne" in text


def test_time_that_goes_far_back_begins_a_new_map() -> None:
    rig = Rig()
    rig.wheel()
    rig.drive(0.4, 0.2, 20)
    size = len(rig.node.slam.front_end.trajectory)
    assert size > 2
    # A recording is played again: the clock of the bus cannot go back, so age is let pass.
    rig.node.queue.config = replace(rig.node.config, max_scan_age_s=100.0)
    rig.now_ns -= 1_900_000_000
    rig.wheel()
    rig.scan()
    assert len(rig.node.slam.front_end.trajectory) == 1
    assert "A new map has been started" in rig.node.diagnoses()["time"][1]


def test_two_runs_are_the_same_bit_for_bit() -> None:
    runs = []
    for _ in range(2):
        rig = Rig()
        rig.wheel()
        rig.drive(0.4, 0.3, 25, slip=1.2)
        records = [r for topic in ("/pose", "/map", "/tf") for r in rig.bus.records(topic) if r.node]
        runs.append([(r.topic, r.stamp_ns, r.payload) for r in records])
    assert len(runs[0]) > 50
    assert runs[0] == runs[1]


def save_box_map(folder: Path) -> Path:
    """The box room's map, saved through the node's command; its origin is the start of the rig."""
    rig = Rig()
    rig.wheel()
    rig.scan()
    rig.drive(0.4, 0.4, 60)
    stem = folder / "maps" / "box"
    assert rig.node.commands["save"](path=str(stem))[0] == f"{stem}.yaml"
    return stem


def test_the_map_is_saved_on_request_and_a_fault_is_told(tmp_path: Path) -> None:
    stem = save_box_map(tmp_path)
    assert sorted(file.name for file in stem.parent.iterdir()) == ["box.graph.npz", "box.pgm", "box.yaml"]
    rig = Rig()
    with pytest.raises(ValueError, match="the map is empty: nothing to save"):
        rig.node.commands["save"](path=str(tmp_path / "none"))


@pytest.mark.parametrize("mode", ["localization", "mapping"])
def test_no_pose_is_told_before_the_place_in_a_saved_map_is_known(tmp_path: Path, mode: str) -> None:
    stem = save_box_map(tmp_path)
    rig = Rig(GridSlamConfig(mode=mode, map_file=str(stem)))
    rig.world = PlanarWorld([(-90.0, -1.0, 90.0, -1.0), (-90.0, 1.0, 90.0, 1.0)])  # looks like nothing on the map
    rig.wheel()
    rig.scan()
    rig.drive(0.4, 0.0, 12)
    assert rig.bus.messages("/pose") == [] and rig.transforms("odom") == []
    level, text, _ = rig.node.diagnoses()["place"]
    assert level == WARN and "not known yet" in text


def test_the_place_in_a_saved_map_is_found(tmp_path: Path) -> None:
    stem = save_box_map(tmp_path)
    rig = Rig(GridSlamConfig(mode="localization", map_file=f"{stem}.yaml"))
    rig.true = np.array([1.0, -0.6, 2.0])  # not where the map began, and the odometry knows nothing of it
    rig.wheel()
    rig.scan()
    rig.drive(0.2, 0.1, 30)
    errors = rig.pose_errors()
    assert len(errors) > 20 and max(errors) < 0.06
    assert rig.node.diagnoses()["place"][:2] == (OK, "Found in the saved map")
    grid, _, _ = grid_array(rig.bus.last("/map"))
    assert (grid == 100).sum() > 100
    # Somebody says that it is elsewhere, a little wrong: the scans decide.
    pose = PoseWithCovarianceStamped(
        header=header("map", rig.now_ns),
        pose=PoseWithCovariance(
            pose=pose_message(matrix_from_pose2(compose2(rig.true, [0.2, 0.1, 0.2]))), covariance=np.zeros(36)
        ),
    )
    rig.bus.publish("/initialpose", pose, stamp_ns=rig.now_ns)
    rig.drive(0.2, 0.1, 5)
    assert max(rig.pose_errors()[-4:]) < 0.06


def test_a_map_that_is_not_there_ends_the_node(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="cannot be read"):
        Rig(GridSlamConfig(map_file=str(tmp_path / "none")))
    with pytest.raises(ValueError, match="needs map_file"):
        GridSlamConfig(mode="localization")


def test_a_changed_map_comes_once_per_period_and_an_unchanged_one_not_again() -> None:
    rig = Rig()
    rig.wheel()
    rig.scan()
    rig.drive(0.4, 0.4, 60)
    maps = rig.bus.messages("/map")
    assert len(maps) > 2 and min(np.diff([stamp_ns(message) for message in maps[1:]])) >= 0.9e9
    assert np.array_equal(grid_array(maps[-1])[0], rig.node.slam.grid().values)
    rig.drive(0.0, 0.0, 30)
    assert len(rig.bus.messages("/map")) <= len(maps) + 1


def test_a_stuck_robot_is_told() -> None:
    rig = Rig()
    rig.wheel()
    rig.scan()
    rig.drive(0.4, 0.0, 10)
    assert rig.node.diagnoses()["motion"][0] == OK
    for _ in range(30):  # the tracks turn, the robot stands
        rig.now_ns += 100_000_000
        rig.odometry = compose2(rig.odometry, [0.04, 0.0, 0.0])
        rig.scan()
        rig.wheel()
    level, text, _ = rig.node.diagnoses()["motion"]
    assert level == ERROR and text == Contradiction.SLIPPING.text


def test_a_fault_of_the_worker_is_told_and_the_scans_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.wheel()
    rig.scan()

    def broken(*args: object) -> None:
        raise RuntimeError("no more")

    monkeypatch.setattr(rig.node.slam.loop_closure, "update", broken)
    rig.drive(0.4, 0.3, 20)
    assert len(rig.bus.records("/pose")) == 21 and max(rig.pose_errors()) < 0.03
    level, text, _ = rig.node.diagnoses()["loops"]
    assert level == ERROR and "no more" in text
