"""The page in Debian's Chromium, against the server with a made-up robot."""

import io
import math

import numpy as np
import pytest
from console_pages import (
    BROWSER_TEST,
    SIZE,
    WAIT_MS,
    expect_body,
    likeness,
    make_demo,
    moving,
    room_seen,
    start_driving,
    wait_alike,
    wait_stopped,
    wait_until,
)
from console_servers import DRIVE, WATCH

pytestmark = BROWSER_TEST


def test_page_draws_picture_and_map_without_errors(open_page):
    from PIL import Image

    page = open_page()
    expect_body(page, "image", "live")
    expect_body(page, "map", "drawn")
    expect_body(page, "mode", "real")
    shown = Image.open(io.BytesIO(page.locator("#map-view").screenshot())).convert("RGB")
    assert len(shown.getcolors(shown.width * shown.height)) > 20  # floor, costs, walls, robot
    # The content policy forbids a style tag, so the picture is cut out where nothing lies over it.
    shot = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
    middle = shot[180:420, 300:660]
    assert middle.std() > 10


def test_without_webgl_the_page_says_what_to_do_and_only_stops_the_robot(browser, demo):
    context = browser.new_context(viewport=SIZE)
    page = context.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null;")
    page.goto(demo.server.url)
    page.get_by_text("WebGL 2 is missing. Use a current Chrome, Edge, Firefox or Safari").wait_for(timeout=WAIT_MS)
    expect_body(page, "link", "up")
    page.keyboard.down("w")
    for press in (lambda: page.keyboard.press("Space"), lambda: page.locator("#estop").click()):
        demo.estop = False
        press()
        wait_until(lambda: demo.estop, page, "the emergency stop")
    expect_body(page, "estop", "set")
    assert demo.server.drive.gate.driver is None and not demo.commands
    context.close()


def test_a_page_whose_view_is_lost_stops_the_robot_and_begins_anew(open_page, demo):
    page = open_page()
    expect_body(page, "image", "live")
    start_driving(page, demo)
    page.evaluate(
        "document.getElementById('view').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    )
    wait_stopped(page, demo)
    expect_body(page, "image", "live")
    start_driving(page, demo)


@pytest.mark.parametrize("mode", ["real", "virtual"])
def test_picture_is_what_stands_in_the_look_direction(open_page, sharp_demo, mode):
    """Camera and rendered view through the same projection, against the room drawn without either."""
    demo = sharp_demo
    demo.place(-1.0, -0.5, 0.4)
    demo.forced_mode = mode
    page = open_page(at=demo, bypass_csp=True)
    expect_body(page, "blend", "1.00" if mode == "virtual" else "0.00")
    page.mouse.move(480, 300)
    page.mouse.down()
    page.mouse.move(330, 350, steps=3)  # turns right and up
    page.mouse.up()
    wait_until(lambda: demo.look.yaw < -0.2, page, "the look direction arrives")
    # The look is told while the pointer moves: its last word may still be on the way.
    wait_alike(page, lambda: room_seen(demo.robot, demo.look.yaw, demo.look.pitch))
    look = demo.look
    assert look.pitch > math.radians(-10)
    # The test can fail: the mirrored room, and a look 10° beside, are less alike.
    assert likeness(page, room_seen(demo.robot, look.yaw, look.pitch)[:, ::-1]) < 0.93
    assert likeness(page, room_seen(demo.robot, look.yaw + math.radians(10), look.pitch)) < 0.95


def test_the_page_asks_for_a_token_and_a_watchers_has_nothing_to_drive_with(browser, files):
    demo = make_demo(**files)
    try:
        contexts = [browser.new_context(viewport=SIZE) for _ in range(2)]
        driver, watcher = (context.new_page() for context in contexts)
        for page, token in ((watcher, WATCH), (driver, DRIVE)):
            page.set_default_timeout(WAIT_MS)
            page.goto(demo.server.url)
            page.get_by_label("Token").fill("wrong")
            page.keyboard.press("Enter")
            page.get_by_text("Wrong token.").wait_for()
            page.get_by_label("Token").fill(token)
            page.get_by_role("button", name="Sign in").click()
            expect_body(page, "image", "live")
        expect_body(driver, "driver", "you")
        expect_body(watcher, "driver", "other")
        assert not watcher.locator("#take").is_visible() and not watcher.locator("#stick").is_visible()
        watcher.keyboard.press("w")
        watcher.get_by_text("This sign-in can watch and stop the robot, but not drive it.").wait_for()
        assert not moving(demo)
        watcher.keyboard.press("Space")
        wait_until(lambda: demo.estop, watcher, "the watcher's emergency stop")
        for context in contexts:
            context.close()
    finally:
        demo.stop()
