"""The virtual space rendered by the page itself, from layers, in Debian's Chromium."""

import math

import cv2
import numpy as np
import pytest
from console_pages import BROWSER_TEST, WAIT_MS, expect_body, likeness_of, make_demo, picture_of, room_seen, wait_until

from instant_ic.console import FrameKind
from instant_ic.geometry.poses import quaternion_from_matrix

pytestmark = BROWSER_TEST
KEYFRAME = np.array([0.2, -0.3, 0.3])  # a box is 1.5 m ahead
DRAWN = """
    window.drawn = [];
    addEventListener("rendered", ({detail: {place, pose, blend}}) => drawn.push({place, pose, blend}));
"""
SLOW_DISSOLVE = {"colour_release_s": 0, "ease_ms": 0}


@pytest.fixture(scope="module")
def room():
    demo = make_demo(panorama_width=640)
    demo.forced_mode = "virtual"
    demo.send_layers(KEYFRAME)
    yield demo
    demo.stop()


def open_layers(open_page, demo, query=""):
    page = open_page(query, at=demo, bypass_csp=True)
    page.evaluate(DRAWN)
    page.add_style_tag(content="#view { filter: none !important }")  # old pictures turn grey
    return page


def wait_place(page, x, y, yaw):
    """Until the page shows the view from there, which it reaches within its smoothing."""
    arrived = """([x, y, yaw]) => {
        const at = drawn.at(-1);
        return at?.place && Math.hypot(at.place[0] - x, at.place[1] - y) < 0.002 && Math.abs(at.pose[2] - yaw) < 0.002;
    }"""
    page.wait_for_function(arrived, arg=[x, y, yaw], timeout=WAIT_MS)
    page.wait_for_timeout(200)


def psnr_db(picture, expected):
    shown = cv2.resize(picture, expected.shape[1::-1], interpolation=cv2.INTER_AREA)
    return 10 * math.log10(255**2 / np.mean((cv2.blur(shown, (3, 3)) - cv2.blur(expected, (3, 3))) ** 2))


def test_the_view_is_the_room_seen_from_the_vbot_and_no_view_is_requested(open_page, room):
    demo = room
    demo.place(*KEYFRAME)
    page = open_layers(open_page, demo)
    expect_body(page, "blend", "1.00")
    wait_until(lambda: not demo.server.needs_views(), page, "the page renders by itself")
    found = []
    for pose in (tuple(KEYFRAME), (0.5, -0.3, 0.1), (0.0, 0.0, -0.5)):
        demo.place(*pose)
        wait_place(page, *pose)
        picture, expected = picture_of(page), room_seen(pose, 0.0, demo.look.pitch)
        found.append((likeness_of(picture, expected), psnr_db(picture, expected)))
    assert min(alike for alike, _ in found) > 0.97
    assert found[0][1] > 30  # where the keyframe is
    drawn = demo.server.drawn_ms()
    assert drawn is not None
    wait_until(lambda: demo.server.drawn_ms() > drawn, page, "reports of what is shown")


# A frame is no more than 0.2 s of the dissolve.
def test_the_dissolve_mixes_two_views_of_the_same_place(open_page, room):
    demo = room
    demo.place(*KEYFRAME)
    demo.forced_mode = "real"
    demo.server.pages.page |= SLOW_DISSOLVE | {"dissolve_ms": 4_000}
    try:
        page = open_layers(open_page, demo)
        wait_until(lambda: not demo.server.needs_views(), page, "the layers")
        expect_body(page, "image", "live")
        demo.forced_mode = "virtual"
        # That frame stays: a slow machine would end the dissolve before the picture is taken.
        page.evaluate("""addEventListener("rendered", ({detail: {blend}}) => {
            if (blend > 0.3) requestAnimationFrame = () => { window.held = true; };
        })""")
        page.wait_for_function("window.held", timeout=4 * WAIT_MS)  # a dozen slow frames
        picture, expected = picture_of(page), room_seen(tuple(KEYFRAME), 0.0, demo.look.pitch)
        assert page.evaluate("drawn.at(-1).blend") < 0.9
        assert likeness_of(picture, expected) > 0.97
        edge = np.abs(cv2.resize(picture, expected.shape[1::-1], interpolation=cv2.INTER_AREA) - expected)
        assert edge[:3].mean() < 3 * edge.mean()  # no frame round the image
        assert edge[:, :3].mean() < 3 * edge.mean()
    finally:
        demo.forced_mode = "virtual"
        demo.server.pages.page |= {"dissolve_ms": 250, "colour_release_s": 6, "ease_ms": 400}


def test_the_cameras_image_is_shown_from_where_the_robot_is_now_until_a_key_switches_it_off(open_page, room):
    demo = room
    demo.forced_mode, demo.images = "real", True
    there = (0.5, -0.3, 0.3)
    try:
        demo.place(*KEYFRAME)
        page = open_layers(open_page, demo, "?quality=full")  # on the CPU it is off at first
        wait_until(lambda: not demo.server.needs_views(), page, "the layers")
        expect_body(page, "image", "live")
        wait_until(lambda: np.allclose(demo.panorama_camera[:2, 3], KEYFRAME[:2]), page, "an image from there")
        demo.images = False
        image, camera = demo.panorama, demo.panorama_camera
        room_there = room_seen(there, 0.0, demo.look.pitch)
        demo.place(*there)
        header = {
            "q": quaternion_from_matrix(camera).tolist(),
            "p": camera[:3, 3].tolist(),
        }

        def shown_db():
            """PSNR of an image as if it had just been taken at the keyframe's place."""
            now_ms = demo.server.now_ms()
            demo.server.send_frame(FrameKind.PANORAMA, {"captured_ms": now_ms} | header, image)
            page.wait_for_timeout(100)
            return psnr_db(picture_of(page), room_there)

        wait_until(lambda: shown_db() > 30, page, "the image by its depth")
        page.keyboard.press("v")
        wait_until(lambda: shown_db() < 25, page, "the image as it was taken")
        at_keyframe = room_seen(tuple(KEYFRAME), 0.0, demo.look.pitch)
        assert psnr_db(picture_of(page), at_keyframe) > 30
    finally:
        demo.forced_mode, demo.images = "virtual", True
