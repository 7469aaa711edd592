"""A participant's pages in Chromium, with a synthetic robot behind the operator's page."""

import re
import sys
from pathlib import Path

import pytest
from console_pages import BROWSER_TEST, SIZE, WAIT_MS, expect_body, moving, wait_until, watched_page

from instant_ic.experiments.study.plan import CONDITIONS, create
from instant_ic.experiments.study.record import DONE, Record
from instant_ic.experiments.study.simulate import Participant
from instant_ic.experiments.study.stats import score

sys.path.insert(0, str(Path(__file__).parents[1] / "experiments"))
from study_pages import FakeTrial, filled, served

pytestmark = BROWSER_TEST


@pytest.fixture
def page(browser):
    context = browser.new_context(viewport=SIZE)
    context.set_default_timeout(WAIT_MS)
    page = watched_page(context)
    page.said = []
    page.on("console", lambda message: page.said.append(message.text))
    yield page
    context.close()


def test_a_participant_fills_every_page_and_sees_no_condition(page, tmp_path, demo, monkeypatch):
    study = create(tmp_path / "study", 4, 3)
    record = Record(study, "P01")
    monkeypatch.setattr(FakeTrial, "console", demo.server.url.rstrip("/"))
    with served(record) as server:
        page.goto(server.url)
        page.locator("button.main").click()
        page.get_by_text("About you").wait_for()
        page.locator("button.main").click()  # these may be left out
        record.finish("practice", filled(study, "practice"))
        page.goto(server.url)
        page.locator("button.main").click()
        expect_body(page, "driver", "you")
        page.keyboard.down("w")
        wait_until(lambda: moving(demo), page, "the key drives")
        page.keyboard.up("w")
        page.keyboard.press("r")  # no recording of the console's
        page.keyboard.press("h")
        assert not page.locator("dialog[open]").count()
        seen = [page.url, page.title(), page.locator("body").inner_text(), *page.said]
        assert not page.locator("#mode:visible, #map:visible, #vspace:visible, #faults:visible").count()
        page.locator("#study-end").click()
        page.get_by_text("How demanding was this drive?").wait_for()
        page.evaluate("for (const one of document.querySelectorAll('[required]')) one.required = false")
        page.locator("button.main").click()  # nothing is answered
        assert page.locator(".fault").count() == 6
        assert "Mental demand" in page.evaluate("document.activeElement.innerText")
        assert "tlx.1" not in record.steps
        page.set_viewport_size({"width": 390, "height": 800})  # 21 points fit beside each other on a phone
        inside = "(one) => one.scrollWidth <= one.clientWidth"
        assert all(field.evaluate(inside) for field in page.locator("fieldset").all())
        page.set_viewport_size(SIZE)
        for field in page.locator("fieldset").all():
            field.locator("input[value='35']").check()
        seen += [page.url, page.title(), page.locator("body").inner_text()]
        page.locator("button.main").click()
        page.get_by_text("You and the robot").wait_for()
        seen += [page.url, page.locator("body").inner_text(), *page.said]
        assert score(study.questionnaire("tlx.1"), record.steps["tlx.1"]["answers"]) == 35.0
        words = {*re.findall(r"[a-z]+", " ".join(seen).lower())}
        assert not words & ({*CONDITIONS, "virtual", "real", "illusory"} - {"stop"})  # STOP is on the emergency button
        for step in study.steps()[study.steps().index("agency.1") : -1]:
            record.finish(step, filled(study, step))
        Participant(page, 1, 120.0).take_part(server)  # the last page
    assert record.state == DONE
    expected = [f for f in page.faults if "422" not in f]  # the browser reports the refused answers
    assert not expected
