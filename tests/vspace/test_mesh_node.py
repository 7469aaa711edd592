"""The node with ``space.source: mesh`` in lockstep: ready at once, views, what a keyframe tells, a missing file."""

import contextlib

import cv2
import numpy as np
import pytest

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import Keyframe, ViewRequest, compressed_image_message, header, image_message, pose_message
from instant_ic.vspace import VirtualSpaceConfig
from nodes.nerf import NerfConfig, NerfNode

trimesh = pytest.importorskip("trimesh")
READY, FAILED = 2, 3
S = 1_000_000_000
ROOM_M = 2.0


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    """A cube of 4 m seen from inside, each wall of one colour."""
    mesh = trimesh.creation.box((2 * ROOM_M,) * 3)
    colours = np.full((12, 4), 255, np.uint8)
    colours[:, :3] = 60 + 80 * (np.argmax(np.abs(mesh.face_normals), axis=1)[:, None] == np.arange(3))
    mesh.visual.face_colors = colours
    path = tmp_path_factory.mktemp("r") / "cube.ply"
    mesh.export(path)
    return path


@contextlib.contextmanager
def started(path):
    space = VirtualSpaceConfig(source="mesh", mesh=str(path), mesh_pose=(1.0, 0.0, 0.0, 0.0))
    with LockstepBus(start_ns=10 * S) as bus:
        bus.node = bus.add(NerfNode, NerfConfig(space=space))
        bus.advance(1.0)
        yield bus


def keyframe(depth_factor=1.0):
    """What a camera in the middle of the cube sees, darker than it was scanned."""
    from instant_ic.geometry.projections import equirect_directions

    directions = equirect_directions(64, 32)
    axis = np.argmax(np.abs(directions), axis=-1)
    rgb = (30 + 40 * (axis[..., None] == np.arange(3))).astype(np.uint8)
    depth = depth_factor * ROOM_M / np.abs(directions).max(axis=-1)
    jpeg = cv2.imencode(".png", rgb[..., ::-1])[1].tobytes()
    return Keyframe(
        header=header("map", 7 * S),
        id=5,
        pose=pose_message(pose_matrix(1.0)),
        panorama=compressed_image_message(jpeg, "camera", 7 * S),
        depth=image_message(depth.astype(np.float32), "32FC1", "camera", 7 * S),
        sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", 7 * S),
        source="network",
        scale=1.0,
        relative_sigma=0.03,
        quality=1.0,
        fit=True,
        message="",
    )


def request(number, x):
    return ViewRequest(
        header=header("map", 11 * S), id=number, pose=pose_message(pose_matrix(x)), fov_rad=1.2, width=64, height=36
    )


def test_a_drive_through_the_mesh(cube):
    with started(cube) as bus:
        status = bus.last("/vspace/status")
        assert status.state == READY
        assert status.keyframe_id == 0
        assert status.ready_radius_m == pytest.approx(4 * 3**0.5, rel=1e-5)
        assert "cube.ply" in status.message
        # Driven through: wall ahead at x = 3, then beyond it.
        for number, x in enumerate((1.0, 1.5, 2.0, 2.5), 1):
            bus.publish("/view/request", request(number, x))
            bus.advance(0.2)
        views = bus.messages("/vspace/view")
        assert [view.request_id for view in views] == [1, 2, 3, 4]
        picture = cv2.imdecode(np.asarray(views[0].image.data), cv2.IMREAD_COLOR)[..., ::-1].astype(float)
        assert picture[18, 32] == pytest.approx([140, 60, 60], abs=6)  # the wall ahead is that of x
        assert all(view.confidence == 1 and view.keyframe_id == 0 for view in views)
        assert bus.last("/vspace/status").expected_psnr_db == 0  # unknown before a keyframe
        bus.publish("/view/request", request(5, 9.0))  # outside, looking away
        bus.advance(1.0)
        assert bus.last("/vspace/view").confidence == 0
        assert bus.last("/vspace/status").unseen_share == 1


def test_a_keyframe_fits_the_colours_and_tells_a_wrong_place(cube):
    with started(cube) as bus:
        bus.publish("/keyframe", keyframe())
        bus.publish("/view/request", request(1, 1.0))
        bus.advance(1.0)
        view = bus.last("/vspace/view")
        picture = cv2.imdecode(np.asarray(view.image.data), cv2.IMREAD_COLOR)[..., ::-1].astype(float)
        assert picture[18, 32] == pytest.approx([70, 30, 30], abs=6)
        status = bus.last("/vspace/status")
        assert status.keyframe_id == 5
        assert status.expected_psnr_db > 25
        assert "device" not in bus.node.diagnoses()
        bus.publish("/keyframe", keyframe(depth_factor=2.0))
        bus.advance(1.0)
        assert "mesh_pose" in bus.node.worker.status.warning
        assert bus.node.diagnoses()["device"][0] == 1


def test_a_mesh_that_is_not_there_is_told(tmp_path):
    with started(tmp_path / "none.glb") as bus:
        status = bus.last("/vspace/status")
        assert status.state == FAILED
        assert "none.glb: no such file" in status.message
        bus.publish("/view/request", request(1, 0.0))
        bus.advance(0.5)
        assert not bus.messages("/vspace/view")
