"""The page besides driving, in Chromium: recording, overlay, a phone, no mouse, no colours."""

import io
import itertools
import re

import numpy as np
import pytest
from console_pages import (
    BROWSER_TEST,
    expect_body,
    likeness_of,
    push_stick,
    release_stick,
    room_seen,
    start_driving,
    wait_stopped,
    wait_until,
)

pytestmark = BROWSER_TEST


def text_of(page, selector):
    return page.locator(selector).inner_text()


# ---- recording --------------------------------------------------------------------------------------


def test_the_record_button_starts_tells_time_and_size_and_ends(driver, shared_demo):
    expect_body(driver, "recording", "idle")
    driver.locator("#record").click()
    expect_body(driver, "recording", "recording")
    assert shared_demo.recorder.state == "recording"
    assert re.fullmatch(r"0:\d\d · \d+ MB", text_of(driver, "#record-text"))
    button = driver.get_by_role("button", name="Stop recording")
    assert button.get_attribute("aria-pressed") == "true"
    driver.keyboard.press("r")
    expect_body(driver, "recording", "idle")
    assert driver.locator("#record").get_attribute("aria-pressed") == "false"


def test_a_full_disk_and_a_missing_recorder_are_told_in_plain_words(driver, shared_demo):
    recorder = shared_demo.recorder
    recorder.state, recorder.error = "disk full", "only 90 MB are free"
    driver.get_by_role("button", name="Stop recording (Disk full)").wait_for()
    assert driver.locator("#record").get_attribute("title") == "only 90 MB are free"
    recorder.missing = True
    driver.locator('#record[aria-disabled="true"]').wait_for()
    driver.locator("#record").click(force=True)  # "disabled" to whoever asks, but it says why
    driver.get_by_text("No recorder is running. Launch the station with recorder:=true.").first.wait_for()
    assert recorder.state == "disk full"  # it was asked for nothing


def test_the_last_minute_is_kept(driver, shared_demo):
    driver.locator("#more-open").click()
    driver.get_by_role("button", name="Save the last minute").click()
    wait_until(lambda: shared_demo.recorder.snapshots, driver, "the snapshot")
    driver.get_by_text("Saving the last minute").wait_for(state="attached")
    assert driver.locator("#more").is_hidden()


def saved(page, act):
    with page.expect_download() as waiting:
        act()
    return waiting.value.suggested_filename, waiting.value.path().read_bytes()


def test_the_view_is_saved(driver, shared_demo):
    from PIL import Image

    shared_demo.place(-1.0, -0.5, 0.4)
    driver.keyboard.press("c")
    wait_until(lambda: abs(shared_demo.look.yaw) < 0.01, driver, "straight ahead")
    seen = room_seen(shared_demo.robot, shared_demo.look.yaw, shared_demo.look.pitch)
    for _ in range(100):  # the panorama of the new place comes
        name, data = saved(driver, lambda: driver.keyboard.press("p"))
        shown = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)
        if (found := likeness_of(shown, seen)) > 0.9:
            break
    assert re.fullmatch(r"view_\d{8}_\d{6}\.png", name) and data[:4] == b"\x89PNG"
    assert shown.shape == (600, 960, 3) and found > 0.9  # of the panorama's few pixels


# ---- overlay ----------------------------------------------------------------------------------------


def test_link_rates_and_readiness_are_told(driver, shared_demo):
    wait_until(lambda: re.fullmatch(r"\d+ ms · (good|fair|poor)", text_of(driver, "#link-ms")), driver, "the link")
    wait_until(lambda: re.fullmatch(r"\d+ ms", text_of(driver, "#camera-ms")), driver, "the camera's latency")
    assert text_of(driver, "#vspace") == "Virtual space ready · 26 dB here · 97 % seen · within 2.0\N{NO-BREAK SPACE}m"
    assert text_of(driver, "#battery") == "24.6 V · 81 %"
    wait_until(lambda: re.fullmatch(r"\d+ · \d+ /s", text_of(driver, "#rates")), driver, "rates of pictures")
    start_driving(driver, shared_demo)
    wait_until(lambda: re.fullmatch(r"\d+ ms · \d+ /s", text_of(driver, "#command-ms")), driver, "rate of commands")


def test_a_large_map_full_screen_and_help_by_key(driver):
    driver.keyboard.press("m")
    driver.get_by_role("button", name="Shrink the map").wait_for()
    driver.keyboard.press("m")
    driver.keyboard.press("f")
    driver.wait_for_function("document.fullscreenElement !== null")
    driver.keyboard.press("f")
    driver.wait_for_function("document.fullscreenElement === null")
    driver.keyboard.press("h")
    driver.get_by_role("dialog", name="Help").wait_for()
    driver.keyboard.press("h")
    driver.get_by_role("dialog", name="Help").wait_for(state="hidden")


# ---- without mouse, without sight, without colours -----------------------------------------------------


def test_every_control_has_a_name_and_is_reached_by_tab(driver):
    tree = driver.context.new_cdp_session(driver).send("Accessibility.getFullAXTree")["nodes"]
    controls = [node for node in tree if node.get("role", {}).get("value") in ("button", "slider", "textbox", "link")]
    names = [node["name"]["value"].strip() for node in controls if not node["ignored"]]
    assert all(names) and len(names) == len(set(names)), names
    driver.evaluate("document.activeElement.blur()")
    reached, outlines = [], set()
    for _ in range(40):
        driver.keyboard.press("Tab")
        found, outline = driver.evaluate(
            "[document.activeElement.id, getComputedStyle(document.activeElement).outlineStyle]"
        )
        if found in reached:
            break
        if found:  # the end of the page comes between two rounds
            reached.append(found)
            outlines.add(outline)
    assert set(reached) == set(
        driver.evaluate(
            "[...document.querySelectorAll('button, input')].filter((e) => e.checkVisibility()).map((e) => e.id)"
        )
    )
    assert {"record", "more-open", "help-open", "fullscreen", "map-size", "scale", "estop"} <= set(reached)
    assert outlines == {"solid"}  # where the focus is can be seen
    assert not driver.evaluate("[...document.images].filter((i) => !i.alt).length")


def test_a_change_of_mode_is_said_once_and_shown_by_word_and_shape(driver, shared_demo):
    said = driver.locator("#announce[role=status][aria-live=polite]")
    marks = {}
    for mode, words in (
        ("virtual", "Virtual view: you drive the virtual robot, and the robot follows"),
        ("stopped", "Stopped: the robot stands still"),
        ("real", "Real view: you see through the robot's camera"),
    ):
        shared_demo.forced_mode = mode
        driver.get_by_text(words, exact=True).wait_for(state="attached")
        assert said.inner_text() == words
        assert text_of(driver, "#mode-name") == mode.upper()
        marks[mode] = driver.locator("#mode-mark").evaluate(
            "(mark) => { const s = getComputedStyle(mark); return s.borderRadius + s.transform; }"
        )
    assert len(set(marks.values())) == 3
    # Only a text that stays is announced.
    driver.evaluate("import('/static/hud.js').then((hud) => { hud.announce('flicker'); hud.announce('lasts'); })")
    driver.get_by_text("lasts", exact=True).wait_for(state="attached")


# ---- a phone ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height"), [(390, 844), (844, 390)], ids=["upright", "across"])
def test_a_phone_shows_everything_and_its_stick_drives_until_it_is_let_go(
    driver, shared_demo, open_page, width, height
):
    size = {"width": width, "height": height}
    page = open_page(driver="other", at=shared_demo, viewport=size, is_mobile=True, has_touch=True)
    page.locator("#take").tap()
    expect_body(page, "driver", "you")
    shared_demo.faults = [{"level": "error", "name": "vlp16_driver", "text": "no packets"}]
    page.locator("#faults li").wait_for()
    shared_demo.button = True  # the longest words that the mode comes with
    page.get_by_text("Emergency stop button is pressed").first.wait_for()
    names = ["#mode", "#vspace", "#link", "#record", "#more-open", "#faults", "#map", "#panel", "#stick", "#estop"]
    boxes = {}
    for name in names:
        box = page.locator(name).bounding_box()
        boxes[name] = (box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"])
    for name, (left, top, right, bottom) in boxes.items():
        assert left >= 0 and top >= 0 and right <= width and bottom <= height, (name, boxes[name])
    for (one, a), (other, b) in itertools.combinations(boxes.items(), 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], (one, other)
    for name in ("#record", "#more-open", "#stick", "#estop", "#map-size"):
        box = page.locator(name).bounding_box()
        assert min(box["width"], box["height"]) >= 44, name  # a finger
    shared_demo.button = False
    expect_body(page, "estop", "free")
    page.locator("#more-open").tap()
    box = page.locator("#more").bounding_box()
    assert box["y"] + box["height"] <= height and box["x"] >= 0
    page.keyboard.press("Escape")
    push_stick(page, shared_demo)
    assert shared_demo.commands[-1] == pytest.approx((0.28, 0.0), abs=0.03)
    release_stick(page)
    wait_stopped(page, shared_demo)
    driver.locator("#take").click()
    expect_body(driver, "driver", "you")
