"""What the browser tests share: how Chromium is started, and how a page and its robot are watched."""

import io
import math
import os
import shutil
import time

import cv2
import demo_world
import numpy as np
import pytest
from console_demo import Demo
from console_servers import PATIENT

from instant_ic.console.access import AccessConfig
from instant_ic.console.config import ConsoleServerConfig
from instant_ic.console.view import ViewConfig
from instant_ic.geometry.poses import pose_matrix

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
WAIT_MS = 60_000
SIZE = {"width": 960, "height": 600}
SETTLE_MS = 150  # three times the page's sending period: what it still would send has come by then

BROWSER_TEST = [
    pytest.mark.browser,
    pytest.mark.xdist_group("console browser"),  # one Chromium at a time
    pytest.mark.skipif(
        CHROMIUM is None and os.environ.get("CI") != "true", reason="chromium is missing: apt install chromium"
    ),
]


def make_demo(port=0, panorama_width=192, view_width=160, page=None, **access):
    # No watchdog in the server's way: what stops the robot here must be the page.
    view = ViewConfig(width=view_width, height=view_width * 5 // 8, virtual_rate_hz=5)
    config = ConsoleServerConfig(port=port, drive=PATIENT, access=AccessConfig(simulated=True, **access))
    demo = Demo(config, panorama_width, view, page or {})
    demo.start()
    return demo


def watched_page(context):
    """A page that keeps what goes wrong in it."""
    page = context.new_page()
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("console", lambda m: page.faults.append(m.text) if m.type == "error" else None)
    return page


def expect_body(page, name, value):
    from playwright.sync_api import expect

    expect(page.locator("body")).to_have_attribute(f"data-{name}", value, timeout=WAIT_MS)


def kept_values(page, name):
    """Keeps every value of a body's data attribute from now on: one that lasts shorter than a look is not missed."""
    page.evaluate(
        """name => {
            const kept = (window.keptValues ??= {})[name] = [];
            new MutationObserver(() => kept.push(document.body.dataset[name])).observe(document.body, {
                attributeFilter: [`data-${name}`] });
        }""",
        name,
    )
    return lambda: page.evaluate("name => window.keptValues[name]", name)


def wait_until(predicate, page, what):
    """Waits for something on the robot's side while the page lives on."""
    deadline = time.monotonic() + WAIT_MS / 1000
    while not predicate():
        assert time.monotonic() < deadline, what
        page.wait_for_timeout(20)


def moving(demo):
    return bool(demo.commands) and demo.commands[-1] != (0.0, 0.0)


def until_driving(page, demo, press, what):
    """Presses until it drives. A press while the link is away does not count, as for a driver: it is repeated."""
    deadline = time.monotonic() + WAIT_MS / 1000
    while not moving(demo):
        assert time.monotonic() < deadline, what
        press()
        again = time.monotonic() + 5.0
        while not moving(demo) and time.monotonic() < again:
            page.wait_for_timeout(20)


def start_driving(page, demo, key="w"):
    def press():
        page.keyboard.up(key)
        page.keyboard.down(key)

    until_driving(page, demo, press, "the key drives")


def wait_stopped(page, demo):
    """Waits for the stop, and sees that nothing moves again while the page sends what it still would."""
    wait_until(lambda: not moving(demo), page, f"stopped; last commands {demo.commands[-3:]}")
    count = len([c for c in demo.commands if c != (0.0, 0.0)])
    page.wait_for_timeout(SETTLE_MS)
    assert len([c for c in demo.commands if c != (0.0, 0.0)]) == count


def release_by_enter(page, demo):
    """Ends an emergency stop as the driver does without a pointer: Enter held on the button."""
    page.locator("#release").focus()
    page.keyboard.down("Enter")
    wait_until(lambda: not demo.estop, page, "the release")
    page.keyboard.up("Enter")


def picture_of(page):
    """Pixels of the picture alone, (H, W, 3) float."""
    from PIL import Image

    # A machine that is too slow for new pictures makes the page grey them; what they show is the same.
    plain = "#view { filter: none !important; transition: none !important }"
    page.add_style_tag(content=f"body > :not(#view) {{ visibility: hidden !important }} {plain}")
    shot = page.screenshot(type="png")
    page.evaluate("document.head.lastElementChild.remove()")
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), float)


def room_seen(pose, yaw, pitch, vfov_deg=60.0):
    """What the page should show, drawn from the room itself: (H, W, 3) RGB."""
    width, height = SIZE["width"] // 4, SIZE["height"] // 4
    hfov = 2 * math.atan(math.tan(math.radians(vfov_deg) / 2) * width / height)
    map_from_look = pose_matrix(pose[0], pose[1], 1.2, yaw=pose[2]) @ pose_matrix(pitch=-pitch, yaw=yaw)
    return demo_world.perspective(map_from_look, width, height, hfov).rgb.astype(float)


def likeness(page, expected):
    """Correlation of the page's picture with ``expected``."""
    return likeness_of(picture_of(page), expected)


def likeness_of(picture, expected):
    """Correlation of two pictures of one view, softened to the same sharpness."""
    shown = cv2.resize(picture, expected.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.corrcoef(cv2.blur(shown, (5, 5)).ravel(), cv2.blur(expected, (5, 5)).ravel())[0, 1]


def wait_alike(page, expected):
    """Until the page shows what ``expected()`` draws."""
    deadline = time.monotonic() + WAIT_MS / 1000
    while (found := likeness(page, expected())) < 0.97:
        assert time.monotonic() < deadline, f"correlation with what should be seen: {found:.3f}"
        page.wait_for_timeout(100)


def touch(page, kind, x, y):
    page.evaluate(
        """([kind, x, y]) => {
        const stick = document.getElementById('stick');
        stick.setPointerCapture = () => {};
        stick.dispatchEvent(new PointerEvent(kind, {pointerId: 7, clientX: x, clientY: y, bubbles: true})); }""",
        [kind, x, y],
    )


def stick_middle(page):
    box = page.locator("#stick").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def push_stick(page, demo):
    x, y = stick_middle(page)

    def press():
        touch(page, "pointerup", x, y)
        touch(page, "pointerdown", x, y)
        touch(page, "pointermove", x, y - 60)

    until_driving(page, demo, press, "the stick drives")


def release_stick(page, how="pointerup"):
    touch(page, how, *stick_middle(page))


# For tests that cut a page's link: the sockets that it has opened.
KEEP_SOCKETS = """
    window.sockets = [];
    window.WebSocket = class extends WebSocket {
        constructor(...given) { super(...given); window.sockets.push(this); }
    };
"""
PAD = """
    const buttons = Array.from({length: 17}, () => ({pressed: false, value: 0}));
    window.pad = {index: 0, id: 'Pad', mapping: 'standard', connected: true, axes: [0, 0, 0, 0], buttons};
    navigator.getGamepads = () => [window.pad.connected ? window.pad : null];
    window.plug = (mapping) => {
        window.pad.mapping = mapping;
        const event = new Event('gamepadconnected');
        event.gamepad = window.pad;
        window.dispatchEvent(event);
    };
    window.press = (button, pressed) => { window.pad.buttons[button] = {pressed, value: +pressed}; };
"""
RB, B = 5, 1


def hold_and_push(page):
    """The stick goes forward with the shoulder button held."""
    page.evaluate(f"plug('standard'); press({RB}, false); pad.axes = [0, -1, 0, 0]")
    page.wait_for_timeout(60)  # three of the page's looks at the pad
    page.evaluate(f"press({RB}, true)")
