"""The participant's pages on 127.0.0.1: a page before each drive, and the questions after the last.

No page and no address names a condition. A drive takes place in the operator's page, in a window of its own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import jinja2
from aiohttp import web

from instant_ic.experiments.study.plan import MAX_TEXT, QUESTIONS, Participant
from instant_ic.experiments.study.trial import Trial
from instant_ic.util.web_access import refusal

END_S = 90.0
"""Longest wait for the end of a drive, seconds."""
_TEMPLATE = Path(__file__).with_name("page.html")


class StudyPages:
    """Pages of one participant, from the first page that is not finished.

    Args:
        participant: record to continue.
        make_trial: function that starts drive number 0, 1, ... of a condition and records it to a bag.
    """

    def __init__(self, participant: Participant, make_trial: Callable[[int, str, Path], Trial]) -> None:
        self.participant = participant
        self.finished = asyncio.Event()
        """Set once the answers are stored."""
        self._make_trial = make_trial
        self._trial: Trial | None = None
        source = _TEMPLATE.read_text(encoding="utf-8")
        self._template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(source)

    def app(self) -> web.Application:
        """Return the application that serves the pages."""
        app = web.Application(middlewares=[self._guard], client_max_size=64 * 1024)
        app.router.add_get("/", self._show)
        app.router.add_post("/", self._take)
        return app

    def close(self) -> None:
        """End a running drive; the participant repeats it the next time."""
        if self._trial is not None:
            self._trial.end(END_S)

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        if why := refusal(request.headers.get("Origin"), request.headers.get("Host"), (), ()):
            raise web.HTTPForbidden(text=why)
        response = await handler(request)
        response.headers["Cache-Control"] = "no-store"
        return response

    @property
    def _number(self) -> int:
        """Number of the present drive, from 0; the number of drives once all are driven."""
        return len(self.participant.drives)

    async def _show(self, request: web.Request) -> web.StreamResponse:
        trial = self._trial
        if trial is not None and trial.status == "done":
            self.participant.drives.append(trial.result)
            self.participant.save()
            self._trial = trial = None
        return self._page("" if trial is None else trial.status)

    def _page(self, status: str, fault: str = "") -> web.Response:
        text = self._template.render(
            status=status,
            fault=fault,
            number=self._number + 1,
            drives=len(self.participant.order),
            questions=QUESTIONS,
            answered=bool(self.participant.answers),
            console="" if self._trial is None else self._trial.console,
            max_text=MAX_TEXT,
        )
        return web.Response(text=text, content_type="text/html", status=422 if fault else 200)

    async def _take(self, request: web.Request) -> web.StreamResponse:
        given = dict(await request.post())
        if given.get("step") == str(self._number + 1):  # the form of an old page only leads to the present page
            if self._number == len(self.participant.order):
                if fault := self._answer(given):
                    return self._page("", fault)
            elif self._trial is None or self._trial.status == "failed":
                condition = self.participant.order[self._number]
                self._trial = self._make_trial(self._number, condition, self._new_bag())
            elif given.get("action") == "end":
                self._trial.end()
        raise web.HTTPSeeOther("/")

    def _new_bag(self) -> Path:
        """Return the folder of the drive's bag; a drive that was interrupted keeps its own."""
        self.participant.save()
        names = (f"drive{self._number + 1}{'' if n == 1 else f'-attempt{n}'}" for n in range(1, 1000))
        return next(path for name in names if not (path := self.participant.folder / name).exists())

    def _answer(self, given: dict[str, Any]) -> str:
        """Store the answers and return an empty text, or return what is wrong with them."""
        if self.participant.answers:
            return ""
        votes = {name: given.get(name) for name in QUESTIONS}
        choices = [str(number) for number in range(len(self.participant.order) + 1)]
        text = given.get("text", "")
        if any(vote not in choices for vote in votes.values()):
            return "Please answer both questions."
        if not isinstance(text, str) or len(text) > MAX_TEXT:
            return f"Please shorten the text to {MAX_TEXT} characters."
        self.participant.answers = {name: int(str(vote)) for name, vote in votes.items()} | {"text": text.strip()}
        self.participant.save()
        self.finished.set()
        return ""


async def serve(pages: StudyPages, port: int, report: Callable[[str], None]) -> None:
    """Serve the pages until the participant has answered; report their address.

    Raises:
        OSError: the port is taken.
    """
    runner = web.AppRunner(pages.app(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", port).start()
        report(f"http://127.0.0.1:{runner.addresses[0][1]}/")
        await pages.finished.wait()
        await asyncio.sleep(1.0)  # for the last page to be fetched
    finally:
        await asyncio.to_thread(pages.close)
        await runner.cleanup()
