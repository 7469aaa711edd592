"""The virtual space rendered by the page itself, from layers, in Debian's Chromium."""

import math

import cv2
import numpy as np
import pytest
from console_pages import BROWSER_TEST, WAIT_MS, expect_body, likeness_of, make_demo, picture_of, room_seen, wait_until

from instant_ic.console import FrameKind
from instant_ic.geometry.poses import quaternion_from_matrix

pytestmark = BROWSER_TEST
KEYFRAME = np.array([1.6, 0.2, 0.3])  # a box is 1.4 m ahead
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
    for pose in (tuple(KEYFRAME), (1.9, 0.2, 0.1), (1.5, -0.2, 0.6), (1.4, 0.5, -0.5), (1.6, 0.2, 3.0)):
        demo.place(*pose)
        wait_place(page, *pose)
        picture, expected = picture_of(page), room_seen(pose, 0.0, demo.look.pitch)
        found.append((likeness_of(picture, expected), psnr_db(picture, expected)))
    assert min(alike for alike, _ in found) > 0.97
    assert found[0][1] > 30  # where the keyframe is
    drawn = demo.server.drawn_ms()
    assert drawn is not None
    wait_until(lambda: demo.server.drawn_ms() > drawn, page, "reports of what is shown")


# The second with the camera's image by its depth. A frame is no more than 0.2 s of the dissolve.
@pytest.mark.parametrize("query", ["", "?quality=full"])
def test_the_dissolve_mixes_two_views_of_the_same_place(open_page, room, query):
    demo = room
    demo.place(*KEYFRAME)
    demo.forced_mode = "real"
    demo.server.pages.page |= SLOW_DISSOLVE | {"dissolve_ms": 4_000}
    try:
        page = open_layers(open_page, demo, query)
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


def test_a_bad_frame_of_layers_is_refused_and_the_ones_before_stay(open_page, room):
    demo = room
    demo.place(*KEYFRAME)
    page = open_layers(open_page, demo)
    wait_until(lambda: not demo.server.needs_views(), page, "the layers")
    expect_body(page, "blend", "1.00")
    demo.server.send_frame(FrameKind.LAYERS, {"version": 1, "layers": "none"}, b"")
    wait_until(lambda: page.faults, page, "the refusal")
    assert "layers.mount must be" in page.faults[0]
    page.faults.clear()
    demo.place(1.9, 0.2, 0.1)
    wait_place(page, 1.9, 0.2, 0.1)
    demo.send_layers(np.array([1.7, 0.2, 0.0]))
    version = demo.version
    wait_until(
        lambda: any(s.drawn and s.drawn[0] == version for s in demo.server.pages.sessions.values()), page, "the next"
    )
    # A page that lost its link on a busy machine got the bad frame twice.
    page.faults[:] = [fault for fault in page.faults if "layers.mount must be" not in fault]


def test_the_cameras_image_is_shown_from_where_the_robot_is_now_until_a_key_switches_it_off(open_page, room):
    demo = room
    demo.forced_mode, demo.images = "real", True
    there = (1.9, 0.2, 0.3)
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


# The robot drives at 0.3 m/s. Images come each 0.2 s, 0.1 s old; from 1 s on it is in ENTERING, from 2 s on in VIRTUAL,
# where the v-bot starts 3 cm back: where the shown image was taken. From 3 s on no image comes.
GLIDE = """async () => {
    const {Images} = await import("/static/images.js");
    let now = 0;
    const viewer = {slow: false, lost: false, sample() {}};
    const images = new Images(viewer, {serverNow: () => now, roundTripMs: 0, connected: true, acknowledge() {}});
    images.layers = {version: 1, mount: [0.1, 0, 1.2]};
    images.colourReleaseMs = 0;
    const frames = [], at = (ms) => 0.0003 * ms, q = [0, 0, 0, 1];
    for (; now < 5000; now += 10) {
        if (now % 200 === 0 && now < 3000)
            images.panorama = {q, p: [0.1 + at(now - 100), 0, 1.2], captured_ms: now - 100};
        const mode = now < 1000 ? "real" : now < 2000 ? "entering" : "virtual", shown = now < 2000 ? "real" : "virtual";
        const robot = [at(now), 0, 0], vbot = [at(now) - 0.03, 0, 0];
        const state = {at_ms: now, mode, shown, robot, vbot, twist: [0.3, 0]};
        const {glide, camera, blend} = images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 10);
        frames.push([glide ? glide.to[0] : NaN, camera.position[0], blend]);
    }
    return frames.map((frame) => frame.map((value) => Number.isNaN(value) ? -1 : value));
}"""


def test_the_shown_place_goes_steadily_also_through_a_switch_and_an_old_image_stays(open_page, room):
    frames = np.array(open_layers(open_page, room).evaluate(GLIDE))
    steady = frames[40:200, 0]
    assert steady == pytest.approx(0.1 + 0.003 * np.arange(40, 200), abs=0.001)  # 10 ms at 0.3 m/s, no steps of 6 cm
    mixed = frames[(frames[:, 2] > 0) & (frames[:, 2] < 1)]
    assert len(mixed) > 10
    assert mixed[:, 0] == pytest.approx(mixed[:, 1])  # both from one place
    steps = np.diff(frames[190:260, 1])
    assert steps.min() > 0.001 and steps.max() < 0.0035  # the 3 cm go within 0.4 s
    assert frames[260, 1] == pytest.approx(0.1 + 0.003 * 260 - 0.03, abs=0.001)
    assert (frames[410:, 0] == -1).all()  # the last image is more than 1 s old


# A v-bot at rest; the last state is 20 ms old when the operator's key goes down, and no other one comes.
KEY = """async () => {
    const {Images} = await import("/static/images.js");
    let now = 1000;
    const images = new Images({slow: true, sample() {}}, {serverNow: () => now, roundTripMs: 10, connected: true,
        acknowledge() {}});
    images.layers = {version: 1, mount: [0.1, 0, 1.2]};
    images.prediction.maxAccel = [0.8, 2];
    const pose = [1, 2, 0], twist = [0, 0];
    const state = {at_ms: 1000, mode: "virtual", shown: "virtual", robot: pose, vbot: pose, twist};
    const seen = () => images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 10);
    const places = [];
    for (; now < 1600; now += 10) {
        if (now === 1020) images.prediction.command([0.4, 0], now);
        places.push(seen().camera.position[0]);
    }
    return places;
}"""


def test_a_key_moves_the_view_before_a_new_state_arrives(open_page, room):
    page = open_layers(open_page, room)
    places = page.evaluate(KEY)
    assert places[:3] == pytest.approx([1.1] * 3)  # at rest, the mount ahead of the robot
    # From 1020 ms on with 0.8 m/s²: after t seconds 0.4 t² m, shown with the page's smoothing of 50 ms.
    assert places[4] > places[2]
    assert places[17] == pytest.approx(1.1 + 0.4 * 0.15**2, abs=0.002)
    # A state that is too old carries on no longer: no more than 250 ms after it.
    assert places[-1] == pytest.approx(1.1 + 0.4 * 0.23**2, abs=0.002)


# The robots are 7 cm apart at the switch back, as the camera's image is older than the pose, and drive at 0.3 m/s.
BACK = """async () => {
    const {Images} = await import("/static/images.js");
    let now = 0;
    const images = new Images({slow: true, sample() {}}, {serverNow: () => now, roundTripMs: 10, connected: true,
        acknowledge() {}});
    images.layers = {version: 1, mount: [0.1, 0, 1.2]};
    images.colourReleaseMs = 0;
    images.panorama = {q: [0, 0, 0, 1], captured_ms: 0};
    const places = [];
    for (; now < 2000; now += 10) {
        const back = now >= 1500, robot = [0.0003 * now + 0.07, 0, 0], vbot = [0.0003 * now, 0, 0];
        const [mode, shown] = back ? ["real", "real"] : ["returning", "virtual"];
        images.panorama.captured_ms = now;
        const state = {at_ms: now, mode, shown, robot, vbot, twist: [0.3, 0]};
        const {camera, blend} = images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 10);
        places.push([camera.position[0], blend]);
    }
    return places;
}"""


def test_on_the_way_back_the_view_goes_on_from_where_the_vbot_was(open_page, room):
    places = np.array(open_layers(open_page, room).evaluate(BACK))
    steps = np.diff(places[100:, 0])
    assert steps == pytest.approx(0.003, abs=0.0035)  # 10 ms at 0.3 m/s; one frame may stand still
    assert places[170, 0] == pytest.approx(0.1 + 0.0003 * 1700, abs=0.01)  # if it stood still 0.55
    assert places[140, 1] == 1
    assert 0 < places[160, 1] < 1
    assert places[190, 1] == 0
