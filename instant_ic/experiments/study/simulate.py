"""Simulated participants: Chromium through the real pages, random answers. They test the laboratory, not a theory."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from instant_ic.experiments.study.plan import StudyError
from instant_ic.experiments.study.record import DONE, Record
from instant_ic.experiments.study.server import StudyServer

FLAGS = ("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking")
STUCK_S = 4.0
"""Seconds of the stack. Standing so long under a command, they drive around; the third time they end the drive."""
AROUND = (("s", 2.5), ("a", 1.2), ("w", 3.0), ("d", 2.4), ("w", 3.0), ("a", 1.2))
_WATCH = "addEventListener('rendered', (event) => { window.studyPose = event.detail.pose; })"


@contextmanager
def chromium() -> Iterator[Any]:
    """Chromium of the system, by Playwright.

    Raises:
        StudyError: one of the two is missing.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise StudyError("simulated participants need the package playwright: pip install playwright") from None
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        raise StudyError("simulated participants need Chromium: apt install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


class Participant:
    """Fills and drives the pages of a running server, from the present one to the last.

    Args:
        page: of Playwright.
        seed: of the answers.
        limit_s: longest time for everything.
        on_page: called with the page before each action, for screenshots.
    """

    def __init__(
        self, page: Any, seed: int, limit_s: float, on_page: Callable[[Any, str], None] = lambda page, step: None
    ) -> None:
        self.page, self.rng, self.on_page = page, np.random.default_rng([103, seed]), on_page
        self._deadline = time.monotonic() + limit_s

    def take_part(self, server: StudyServer) -> None:
        """Go through all pages.

        Raises:
            StudyError: it took longer than ``limit_s``, or a page reports a problem.
        """
        from playwright.sync_api import Error

        self.page.goto(server.url)
        while server.record.state != DONE:
            self._check_time()
            try:
                self._act(server.record.step or "end", server)
            except Error as error:
                if "navigation" not in str(error):
                    raise  # else the page went on by itself, as at the end of a drive: look at the new one
            finally:
                self.page.keyboard.up("w")
        self.page.goto(server.url)
        self.on_page(self.page, "end")

    def _act(self, step: str, server: StudyServer) -> None:
        """Do what the present page asks for."""
        if self.page.locator("#study-bar").count():
            self._drive(step, server)
        elif (form := self.page.locator("form:has(button.main)")).count():  # the operator's page has others
            self.on_page(self.page, step)
            if self.page.locator("button[value=again]").count():
                raise StudyError(f"{step} of {server.record.code} failed; the log says why")
            self._answer(form)
            self.page.locator("button.main").click()
        else:
            self.page.wait_for_timeout(500)  # the page reloads itself

    def _check_time(self) -> None:
        if time.monotonic() > self._deadline:
            raise StudyError("the simulated participant took too long")

    def _answer(self, form: Any) -> None:
        for field in form.locator("fieldset").all():
            radios, numbers = field.locator("input[type=radio]").all(), field.locator("input[type=number]")
            if radios:
                radios[int(self.rng.integers(len(radios)))].check()
            elif numbers.count():
                numbers.fill(f"{self.rng.uniform(1, 9):.1f}")
            else:
                field.locator("textarea").fill("written by a program")

    def _drive(self, step: str, server: StudyServer) -> None:
        """Hold W to the end; stuck, drive around with the keys; stuck again and again, end the drive."""
        page, keys = self.page, self.page.keyboard
        page.evaluate(_WATCH)
        while not page.locator("body[data-driver=you]").count():  # before, the page ignores keys
            self._check_time()
            page.wait_for_timeout(100)
        if step == "practice":
            keys.down("w")
            page.wait_for_timeout(1500)
            keys.up("w")
            self.on_page(page, step)
            return self._end()
        keys.down("w")
        moved_at, last, tries, photographed = time.monotonic(), None, 0, False
        while page.locator("#study-bar").count():
            self._check_time()
            page.wait_for_timeout(250)
            pose = page.evaluate("window.studyPose ?? null")
            if last is None or pose is None or np.hypot(pose[0] - last[0], pose[1] - last[1]) > 0.05:
                moved_at, last = time.monotonic(), pose
            if pose is not None and pose[0] > 2.0 and not photographed:
                photographed = True
                self.on_page(page, step)
            if page.locator("#banner:visible").count():  # it asks to release the controls
                keys.up("w")
                page.wait_for_timeout(1200 / server.pace)
                keys.down("w")
            elif (time.monotonic() - moved_at) * server.pace > STUCK_S:
                tries += 1
                keys.up("w")
                if tries > 2:
                    return self._end()
                for key, seconds in AROUND:
                    if page.locator("#study-bar").count():
                        keys.down(key)
                        page.wait_for_timeout(1000 * seconds / server.pace)
                        keys.up(key)
                keys.down("w")
                moved_at = time.monotonic()
        return None

    def _end(self) -> None:
        button = self.page.locator("#study-end")
        if button.count():
            button.click()
            button.wait_for(state="detached")


def simulate(record: Record, limit_s: float, on_page: Callable[[Any, str], None] = lambda page, step: None) -> None:
    """Take part as a simulated participant; an interrupted one continues.

    Raises:
        StudyError: the code belongs to a person, or the participant did not get to the end.
    """
    if record.steps and not record.simulated:
        raise StudyError(f"{record.code} has answers of a person: simulate another code")
    record.simulated = True
    record.save()
    server = StudyServer(record)
    server.start()
    try:
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 960, "height": 600})
            page.set_default_timeout(120_000)  # a busy machine takes its time
            Participant(page, int(record.code[1:]), limit_s, on_page).take_part(server)
    finally:
        server.stop()
