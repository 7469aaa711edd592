"""Camera against LiDAR: edges of made-up scans, and recordings of the simulator with a camera that hangs elsewhere."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_sim import BASE_FROM_CAMERA, BASE_FROM_LIDAR, perturbed, record
from scipy.spatial.transform import Rotation

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bus.node_files import node_class
from instant_ic.calibration.bag import read_recording
from instant_ic.calibration.edges import CUES, FloorPlane, find_floor, image_edges, lidar_edges
from instant_ic.calibration.mount import AXES, CalibrationError, CalibrationFrame, calibrate, correction
from instant_ic.calibration.overlay import before_and_after, overlay
from instant_ic.cli.main import main
from instant_ic.config.params import build, load_file
from instant_ic.geometry.poses import inverse, pose_matrix

QUICK: dict[str, Any] = {"blur_px": (8.0, 2.0, 1.0), "yaw_step_deg": 4.0}
ELEVATIONS = np.radians(np.arange(-15, 16, 2.0))


def scan(range_of, intensity_of=lambda azimuth, ring: np.full(azimuth.shape, 20.0)):
    """One revolution of made-up ranges: points (N, 3), intensity, ring."""
    ring, azimuth = np.meshgrid(np.arange(16), np.radians(np.arange(-179.8, 180, 0.4)), indexing="ij")
    elevation = ELEVATIONS[ring]
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    points = direction * range_of(azimuth, elevation)[..., None]
    return points.reshape(-1, 3), intensity_of(azimuth, ring).ravel(), ring.ravel()


def round_room(azimuth, elevation, radius=4.0, floor=-0.6):
    """A round room with a floor 0.6 m below the LiDAR."""
    wall = radius / np.cos(elevation)
    return np.where(np.sin(elevation) * wall < floor, floor / np.minimum(np.sin(elevation), -1e-9), wall)


def of_cue(edges, name):
    return edges.points[edges.cue == CUES.index(name)]


def test_floor_is_found_though_the_lidar_is_tilted():
    points, _, _ = scan(round_room)
    tilt = Rotation.from_euler("xyz", [3, -4, 0], degrees=True)
    floor = find_floor(tilt.apply(points))
    np.testing.assert_allclose(floor.normal, tilt.apply([0, 0, 1]), atol=1e-6)
    assert floor.height == pytest.approx(-0.6, abs=1e-6)
    assert find_floor(points[points[:, 2] > 0]) is None
    beams = scan(lambda azimuth, elevation: np.full(azimuth.shape, 3.0))[0]  # a sphere has no floor
    assert find_floor(beams) is None


def test_edges_of_a_made_up_room():
    # A post of 20 degrees at 2 m before the round wall at 4 m; a dark door between 80 and 100 degrees.
    def ranges(azimuth, elevation):
        return np.where(np.abs(azimuth) < math.radians(10), 2.0, round_room(azimuth, elevation))

    def shade(azimuth, ring):
        return np.where(np.abs(azimuth - math.radians(90)) < math.radians(10), 5.0, 40.0)

    points, intensity, ring = scan(ranges, shade)
    edges = lidar_edges(points, intensity, ring, FloorPlane(np.array([0.0, 0.0, 1.0]), -0.6))
    jumps = of_cue(edges, "jump")
    assert len(jumps) >= 2 * 12
    np.testing.assert_allclose(np.abs(np.degrees(np.arctan2(jumps[:, 1], jumps[:, 0]))), 10.0, atol=0.21)
    np.testing.assert_allclose(np.linalg.norm(jumps, axis=1), 2.0)  # the nearer side
    shades = of_cue(edges, "shade")
    np.testing.assert_allclose(
        sorted(set(np.round(np.degrees(np.arctan2(shades[:, 1], shades[:, 0])), 1))), [80, 100], atol=0.21
    )
    feet = of_cue(edges, "floor")
    wall = np.abs(np.arctan2(feet[:, 1], feet[:, 0])) > math.radians(10.5)
    np.testing.assert_allclose(feet[wall, 2], -0.6)  # exactly where wall and floor meet, not between two beams
    np.testing.assert_allclose(np.hypot(feet[wall, 0], feet[wall, 1]), 4.0)
    assert len(of_cue(lidar_edges(points, intensity, ring, None), "floor")) == 0
    assert len(lidar_edges(points[:0], intensity[:0], ring[:0], None).cue) == 0


def test_image_edges_of_a_door_at_the_seam():
    rgb = np.random.default_rng(0).integers(196, 205, (64, 128, 3)).astype(np.uint8)
    rgb[20:50, :24] = 30  # from the seam to column 24, from row 20 to row 50
    upright, lying = image_edges(rgb, 1.0)
    assert upright[35, [127, 0, 23, 24]].min() > 4 * upright[35, [8, 12, 60, 100]].max()
    assert lying[[19, 20, 49, 50], 12].min() > 2 * lying[[5, 35, 60], 12].max()


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A short drive through a furnished room, the camera 5 cm and 3 degrees from where its mount says."""
    path = tmp_path_factory.mktemp("r") / "drive"
    base_from_camera = perturbed(BASE_FROM_CAMERA, 0.05, 3.0, seed=1)
    return path, record(path, base_from_camera, "random:900004", images=6, size=(512, 256), period_s=1.1)


def test_recording_is_read_with_motion_compensated(drive):
    recording = read_recording(drive[0])
    assert (recording.images, len(recording.frames), recording.moves) == (6, 6, True)
    assert recording.places >= 3
    np.testing.assert_allclose(recording.camera_from_lidar, inverse(BASE_FROM_CAMERA) @ BASE_FROM_LIDAR, atol=1e-9)
    floor = find_floor(recording.frames[0].points)
    assert floor.height == pytest.approx(-0.6, abs=0.02)
    assert len(read_recording(drive[0], most_frames=2).frames) == 2


def test_camera_is_found_by_the_command(drive, tmp_path, capsys):
    bag, truth = drive
    out, plot, numbers = tmp_path / "mount.yaml", tmp_path / "overlay.png", tmp_path / "numbers.json"
    words = [
        "calibrate",
        "camera-lidar",
        str(bag),
        "-o",
        str(out),
        "--plot",
        str(plot),
        "--json",
        str(numbers),
        "--near",
    ]
    assert main(words) == 0
    summary = json.loads(numbers.read_text())
    error = correction(truth, np.array(summary["camera_from_lidar"]))
    assert np.linalg.norm(error[:3]) <= 0.02
    assert np.degrees(np.linalg.norm(error[3:])) <= 0.3
    assert all(summary["constrained"].values())
    assert summary["score_after"] > 1.1 * summary["score_before"] > 1.1
    # The file is what the camera's driver takes, and is the mount that was simulated.
    config = node_class("theta_camera").config_class()
    mount = pose_matrix(*build(config, load_file(out, "theta_camera")).camera_mount.pose)
    np.testing.assert_allclose(inverse(mount) @ BASE_FROM_LIDAR, np.array(summary["camera_from_lidar"]), atol=2e-4)
    assert plot.stat().st_size > 10_000
    assert "camera on base_link" in capsys.readouterr().out


def test_yaw_is_found_around_the_full_circle(drive):
    recording = read_recording(drive[0], most_frames=3)
    turned = pose_matrix(yaw=math.radians(130)) @ recording.camera_from_lidar
    result = calibrate(recording.frames, turned, **QUICK)
    error = correction(drive[1], result.camera_from_lidar)
    assert abs(math.degrees(error[5])) < 0.5
    assert result.yaw_rival < 0.8


def test_what_standing_still_does_not_constrain_is_kept(drive):
    recording = read_recording(drive[0], most_frames=1)
    result = calibrate(recording.frames, recording.camera_from_lidar, **QUICK)
    assert not result.constrained[AXES.index("z")]
    assert result.sigma[2] > 0.03
    error = correction(recording.camera_from_lidar, result.camera_from_lidar)
    assert abs(error[2]) < 0.03


def test_a_bare_room_gives_no_calibration():
    points, intensity, ring = scan(lambda azimuth, elevation: 4.0 / np.cos(elevation))
    bare = CalibrationFrame(np.full((128, 256, 3), 128, np.uint8), points, intensity, ring)
    with pytest.raises(CalibrationError, match=r"only 0 edge points in 1 frames, 500 are needed"):
        calibrate([bare], np.eye(4), **QUICK)
    with pytest.raises(CalibrationError, match="no pair"):
        calibrate([], np.eye(4), **QUICK)
    # Edges enough, but the image shows nothing of them: lens cap on.
    jagged = scan(lambda azimuth, elevation: np.where(np.sin(20 * azimuth) > 0, 2.0, 4.0))
    with pytest.raises(CalibrationError, match="better than chance"):
        calibrate([CalibrationFrame(bare.rgb, *jagged)], np.eye(4), **QUICK)


def copy(bag: Path, target: Path, keep, shift_ns: int = 0) -> Path:
    """A bag with some topics of another; those of the LiDAR shifted in time."""
    from instant_ic.msg import deserialize, serialize, stamp_ns, to_time

    with BagReader(bag) as reader, BagWriter(target) as writer:
        for message in reader.messages():
            if keep(message.topic):
                payload = message.payload
                if shift_ns and message.topic == "/lidar/points":
                    cloud = deserialize(payload, message.type_name)
                    cloud.header.stamp = to_time(stamp_ns(cloud) + shift_ns)
                    payload = bytes(serialize(cloud))
                writer.write(message.topic, message.type_name, payload, message.stamp_ns, message.qos)
    return target


@pytest.mark.parametrize(
    ("without", "shift_ns", "words"),
    [
        ("/camera/image/compressed", 0, "no /camera/image/compressed (CompressedImage); topics of the bag:"),
        ("/lidar/points", 0, "no /lidar/points or /lidar/packets (PointCloud2 or VelodyneScan); topics of the bag:"),
        ("/tf_static", 0, "no odometry at"),
        ("", 700_000_000, "none within 0.15 s of one of the 6 selected images"),
    ],
)
def test_bad_bags_are_told(drive, tmp_path, capsys, without, shift_ns, words):
    bag = copy(drive[0], tmp_path / "bag", lambda topic: topic != without, shift_ns)
    assert main(["calibrate", "camera-lidar", str(bag), "-o", str(tmp_path / "mount.yaml")]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "mount.yaml").exists()


def test_overlay_puts_points_where_they_belong():
    # One wall 2 m ahead, seen on every ring: its points lie around the centre column, and nowhere else.
    points, intensity, ring = scan(lambda azimuth, elevation: np.full(azimuth.shape, 2.0))
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < math.radians(30)
    frame = CalibrationFrame(np.full((128, 256, 3), 90, np.uint8), points[ahead], intensity[ahead], ring[ahead])
    image = overlay(frame, np.eye(4), width=256)
    coloured = np.ptp(image.astype(int), axis=2) > 30
    columns = np.flatnonzero(coloured.any(axis=0))
    assert columns.min() == pytest.approx(128 - 30 / 360 * 256, abs=1.5)
    assert columns.max() == pytest.approx(127 + 30 / 360 * 256, abs=1.5)
    assert before_and_after([frame], np.eye(4), np.eye(4), width=256).shape[1:] == (256, 3)
