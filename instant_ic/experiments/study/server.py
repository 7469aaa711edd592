"""The participant's pages: one address, one page after the other, and the operator's page behind the same address.

Address, title and text of a drive's page are the same in all conditions. The page's WebSocket goes through this
server, which leaves out what would name one: reasons, plan, health of the nodes.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import aiohttp
from aiohttp import WSMsgType, web

from instant_ic.bag import BagError
from instant_ic.console import server as console
from instant_ic.experiments.study import forms
from instant_ic.experiments.study.plan import StudyError
from instant_ic.experiments.study.record import OPEN, WITHDRAWN, Record
from instant_ic.experiments.study.trial import Drive, Trial, add_answers
from instant_ic.util.web_access import host_allowed

STATIC = Path(__file__).with_name("static")
MOST_BODY = 64 * 1024
START_S, END_S = 10.0, 90.0
TO_ROBOT = frozenset({"ping", "drive", "lease", "yield", "estop", "estop_release", "look", "ack", "drawn"})
"""Messages that a participant's page may send: no recording, no bookmark."""
_STATE = ("type", "at_ms", "mode", "shown", "robot", "vbot", "twist", "estop", "command")
_HEADERS = {
    **console.SECURITY_HEADERS,
    "Cache-Control": "no-store",
    "Referrer-Policy": "same-origin",  # with no-referrer a form has no Origin to check
}
logger = logging.getLogger("instant_ic.study")


def to_page(text: str) -> str | None:
    """A text message of the console as a participant's page may have it; None: not at all."""
    message = json.loads(text)
    kind = message.get("type")
    if kind == "recording":
        return None
    if kind == "state":
        message = {key: message[key] for key in _STATE if key in message}
    elif kind == "plan":
        message |= {"trajectory": [], "path": [], "subgoal": None}
    elif kind == "health":
        message = {"type": "health", "vspace": None, "battery": None, "faults": [], "nodes": [], "pace": ""}
    return json.dumps(message, separators=(",", ":"))


def from_page(text: str) -> bool:
    """Whether a message of the participant's page may go to the robot; the console checks its content."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return False
    kind = message.get("type") if isinstance(message, dict) else None
    return isinstance(kind, str) and kind in TO_ROBOT


def drive_page(step: str, bar: str, end: str, title: str) -> str:
    """The operator's page with the study's bar."""
    page = (console.STATIC / "index.html").read_text(encoding="utf-8")
    head = '<link rel="stylesheet" href="/study/drive.css"><script type="module" src="/study/drive.js"></script>\n'
    # Before the page's own script, so that it sees the keys first.
    page = page.replace('  <script type="module"', f'  {head}  <script type="module"', 1)
    start, _, rest = page.partition("<title>")
    page = f"{start}<title>{forms.escape(title)}</title>{rest.partition('</title>')[2]}"
    text = (
        f'<div id="study-bar"><span>{forms.escape(bar)}</span><button id="study-end">{forms.escape(end)}</button></div>'
    )
    return page.replace("<body>", f'<body data-step="{forms.escape(step)}">\n  {text}', 1)


class StudyServer:
    """Serves one participant's pages on 127.0.0.1, in its own thread.

    Args:
        record: of the participant; it is continued where it stopped.
        port: 0 takes a free one.
        make_trial: starts a drive.
    """

    def __init__(self, record: Record, port: int = 0, make_trial: Callable[[Drive, Path], Trial] = Trial) -> None:
        self.record, self.port = record, port
        self.over = threading.Event()
        """Set once the participant has seen the last page."""
        self._make_trial = make_trial
        self._trial: Trial | None = None
        self._last = ""  # text of the last page, where the participant left
        self._loop: asyncio.AbstractEventLoop | None = None
        self._finish = asyncio.Event()
        self._started = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="study-server", daemon=True)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/"

    @property
    def pace(self) -> float:
        """Seconds of the running drive per second of the machine."""
        return 1.0 if self._trial is None else self._trial.pace

    def start(self) -> None:
        """Serve; raise StudyError if the port is taken."""
        self._thread.start()
        if not self._started.wait(START_S) or self._error is not None:
            raise StudyError(f"cannot listen on 127.0.0.1:{self.port}: {self._error}; choose another --port")

    def stop(self) -> None:
        """End a running drive, store one that has just ended, and end the server."""
        trial = self._trial
        if trial is not None:
            trial.end("interrupted", END_S)
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._finish.set)
        self._thread.join(START_S)
        if trial is None or trial is not self._trial or self._last or trial.status != "done":
            return
        if trial.result["end"] != "interrupted" and self.record.step is not None:
            self.record.finish(self.record.step, trial.result)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except OSError as error:
            self._error = error
        finally:
            self._started.set()

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        app = web.Application(middlewares=[self._guard], client_max_size=MOST_BODY)
        app.router.add_get("/", self._show)
        app.router.add_post("/", self._take)
        app.router.add_get("/withdraw", self._ask_to_withdraw)
        app.router.add_get("/study/status", self._status)
        app.router.add_get("/ws", self._websocket)
        app.router.add_post("/estop", self._estop)
        app.router.add_static("/study/", STATIC)
        app.router.add_static("/static/", console.STATIC)
        runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=1.0)
        await runner.setup()
        try:
            site = web.TCPSite(runner, "127.0.0.1", self.port)
            await site.start()
            self.port = runner.addresses[0][1]
            self._started.set()
            await self._finish.wait()
        finally:
            await runner.cleanup()

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        host = request.headers.get("Host", "")
        if not host_allowed(host, ()):
            raise web.HTTPForbidden(text="Host not allowed\n")
        if (request.method == "POST" or request.path == "/ws") and not console.origin_allowed(
            request.headers.get("Origin"), host
        ):
            raise web.HTTPForbidden(text="Origin does not match Host\n")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    # ---- pages

    def _page(self, body: str, refresh_s: int = 0, status: int = 200, leave: bool = True) -> web.Response:
        texts = self.record.study.texts
        if leave and not self._last and self.record.state == OPEN and self.record.step != "consent":
            body += f'<p class=leave><a href="/withdraw">{forms.escape(texts["withdraw"])}</a></p>'
        page = forms.page(texts["title"], body, refresh_s)
        return web.Response(text=page, content_type="text/html", status=status)

    async def _show(self, request: web.Request) -> web.StreamResponse:
        return self._present({}, {})

    def _present(self, given: dict[str, Any], faults: dict[str, str]) -> web.Response:
        """The participant's present page; with what was sent and what is wrong with it, once more."""
        record, texts = self.record, self.record.study.texts
        if self._last == "saving":
            return self._page(forms.paragraphs(texts["saving"]), refresh_s=1)
        if self._last or record.state != OPEN or (step := record.step) is None:
            asyncio.get_running_loop().call_later(1.0, self.over.set)
            key = self._last or ("withdrawn" if record.state == WITHDRAWN else "done")
            return self._page(f"<h1>{forms.escape(texts['title'])}</h1>{forms.paragraphs(texts[key])}")
        if step == "consent":
            content = f"<h1>{forms.escape(texts['consent_title'])}</h1>{forms.paragraphs(texts['consent'])}"
            return self._page(forms.form(step, content, ("agree", texts["agree"]), ("refuse", texts["refuse"])))
        if step == "practice" or step.startswith("drive"):
            return self._drive(step)
        found = record.study.questionnaire(step)
        shown = {key: value for key, value in given.items() if isinstance(value, str)}
        content = forms.questions(found, len(record.study.worlds), texts, shown, faults)
        return self._page(forms.form(step, content, ("next", texts["next"])), status=422 if faults else 200)

    def _drive(self, step: str) -> web.Response:
        texts, practice = self.record.study.texts, step == "practice"
        trial = self._trial
        if trial is None:
            title = texts["practice_title"] if practice else f"{texts['drive_title']} {step.removeprefix('drive')}"
            content = f"<h1>{forms.escape(title)}</h1>{forms.paragraphs(texts['practice' if practice else 'task'])}"
            return self._page(forms.form(step, content, ("start", texts["start"])))
        if trial.status == "ready":
            bar = texts["bar_practice" if practice else "bar_drive"]
            page = drive_page(step, bar, texts["finish"], texts["title"])
            return web.Response(text=page, content_type="text/html")
        if trial.status == "done":
            self.record.finish(step, trial.result)
            self._trial = None
            return self._present({}, {})
        if trial.status == "failed":
            content = forms.paragraphs(texts["problem"])
            return self._page(forms.form(step, content, ("again", texts["again"])))
        return self._page(forms.paragraphs(texts[trial.status]), refresh_s=1)

    async def _take(self, request: web.Request) -> web.StreamResponse:
        given = dict(await request.post())
        record, step, action = self.record, given.get("step"), given.get("action")
        if step == "withdraw" and record.state == OPEN and not self._last:
            await self._withdraw(action)
        elif step == record.step and step is not None and record.state == OPEN and not self._last:
            if step == "consent":
                if action == "refuse":
                    record.delete()
                    self._last = "refused"
                elif action == "agree":
                    record.finish(step, {"agreed": True})
            elif step == "practice" or str(step).startswith("drive"):
                self._steer(str(step), action)
            else:
                found = record.study.questionnaire(str(step))
                answers, faults = forms.answers(found, len(record.study.worlds), given)
                if faults:
                    return self._present(given, faults)
                self._store(str(step), answers)
        raise web.HTTPSeeOther("/")  # also from an old page: the present one is shown

    def _steer(self, step: str, action: Any) -> None:
        trial, record = self._trial, self.record
        if action in ("start", "again") and (trial is None or trial.status == "failed"):
            number = 0 if step == "practice" else int(step.removeprefix("drive"))
            self._trial = self._make_trial(Drive(record.study, record.code, number), record.bag(step))
        elif action == "finish" and trial is not None and trial.status == "ready":
            trial.end()

    def _store(self, step: str, answers: dict[str, Any]) -> None:
        """Store answers, those after a drive in its bag too; a bag that cannot be written holds up nobody."""
        record, (_, _, drive) = self.record, step.partition(".")
        record.finish(step, {"answers": answers})
        if drive:
            bag = record.folder / record.steps[f"drive{drive}"]["bag"]
            try:
                add_answers(bag, step, answers)
            except (OSError, BagError) as error:
                logger.error("answers %s of %s are in answers.json only: %s", step, record.code, error)

    async def _ask_to_withdraw(self, request: web.Request) -> web.StreamResponse:
        texts = self.record.study.texts
        choices = (("back", texts["back"]), ("keep", texts["withdraw_keep"]), ("delete", texts["withdraw_delete"]))
        content = f"<h1>{forms.escape(texts['withdraw'])}</h1>{forms.paragraphs(texts['withdraw_text'])}"
        return self._page(forms.form("withdraw", content, *choices), leave=False)

    async def _withdraw(self, action: Any) -> None:
        if action not in ("keep", "delete"):
            return
        self._last, trial = "saving", self._trial
        try:
            if trial is not None:
                await asyncio.to_thread(trial.end, "withdrawn", END_S)
                if trial.status not in ("done", "failed"):
                    raise TimeoutError(f"the drive has not ended within {END_S:g} s")
                self._trial = None
            if action == "delete":
                self.record.delete()
            else:
                self.record.state = WITHDRAWN
                self.record.save()
            self._last = "withdrawn" if action == "keep" else "deleted"
        except OSError as error:
            code, folder = self.record.code, self.record.study.folder
            logger.error("%s wanted to stop (%s): %s. Run `ic study delete %s %s`", code, action, error, folder, code)
            self._last = "problem"

    # ---- the operator's page

    async def _status(self, request: web.Request) -> web.StreamResponse:
        return web.Response(text="none" if self._trial is None else self._trial.status)

    def _console(self) -> str:
        if self._trial is None or self._trial.status != "ready":
            raise web.HTTPServiceUnavailable(text="no drive\n")
        return self._trial.console

    async def _estop(self, request: web.Request) -> web.StreamResponse:
        address = f"{self._console()}/estop"
        try:
            async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=2)) as http:
                async with http.post(address) as answer:
                    return web.Response(status=answer.status)
        except (aiohttp.ClientError, TimeoutError) as error:
            raise web.HTTPBadGateway(text="the robot's server does not answer\n") from error

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        address = self._console().replace("http", "ws", 1) + "/ws"
        page = web.WebSocketResponse(max_msg_size=console.MAX_CLIENT_MESSAGE, compress=False, timeout=1.0)
        try:
            async with aiohttp.ClientSession() as http, http.ws_connect(address, max_msg_size=0, compress=0) as robot:
                await page.prepare(request)
                ways = [asyncio.create_task(_forward(page, robot)), asyncio.create_task(_back(robot, page))]
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
                await page.close()
        except (aiohttp.ClientError, TimeoutError) as error:  # the stack has just ended
            if not page.prepared:
                raise web.HTTPBadGateway(text="the robot's server does not answer\n") from error
        return page


async def _forward(page: web.WebSocketResponse, robot: aiohttp.ClientWebSocketResponse) -> None:
    async for message in page:
        if message.type is WSMsgType.TEXT and from_page(message.data):
            await robot.send_str(message.data)


async def _back(robot: aiohttp.ClientWebSocketResponse, page: web.WebSocketResponse) -> None:
    async for message in robot:
        if message.type is WSMsgType.BINARY:
            await page.send_bytes(message.data)
        elif message.type is WSMsgType.TEXT and (text := to_page(message.data)) is not None:
            await page.send_str(text)
