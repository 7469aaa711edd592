"""The node in lockstep: keyframe in, status and views out, bad keyframes refused."""

import dataclasses

import cv2
import numpy as np
import pytest

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    Keyframe,
    ViewRequest,
    compressed_image_message,
    header,
    image_message,
    pose_message,
)
from instant_ic.vspace import FieldConfig, TrainConfig, VirtualSpaceConfig
from instant_ic.vspace.prior import load_robot_mask
from instant_ic.vspace.worker import IncomingKeyframe, SpaceWorker, Turns, ViewOrder
from nodes.nerf import NerfConfig, NerfNode
from tests import box_room

EMPTY, TRAINING, READY = 0, 1, 2
S = 1_000_000_000
SPACE = VirtualSpaceConfig(
    device="cpu",
    field=FieldConfig(log2_table=14),
    train=TrainConfig(ray_columns=64, ray_rows=32, iterations=60),
)
CAMERA = pose_matrix(x=0.5, y=-0.2, yaw=0.4)


def keyframe_message(number=1, fit=True, depth=None, panorama=None, sigma=0.03):
    picture = box_room.panorama(CAMERA, 128)
    if panorama is None:
        panorama = cv2.imencode(".jpg", picture.rgb[..., ::-1])[1].tobytes()
    return Keyframe(
        header=header("map", 7 * S),
        id=number,
        pose=pose_message(CAMERA),
        panorama=compressed_image_message(panorama, "camera", 7 * S),
        depth=image_message(picture.depth_m if depth is None else depth, "32FC1", "camera", 7 * S),
        sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", 7 * S),
        source="network",
        scale=1.0,
        quality=0.9,
        relative_sigma=sigma,
        fit=fit,
        message="" if fit else "no LiDAR",
    )


def request_message(number, width=160, height=90, fov=1.57, pose=CAMERA):
    return ViewRequest(
        header=header("map", 0), id=number, pose=pose_message(pose), fov_rad=fov, width=width, height=height
    )


@pytest.fixture
def bus():
    with LockstepBus(start_ns=10 * S) as bus:
        bus.node = bus.add(NerfNode, NerfConfig(space=SPACE))
        yield bus


def diagnosis(bus, name):
    return bus.node.diagnoses()[name]


def test_empty_until_a_keyframe_comes(bus):
    bus.advance(1.0)
    status = bus.last("/vspace/status")
    assert status.state == EMPTY
    assert "keyframe" in status.message
    bus.publish("/view/request", request_message(1))
    assert bus.messages("/vspace/view") == []
    assert diagnosis(bus, "view")[0] == 1


def test_trains_draws_and_comes_to_rest(bus):
    bus.publish("/keyframe", keyframe_message(number=4), latched=True)
    assert bus.last("/vspace/status").state == TRAINING
    bus.advance(0.55)  # status at 0.5 s, before the tick of that time: four ticks of five iterations
    early = bus.last("/vspace/status")
    assert early.keyframe_id == 4
    assert early.iterations == 20
    bus.advance(3.0)
    status = bus.last("/vspace/status")
    assert status.state == READY
    assert status.iterations == 60
    assert "idle" in status.message
    assert 0 < status.ready_seconds <= 1.5
    assert status.ready_radius_m > 0.5
    assert status.keyframe_pose.position.x == pytest.approx(0.5)
    assert status.keyframe_stamp.sec == 7

    bus.publish("/view/request", request_message(11))
    bus.publish("/view/request", request_message(12, pose=pose_matrix(x=1.0, y=-0.2, yaw=0.4)))
    views = bus.messages("/vspace/view")
    assert [v.request_id for v in views] == [11, 12]
    assert (views[0].width, views[0].height, views[0].keyframe_id) == (160, 90, 4)
    assert views[0].confidence > 0.9
    picture = cv2.imdecode(views[0].image.data, cv2.IMREAD_COLOR)[..., ::-1]
    truth = box_room.perspective(CAMERA, 160, 90, 1.57).rgb
    assert psnr_db(picture, truth) > 20  # a flat grey of the right mean scores about 15
    assert len(bus.messages("/vspace/image/compressed")) == 2


def test_a_view_is_rendered_again_only_when_it_would_differ():
    with LockstepBus(start_ns=10 * S) as bus:
        node = bus.add(NerfNode, NerfConfig(space=dataclasses.replace(SPACE, source="warp")))
        bus.publish("/keyframe", keyframe_message(number=4), latched=True)
        space, rendered = node.worker.space, []
        whole = space.render
        space.render = lambda *args: rendered.append(args) or whole(*args)

        def renders(request):
            rendered.clear()
            bus.publish("/view/request", request)
            assert bus.last("/vspace/view").request_id == request.id  # the page waits for an answer to each
            return len(rendered)

        beside = CAMERA @ pose_matrix(y=0.001)
        assert [renders(request_message(number)) for number in (1, 2)] == [1, 0]
        assert renders(request_message(3, pose=beside)) == 0
        assert bus.last("/vspace/view").pose == pose_message(CAMERA)  # where it was rendered
        assert renders(request_message(4, pose=CAMERA @ pose_matrix(y=0.004))) == 1
        assert renders(request_message(5, pose=CAMERA @ pose_matrix(y=0.004), fov=1.4)) == 1
        bus.publish("/keyframe", keyframe_message(number=5), latched=True)
        numbers = range(6, 6 + SPACE.view.refresh_views + 2)
        # Rendered until the keyframe before has dissolved into the new one, once more, and then no more.
        counts = [renders(request_message(number, pose=beside)) for number in numbers]
        assert counts == [1] * SPACE.view.refresh_views + [0, 0], counts


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (keyframe_message(2, fit=False), "no LiDAR"),
        (keyframe_message(2, depth=np.zeros((128, 256), np.float32)), "known in 0%"),
        (keyframe_message(2, panorama=b"\xff\xd8 this is no picture"), "cannot be decoded"),
    ],
    ids=["unfit", "empty-depth", "bad-jpeg"],
)
def test_a_bad_keyframe_is_refused_and_the_old_space_stays(bus, message, words):
    bus.publish("/keyframe", keyframe_message(1), latched=True)
    bus.advance(2.0)
    bus.publish("/keyframe", message, latched=True)
    level, text, _ = diagnosis(bus, "keyframe")
    assert level == 2
    assert words in text
    bus.advance(0.6)
    status = bus.last("/vspace/status")
    assert status.keyframe_id == 1
    assert status.iterations > 10
    bus.publish("/view/request", request_message(5))
    assert bus.last("/vspace/view").keyframe_id == 1


def test_a_gpu_without_memory_is_told_and_the_next_keyframe_recovers(bus):
    import torch

    bus.publish("/keyframe", keyframe_message(1), latched=True)
    bus.advance(0.3)
    node = next(n for n in bus.nodes if isinstance(n, NerfNode))
    device = node.worker.space.device
    whole = device.step

    def no_memory(*args):
        raise torch.OutOfMemoryError("CUDA out of memory")

    device.step = no_memory  # "cpu" was asked for: as with "cuda", there is no other device to turn to
    bus.advance(0.6)
    status = bus.last("/vspace/status")
    assert status.state == 3
    assert "out of memory" in status.message
    assert diagnosis(bus, "vspace")[0] == 2
    device.step = whole
    bus.publish("/keyframe", keyframe_message(2), latched=True)
    bus.advance(2.0)
    assert bus.last("/vspace/status").state == READY


def test_of_waiting_keyframes_and_views_the_newest_is_taken():
    jobs = []
    worker = SpaceWorker(SPACE, Turns(10, 50), lambda: 0, lockstep=True)
    worker.submit, worker.diagnose = jobs.append, lambda *args, **values: None
    worker.start()
    for number in (1, 2, 3):
        worker.offer_keyframe(IncomingKeyframe(number, None, 0, tuple))
        worker.request_view(ViewOrder(number, None, tuple, 64, 36, 1.0, 90))
    worker.take(worker.run(jobs.pop()))  # the warm-up has ended
    worker.next()
    view = jobs.pop()
    assert (view.name, view.number) == ("view", 3)
    worker.take(worker.run(view))  # fails: no keyframe
    worker.next()
    assert [(job.name, job.number) for job in jobs] == [("keyframe", 3)]


def test_a_pose_far_off_is_drawn_without_confidence_and_told(bus):
    bus.publish("/keyframe", keyframe_message(1), latched=True)
    bus.publish("/view/request", request_message(1))
    bus.advance(0.6)
    near = bus.last("/vspace/status")
    assert near.unseen_share < 0.05
    assert near.expected_psnr_db > 20
    bus.publish("/view/request", request_message(2, pose=pose_matrix(x=300.0, yaw=2.0)))
    level, words, _ = diagnosis(bus, "view")
    assert (level, "far away" in words) == (1, True)
    view = bus.last("/vspace/view")
    assert (view.request_id, view.confidence) == (2, 0)
    bus.advance(0.6)
    far = bus.last("/vspace/status")
    assert far.unseen_share == 1
    assert far.expected_psnr_db < near.expected_psnr_db - 5
    bus.publish("/view/request", request_message(3))
    assert diagnosis(bus, "view")[0] == 0


def test_the_robots_mask(tmp_path):
    mask = np.zeros((32, 64), np.uint8)
    mask[20:, 10:20] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    with LockstepBus(start_ns=10 * S) as bus:
        node = bus.add(NerfNode, NerfConfig(space=SPACE, robot_mask=str(tmp_path / "mask.png")))
        bus.publish("/keyframe", keyframe_message(1), latched=True)
        assert node.worker.space.keyframe.usable.mean() == pytest.approx(1 - 12 * 10 / (32 * 64))
    for content, words in ((None, "no such file"), (np.zeros((32, 32), np.uint8), "twice as wide")):
        path = tmp_path / "bad.png"
        if content is not None:
            cv2.imwrite(str(path), content)
        with pytest.raises(ValueError, match=words):
            load_robot_mask(str(path))


@pytest.mark.parametrize(
    "request_",
    [
        request_message(3, 4000, 4000),
        request_message(3, fov=3.5),
        request_message(3, 4, 4),
        request_message(3, pose=np.diag([1.0, 1, 1, 1]) + np.array([[0, 0, 0, np.nan]] + [[0] * 4] * 3)),
    ],
)
def test_a_request_that_cannot_be_drawn_is_told(bus, request_):
    bus.publish("/keyframe", keyframe_message(1), latched=True)
    bus.publish("/view/request", request_)
    assert bus.messages("/vspace/view") == []
    assert diagnosis(bus, "view")[0] == 1
    bus.publish("/view/request", request_message(4))
    assert bus.last("/vspace/view").request_id == 4
