"""Rendered views shown from where the v-bot is now, by their depth, in Debian's Chromium."""

import math

import cv2
import numpy as np
import pytest
from console_pages import BROWSER_TEST, WAIT_MS, expect_body, make_demo, picture_of, room_seen, wait_until

pytestmark = BROWSER_TEST
DRAWN = """
    window.drawn = [];
    addEventListener("rendered", ({detail: {place, view, blend}}) => drawn.push({place, view, blend}));
"""
A = (2.0, 0.0)  # a box with its edges 1 m ahead
B = (2.1, 0.04)  # 10 cm ahead, 4 cm to the left


@pytest.fixture(scope="module")
def room():
    demo = make_demo(view_width=320)
    yield demo
    demo.stop()


def psnr_db(picture, expected):
    """Of pictures softened to one sharpness: the room is drawn with one ray a pixel."""
    shown = cv2.resize(picture, expected.shape[1::-1], interpolation=cv2.INTER_AREA)
    return 10 * math.log10(255**2 / np.mean((cv2.blur(shown, (3, 3)) - cv2.blur(expected, (3, 3))) ** 2))


def place(page, demo, to):
    """Puts the v-bot somewhere, and waits until the page shows its view from there or stays where the view is from."""
    demo.place(*to, 0.0)
    arrived = "([x, y]) => drawn.length && Math.hypot(drawn.at(-1).place[0] - x, drawn.at(-1).place[1] - y) < 0.002"
    page.wait_for_function(arrived, arg=list(to), timeout=WAIT_MS)
    page.wait_for_timeout(100)


def open_virtual(open_page, demo, viewer):
    """A page that shows the view from ``A``, and gets no other one any more."""
    demo.forced_mode, demo.images, demo.depth = "virtual", True, None
    page = open_page(f"?viewer={viewer}", at=demo, bypass_csp=True)
    page.evaluate(DRAWN)
    page.add_style_tag(content="#view { filter: none !important }")  # old pictures turn grey
    expect_body(page, "blend", "1.00")
    still_at(page, demo, A)
    return page


def still_at(page, demo, at):
    """Until the newest view is from there, in the page's own direction (10° down), and is shown from there."""
    demo.images = True
    place(page, demo, at)
    seen = "([x, y]) => Math.hypot(drawn.at(-1).view.p[0] - x, drawn.at(-1).view.p[1] - y) < 0.002"
    page.wait_for_function(f"(at) => ({seen})(at) && drawn.at(-1).view.q[1] > 0.08", arg=list(at), timeout=WAIT_MS)
    wait_until(lambda: demo.lead.share == 1.0, page, "the switch")
    demo.images = False
    page.wait_for_timeout(400)  # one that was on its way


@pytest.mark.parametrize(("viewer", "gain_db"), [("webgl", 9.0), ("canvas", 1.0)])
def test_a_view_drawn_at_one_place_is_shown_from_the_vbots_place_now(open_page, room, viewer, gain_db):
    demo = room
    page = open_virtual(open_page, demo, viewer)
    before = picture_of(page)
    assert psnr_db(before, room_seen((*A, 0.0), 0.0, demo.look.pitch)) > 35
    place(page, demo, B)
    there = room_seen((*B, 0.0), 0.0, demo.look.pitch)
    unmoved = psnr_db(before, there)  # about 23 dB; moved by its depth 37 dB, by one depth for all of it 26 dB
    assert psnr_db(picture_of(page), there) > unmoved + gain_db
    assert page.evaluate("drawn.at(-1).view.p[0]") == pytest.approx(A[0], abs=1e-3)  # and no new view came
    if viewer == "canvas":
        return
    # A depth that cannot be read: the view stays as it was drawn, and nothing else is wrong.
    demo.depth = b"no picture"
    page.evaluate("drawn.length = 0")
    still_at(page, demo, B)
    flat = picture_of(page)
    assert psnr_db(flat, there) > 35
    demo.place(*A, 0.0)
    page.wait_for_timeout(600)  # twelve messages of state
    assert page.evaluate("drawn.at(-1).place") == pytest.approx(B, abs=1e-3)
    assert np.abs(picture_of(page) - flat).mean() < 1


# A v-bot at 0.3 m/s, from which the page hears 20 times a second; each tenth of a second a view, 0.15 s old. The switch
# is at 1 s, from 3 s on the robots are about to be the same again, and at 4.5 s the camera is shown: by then the newest
# picture, 0.15 s old, is of the same place as the view.
DRIVE = """async () => {
    const {Images} = await import("/static/images.js");
    const viewer = {name: "none", setView() {}, setPanorama() {}, sample() {}}, frames = [];
    let now = 0, state = null;
    const images = new Images(viewer, {serverNow: () => now, acknowledge() {}});
    images.colourReleaseMs = 0;
    images.leadMaxM = 0.3;
    const at = (ms) => 0.0003 * Math.max(ms, 0), q = [0, 0, 0, 1], lead = (ms) => Math.min(Math.max(ms / 800, 0), 1);
    for (; now < 5000; now += 10) {
        const mode = now < 1000 || now >= 4500 ? "real" : now < 3000 ? "virtual" : "returning";
        const shown = mode === "real" ? "real" : "virtual";
        if (now % 50 === 0) {
            const pose = [at(now), 0, 0], share = now < 3000 ? lead(now - 1000) : 1 - lead(now - 3000);
            state = {at_ms: now, mode, shown, robot: pose, vbot: pose, twist: [0.3, 0], lead: share};
        }
        if (now % 100 === 0)
            images.view = {p: [at(now - 150), 0, 1.2], q, mount: [0, 0, 1.2], fov: 1.5, aspect: 1.6, hasDepth: true,
                captured_ms: now};
        images.panorama = {q, captured_ms: now - 150};
        const {moved, blend} = images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 10);
        frames.push({now, mode, vbot: at(now), view: images.view.p[0], place: images.place[0], moved, blend});
    }
    return frames;
}"""


def test_the_shown_place_keeps_up_with_the_vbot_and_goes_gently_to_and_from_the_views_own(driver):
    frames = driver.evaluate(DRIVE)
    first = next(frame for frame in frames if frame["mode"] == "virtual")
    assert first["place"] == first["view"]  # at the switch each picture is shown from where it was made
    assert first["moved"] is None
    driven = [frame for frame in frames if 2200 <= frame["now"] < 3000]
    assert max(abs(frame["place"] - frame["vbot"]) for frame in driven) < 0.001  # no lag at a steady speed
    for frame in driven:
        assert frame["moved"] == pytest.approx([frame["place"] - frame["view"], 0, 0], abs=1e-9)
    steps = np.diff([frame["place"] for frame in driven])
    assert steps == pytest.approx(0.003, abs=0.0005)  # 10 ms at 0.3 m/s, whenever the views come
    last = next(frame for frame in frames if frame["now"] == 4490)
    assert abs(last["place"] - last["view"]) < 1e-4  # before the return too
    blends = {frame["now"]: frame["blend"] for frame in frames}
    assert [blends[now] for now in (900, 1400, 2900, 4490, 4900)] == [0, 1, 1, 1, 0]
    assert 0 < blends[4600] < 0.9  # at once: a picture taken later would be of another place
    # On the way from one to the other the picture is at most 0.06 m/s faster or slower than the robot, seen over 0.2 s,
    # and goes on with the steps of the views (3 cm each 0.1 s) by what is left of them.
    place = np.array([frame["place"] for frame in frames if 1000 <= frame["now"] < 4500])
    speed = (place[20:] - place[:-20]) / 0.2
    assert 0.15 < speed.min() < 0.27
    assert 0.33 < speed.max() < 0.45


def test_a_view_is_never_shown_from_farther_off_than_the_limit(driver):
    moved = driver.evaluate(
        """async () => {
            const {Images} = await import("/static/images.js");
            const images = new Images({name: "none", sample() {}}, {serverNow: () => 0, acknowledge() {}});
            images.leadMaxM = 0.3;
            images.view = {p: [0, 0, 1.2], q: [0, 0, 0.70710678, 0.70710678], mount: [0.1, 0, 1.2], fov: 1.5,
                aspect: 1.6, hasDepth: true, captured_ms: 0};
            const virtual = {at_ms: 0, mode: "virtual", shown: "virtual", twist: [0, 0], lead: 1};
            const state = (x) => ({...virtual, vbot: [x, 0, 0]});
            const seen = (state) => {
                for (let i = 0; i < 100; i++) images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 50);
                const {moved} = images.scene(state, {yaw: 0, pitch: 0}, [1, 0.6], 50);
                return {moved, place: images.place};
            };
            const found = [0.1, 0.8, 1.5].map((x) => seen(state(x)));
            images.view.hasDepth = false;
            found.push(seen(state(0.1)));
            return found;
        }"""
    )
    # The mount is 0.1 m before the v-bot, which heads along x; the view looks along y: what is ahead is to its right.
    assert moved[0]["moved"] == pytest.approx([0, -0.2, 0], abs=1e-6)
    assert moved[0]["place"] == pytest.approx([0.2, 0], abs=1e-6)
    assert moved[1]["moved"] == pytest.approx([0, -0.3, 0], abs=1e-6)
    assert moved[2:] == [{"moved": None, "place": [0, 0]}] * 2  # another place; a view without depth
