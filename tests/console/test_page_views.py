"""The page's views of a keyframe, read back from its canvas, against the CPU's renderer and the room itself."""

import math

import cv2
import numpy as np
import pytest
from console_pages import BROWSER_TEST
from page_renderer import PageRenderer

from instant_ic.console.layers import LayerMeshes, PageLayers
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.layers import encode
from tests import box_room

pytestmark = BROWSER_TEST
WIDTH, HEIGHT, FOV = 480, 270, math.pi / 2
KEYFRAME = pose_matrix(0.0, -0.3, 0.1, yaw=0.4)
STEPS = [(0, 0, 0), (1.0, 0.2, 0.1), (0.4, -0.5, -0.6)]  # ahead, left (m), turn (rad)


@pytest.fixture(scope="module")
def keyframe():
    """A keyframe of a room: its virtual space, and its layers for the page."""
    room = box_room.panorama(KEYFRAME, 512)
    space = VirtualSpace(VirtualSpaceConfig(source="warp", device="cpu"))
    space.set_keyframe(room.rgb, cv2.resize(room.depth_m, (512, 256), interpolation=cv2.INTER_NEAREST), KEYFRAME, 0.02)
    png = cv2.imencode(".png", room.rgb[..., ::-1])[1].tobytes()  # both sides have the same colours
    return space, PageLayers(1, (0.0, 0.0, 0.0), LayerMeshes().layers(encode(space.shown.newest, 1, png, 1)))


@pytest.mark.parametrize("full", [True, False])
def test_the_page_shows_what_the_cpu_renders(browser, keyframe, full):
    space, layers = keyframe
    page = PageRenderer(browser, WIDTH, HEIGHT, full)
    page.load(layers)
    for ahead, left, turn in STEPS:
        pose = KEYFRAME @ pose_matrix(ahead, left, yaw=turn)
        truth = box_room.perspective(pose, WIDTH, HEIGHT, FOV).rgb
        view, shown = space.render(pose, WIDTH, HEIGHT, FOV), page.render(pose, FOV)
        seen = view.confidence > 0
        assert psnr_db(shown[seen], truth[seen]) > psnr_db(view.rgb[seen], truth[seen]) - 0.3, (ahead, left, turn)
        assert np.abs(shown.astype(int) - view.rgb)[seen].mean() < 3


def test_the_rim_of_a_surface_is_straight():
    """A slab before a wall, seen from aside: its rim's vertices lie on one line, each row's on the next one's."""
    from instant_ic.console.layers import EDGE_RATIO
    from instant_ic.geometry.projections import equirect_directions
    from instant_ic.vspace.layer_mesh import layer_mesh
    from instant_ic.vspace.prior import edge_quads

    directions = equirect_directions(256, 128)
    slab = np.abs(np.arctan2(directions[..., 1], directions[..., 0])) < 0.4
    # The slab leans: on the plane x - y = 2. Behind it a sphere of 8 m.
    inverse = np.where(slab, (directions[..., 0] - directions[..., 1]) / 2, 1 / 8).astype(np.float32)
    inverse = np.maximum(inverse, np.float32(0.01))
    mesh = layer_mesh(inverse, edge_quads(inverse, EDGE_RATIO), np.ones_like(slab))
    row = (mesh.corners[:, 1] > 44) & (mesh.corners[:, 1] < 84)
    rim = row & (mesh.corners[:, 0] == np.flatnonzero(slab[64])[-1] + 1) & (mesh.inverse_depth > 0.2)
    azimuth = math.pi - mesh.corners[rim, 0] * (2 * math.pi / 256)
    elevation = math.pi / 2 - mesh.corners[rim, 1] * (math.pi / 128)
    on_plane = np.cos(elevation) * (np.cos(azimuth) - np.sin(azimuth)) / 2
    assert rim.sum() > 30
    assert mesh.inverse_depth[rim] == pytest.approx(on_plane, abs=0.002)  # half a pixel inwards it is 0.008 less
