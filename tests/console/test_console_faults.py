"""Faults that other operators' consoles had, and what the page does against each, in Chromium.

``pytest -k test_fault_`` runs them all: these, and those of the server alone in the files beside this one.
"""

import dataclasses

import pytest
from console_pages import (
    BROWSER_TEST,
    RB,
    SETTLE_MS,
    B,
    expect_body,
    hold_and_push,
    kept_values,
    make_demo,
    moving,
    push_stick,
    release_by_enter,
    release_stick,
    start_driving,
    wait_stopped,
    wait_until,
)

pytestmark = BROWSER_TEST
STOPPED = (0.0, 0.0)


# ---- a key is held, the window loses the focus, the robot drives on (leo_ui 1, innate-os 460) -------
# The demo's server has no watchdog worth the name (30 s): what stops the robot here is the page.


@pytest.mark.parametrize(
    "event",
    [
        "window.dispatchEvent(new Event('blur'))",
        "Object.defineProperty(document, 'hidden', {get: () => true, configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))",
    ],
    ids=["blur", "hidden"],
)
def test_fault_key_held_window_loses_focus_robot_drives_on(driver, shared_demo, event):
    start_driving(driver, shared_demo)
    driver.evaluate(event)
    wait_stopped(driver, shared_demo)  # although the key is still down


@pytest.mark.parametrize("end", ["pointerup", "pointercancel", "lostpointercapture"])
def test_fault_touch_ends_or_is_cancelled_robot_drives_on(driver, shared_demo, end):
    push_stick(driver, shared_demo)
    release_stick(driver, end)
    wait_stopped(driver, shared_demo)


@pytest.mark.parametrize(
    "loss",
    ["pad.connected = false", "window.dispatchEvent(new Event('blur'))", f"press({B}, true)"],
    ids=["disconnected", "blur", "stop button"],
)
def test_fault_gamepad_is_lost_robot_drives_on(pad, shared_demo, loss):
    hold_and_push(pad)
    wait_until(lambda: moving(shared_demo), pad, "the gamepad drives")
    pad.evaluate(loss)
    wait_stopped(pad, shared_demo)
    assert shared_demo.estop == (loss == f"press({B}, true)")
    if shared_demo.estop:  # released with the shoulder button still held: nothing moves
        release_by_enter(pad, shared_demo)
        expect_body(pad, "pad", "ready")
        pad.wait_for_timeout(SETTLE_MS)
        assert not moving(shared_demo)


# ---- the dead-man's switch is let go and no zero is sent (teleop_tools 45) ---------------------------


def test_fault_dead_man_release_sends_no_zero_by_key(driver, shared_demo):
    start_driving(driver, shared_demo)
    assert shared_demo.commands[-1] == pytest.approx((0.28, 0.0))  # 70 % of 0.4 m/s
    driver.keyboard.down("a")
    wait_until(lambda: shared_demo.commands[-1][1] > 0, driver, "turns left")
    driver.keyboard.up("a")
    wait_until(lambda: shared_demo.commands[-1] == pytest.approx((0.28, 0.0)), driver, "straight on")
    driver.keyboard.up("w")
    wait_stopped(driver, shared_demo)
    driver.keyboard.press("Minus")
    start_driving(driver, shared_demo, "ArrowDown")
    assert shared_demo.commands[-1][0] == pytest.approx(-0.24)  # 60 %
    driver.keyboard.up("ArrowDown")
    wait_stopped(driver, shared_demo)
    driver.keyboard.press("Equal")


def test_fault_dead_man_release_sends_no_zero_by_gamepad(pad, shared_demo):
    pad.evaluate("plug('standard'); pad.axes = [0, -1, 0, 0]")
    expect_body(pad, "pad", "ready")
    pad.wait_for_timeout(SETTLE_MS)
    assert not moving(shared_demo)  # the stick alone drives nothing
    pad.evaluate(f"press({RB}, true)")
    wait_until(lambda: moving(shared_demo), pad, "the gamepad drives")
    assert shared_demo.commands[-1] == pytest.approx((0.28, 0.0), abs=1e-6)  # 70 % of 0.4 m/s
    pad.evaluate(f"press({RB}, false)")
    wait_stopped(pad, shared_demo)


def test_gamepads_right_stick_looks_and_an_unknown_layout_is_told(pad, shared_demo):
    pad.evaluate("plug('')")
    pad.get_by_text("the browser does not know its layout").wait_for(state="attached")
    pad.evaluate("plug('standard'); pad.axes = [0, 0, 1, 0]")
    wait_until(lambda: shared_demo.look.yaw < -0.2, pad, "the look turns right")
    assert not moving(shared_demo)
    pad.evaluate("pad.axes = [0, 0, 0, 0]")
    pad.keyboard.press("c")


# ---- any client drives; idle zeros of one fight another's commands (donkeycar; dimos 4119) -----------


def test_fault_any_client_drives_and_idle_zeros_fight_the_drivers_commands(driver, open_page, shared_demo, monkeypatch):
    gate = shared_demo.server.drive.gate  # a page that a busy machine delays is not lost: that would send zeros, too
    monkeypatch.setattr(gate, "config", dataclasses.replace(gate.config, beat_timeout_s=30.0))
    watcher = open_page(driver="other", at=shared_demo)
    start_driving(driver, shared_demo)
    since = len(shared_demo.commands)
    watcher.keyboard.down("s")
    watcher.get_by_text("Another operator is driving. Press Take over to drive.").wait_for(state="attached")
    watcher.keyboard.up("s")  # sends its zero
    watcher.wait_for_timeout(SETTLE_MS)
    wait_until(lambda: len(shared_demo.commands) > since + 2, driver, "the driver's commands")
    given = shared_demo.commands[since:]
    assert set(given) == {given[0]} != {STOPPED}
    watcher.locator("#take").click()
    expect_body(watcher, "driver", "you")
    expect_body(driver, "driver", "other")
    wait_stopped(driver, shared_demo)  # the key of the one who drove is still down
    driver.locator("#estop").click()  # whoever watches may stop
    expect_body(watcher, "estop", "set")
    assert shared_demo.estop
    assert driver.locator("#release").is_hidden() and watcher.locator("#release").is_visible()
    release_by_enter(watcher, shared_demo)
    watcher.locator("#yield").click()
    expect_body(watcher, "driver", "none")
    driver.locator("#take").click()
    expect_body(driver, "driver", "you")


# ---- the socket closes and leaves the throttle; the last command runs on after the link is lost ------
# ---- (donkeycar; earth-rovers-sdk 29, turtlebot_apps 55) ---------------------------------------------


def test_fault_socket_close_leaves_the_throttle(driver, open_page, shared_demo):
    page = open_page(driver="other", at=shared_demo)
    page.locator("#take").click()
    expect_body(page, "driver", "you")
    start_driving(page, shared_demo)
    page.close()
    wait_stopped(driver, shared_demo)
    driver.locator("#take").click()
    expect_body(driver, "driver", "you")


def test_fault_robot_runs_its_last_command_after_the_link_is_lost(open_page):
    demo = make_demo()
    try:
        page = open_page(at=demo)
        start_driving(page, demo)
        port = demo.server.port
    finally:
        demo.stop()
    assert demo.commands[-1] == STOPPED
    expect_body(page, "link", "lost")
    assert page.locator("#banner-title").inner_text() == "LINK LOST"
    again = make_demo(port)
    try:
        expect_body(page, "link", "up")
        expect_body(page, "driver", "you")
        page.wait_for_timeout(SETTLE_MS)
        assert not moving(again)  # the key is still down, but must be pressed anew
        page.keyboard.up("w")
        start_driving(page, again)
        page.keyboard.up("w")
        wait_stopped(page, again)
    finally:
        again.stop()
    page.faults.clear()  # the browser reports the refused connections


def test_fault_dead_path_that_closes_no_socket_is_taken_for_a_link(driver, shared_demo):
    """The other side falls silent without a word, as behind a lost radio: the page finds out by itself."""
    start_driving(driver, shared_demo)
    links = kept_values(driver, "link")
    driver.evaluate("() => { const dead = sockets.at(-1); dead.send = () => {}; dead.onmessage = null; }")
    wait_until(lambda: "lost" in links(), driver, "the page tells the loss")
    wait_stopped(driver, shared_demo)
    expect_body(driver, "link", "up")
    expect_body(driver, "driver", "you")
    assert not moving(shared_demo)


# ---- stops ------------------------------------------------------------------------------------------


def test_emergency_stop_by_space_and_release_by_holding(driver, shared_demo):
    start_driving(driver, shared_demo)
    driver.keyboard.press("Space")
    wait_stopped(driver, shared_demo)
    assert shared_demo.estop
    expect_body(driver, "estop", "set")
    expect_body(driver, "mode", "stopped")
    driver.keyboard.up("w")
    driver.keyboard.down("w")
    driver.wait_for_timeout(SETTLE_MS)
    assert not moving(shared_demo)
    driver.keyboard.up("w")
    driver.locator("#release").click()  # a tap is not enough
    driver.wait_for_timeout(SETTLE_MS)
    assert shared_demo.estop
    box = driver.locator("#release").bounding_box()
    driver.mouse.move(box["x"] + 20, box["y"] + 10)
    driver.mouse.down()
    expect_body(driver, "estop", "free")
    driver.mouse.up()
    assert not shared_demo.estop


def wait_for_banner(page, title, text):
    """Wait until the banner shows title and text at once: in between, a busy machine may report a lost link."""
    page.locator("#banner:visible").filter(has_text=title).filter(has_text=text).wait_for()


def test_controls_held_through_a_stop_are_told_to_be_let_go(driver, shared_demo):
    """The arbiter starts again only with hands off; whoever still holds a key must be told why nothing moves."""
    start_driving(driver, shared_demo)
    driver.locator("#banner").wait_for(state="hidden")
    shared_demo.forced_mode = "stopped"
    wait_for_banner(driver, "STOPPED", "Release the controls to continue.")
    assert driver.locator("#release").is_hidden()  # nothing was latched
    driver.keyboard.up("w")
    driver.locator("#banner").wait_for(state="hidden")
    shared_demo.forced_mode = "real"
    expect_body(driver, "mode", "real")


def test_faults_and_a_silent_camera_are_told(driver, shared_demo):
    expect_body(driver, "image", "live")
    text = "<img src=x onerror=alert(1)> no packets"
    shared_demo.faults = [{"level": "error", "name": "vlp16_driver", "text": text}]
    driver.locator("#faults li").wait_for()
    assert driver.locator("#faults li").inner_text() == f"LiDAR {text}"  # as text, not as HTML
    assert driver.locator("#faults li").get_attribute("title") == f"vlp16_driver: {text}"
    shared_demo.images = False
    expect_body(driver, "image", "stale")
    shared_demo.reset()
    expect_body(driver, "image", "live")
    driver.locator("#faults li").wait_for(state="detached")
