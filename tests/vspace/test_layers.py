"""Layers: their messages carry the depth, content and colours of the keyframe."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from instant_ic.adapters.vspace import layers_message, layers_of
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import deserialize, serialize
from instant_ic.vspace import FieldConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.layers import Content, Kind, LayersError, decode_layer, encode
from nodes.nerf import NerfConfig, NerfNode
from tests import box_room
from tests.vspace.test_nerf_node import keyframe_message

WARP = VirtualSpaceConfig(source="warp", device="cpu")
ROBOT = np.zeros((64, 128), bool)
ROBOT[58:, 30:50] = True


def jpeg(rgb):
    return cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def seen_by_the_camera(x, height=256, sky=False):
    """Arguments of ``prepare`` and the camera's image: the room with noise of 1 % on its depth."""
    pose = pose_matrix(x, -0.3, 0.1, 0.02, 0.01, 0.3 * x)
    room = box_room.panorama(pose, height)
    image = jpeg(room.rgb)
    rgb = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].copy()
    depth = room.depth_m * np.random.default_rng(3).normal(1, 0.01, room.depth_m.shape)
    if sky:
        depth[: height // 5] = 0
        depth[height // 2 : height // 2 + 5, 40:60] = 0  # and a small hole
    return (rgb, depth.astype(np.float32), pose, 0.03), image


def space_and_layers(**options):
    """A space, its layers after transport over the bus, and the camera's image."""
    space = VirtualSpace(WARP, robot=ROBOT)
    keyframe, image = seen_by_the_camera(0.0, **options)
    space.set_keyframe(*keyframe)
    layers = encode(space.shown.newest, 1, image, 1)
    message = deserialize(serialize(layers_message(layers, 5)), "VspaceLayers")
    return space, layers_of(message), image


def test_depth_content_and_edges_survive():
    space, layers, image = space_and_layers(sky=True)
    assert [layer.kind for layer in layers.layers] == [Kind.SEEN, Kind.BEHIND]
    assert layers.layers[0].colour == image  # the camera's own, unchanged
    prior = space.keyframe
    seen, behind = (decode_layer(layer) for layer in layers.layers)
    np.testing.assert_allclose(seen.inverse_depth, prior.inverse_depth, atol=prior.inverse_depth.max() / 65535)
    assert (seen.content[0] == Content.SKY).all()
    assert (seen.content[-8:, 130:190] == Content.NOTHING).all()  # the robot
    assert (seen.content[130, 45:55] == Content.SURFACE).all()
    assert (seen.confidence[130, 45:55] == np.float32(8 / 15)).all()  # filled
    assert ((seen.confidence == 1) == (prior.known == 1)).all()
    warp = space.shown.newest.warp
    assert np.array_equal(seen.edge, warp.depth_edge[1:-1] > 0)
    background = space.shown.newest.background
    assert np.array_equal(np.argwhere(behind.content == Content.SURFACE), background.quads)
    assert len(background.quads) > 100
    assert psnr_db(behind.rgb, background.rgb) > 30


def test_a_code_by_hand():
    """Depths of 2 m and 4 m: 4 m has half the inverse depth of the nearest, code 32768 = 128 · 256."""
    rgb = box_room.panorama(np.eye(4), 32).rgb
    depth = np.full((32, 64), 2.0, np.float32)
    depth[:, 20:30] = 4.0
    space = VirtualSpace(WARP)
    space.set_keyframe(rgb, depth, np.eye(4), 0.02)
    layer = encode(space.shown.newest, 7, None, 1).layers[0]
    assert (layer.keyframe_id, layer.near_m) == (7, 2.0)
    blue, green, red = cv2.imdecode(np.frombuffer(layer.geometry_png, np.uint8), cv2.IMREAD_UNCHANGED)[16, 25]
    assert (red, green, blue) == (128, 0, Content.SURFACE + 15 * 8)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"colour": b"no image"}, "colour cannot be decoded"),
        ({"geometry_png": cv2.imencode(".png", np.ones((8, 8, 3), np.uint8))[1].tobytes()}, "twice as wide as high"),
        ({"geometry_png": cv2.imencode(".png", np.zeros((8, 16, 3), np.uint8))[1].tobytes()}, "without depth"),
        ({"near_m": math.nan}, "near_m must be > 0"),
    ],
)
def test_damaged_layers_are_refused(changes, words):
    _, layers, _ = space_and_layers(height=32)
    damaged = dataclasses.replace(layers, layers=(dataclasses.replace(layers.layers[0], **changes),))
    with pytest.raises(LayersError, match=f"SEEN of keyframe 1: .*{words}"):
        decode_layer(damaged.layers[0])


@pytest.mark.parametrize("source", ["warp", "field"])
def test_the_node_publishes_them_once_a_keyframe(source):
    config = NerfConfig(space=VirtualSpaceConfig(source=source, device="cpu", field=FieldConfig(log2_table=10)))
    with LockstepBus(start_ns=10_000_000_000) as bus:
        bus.add(NerfNode, config)
        for number in (4, 5):
            bus.publish("/keyframe", keyframe_message(number), latched=True)
        found = bus.messages("/vspace/layers")
        assert [[layer.keyframe_id for layer in message.layers] for message in found] == [[4, 4], [5, 5]]
        assert [message.version for message in found] == [1, 2]
        assert found[0].layers[0].colour.data.tobytes() == keyframe_message(4).panorama.data.tobytes()
        bus.advance(1.0)
        assert len(bus.messages("/vspace/layers")) == 2
        assert bus.last("/vspace/status").keyframe_id == 5
