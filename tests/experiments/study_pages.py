"""A participant's server without a robot, for the tests of ``ic study``."""

import contextlib

from aiohttp import WSMsgType, web

from instant_ic.experiments.study.record import Record
from instant_ic.experiments.study.server import StudyServer

DRIVE = {"end": "arrived", "slowest_pace": 1.0, "bag": "drive1", "contacts": 0, "time_s": 30.0, "driven_m": 7.0}
DRIVE |= {"obedience": 0.9, "longest_stall_s": 0.5, "switches": 1, "virtual_s": 5.0, "ahead_m": 4.0}


class FakeTrial:
    """A drive that is ready at once."""

    console = "http://127.0.0.1:9"
    pace = 1.0

    def __init__(self, drive, bag):
        self.drive, self.status, self.result = drive, "ready", {}
        bag.mkdir(parents=True)

    def end(self, why="participant", wait_s=0.0):
        self.status, self.result = "done", {**DRIVE, "end": why}


@contextlib.contextmanager
def served(record):
    server = StudyServer(record, make_trial=FakeTrial)
    server.start()
    try:
        yield server
    finally:
        server.stop()


@contextlib.asynccontextmanager
async def fake_console():
    """Address of a console that sends a state and an image, and what it heard."""
    heard = []

    async def socket(request):
        page = web.WebSocketResponse()
        await page.prepare(request)
        async for message in page:
            if message.type is WSMsgType.TEXT:
                heard.append(message.data)
                await page.send_str('{"type": "state", "mode": "real", "reason": "the robot goes round by itself"}')
                await page.send_bytes(b"image")
        return page

    async def estop(request):
        heard.append("estop")
        return web.Response(status=204)

    app = web.Application()
    app.router.add_get("/ws", socket)
    app.router.add_post("/estop", estop)
    runner = web.AppRunner(app, shutdown_timeout=0.1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    try:
        yield f"http://127.0.0.1:{runner.addresses[0][1]}", heard
    finally:
        await runner.cleanup()


def filled(study, step, shift=0.0):
    """Result of a step: every scale in the middle plus a share of its range, 5 m for every distance."""
    if step in ("consent", "practice") or step.startswith("drive"):
        return dict(DRIVE)
    answers = {}
    for item in study.questionnaire(step).items:
        points = item.points() if item.kind == "scale" else []
        middle = points[round((len(points) - 1) * (0.5 + shift))] if points else None
        answers[item.id] = {"scale": middle, "number": 5.0, "drive": 1.0}.get(item.kind)
    return {"answers": answers}


def finished_study(study, codes, simulated=True):
    for number, code in enumerate(codes):
        record = Record(study, code)
        record.simulated = simulated
        for step in study.steps():
            record.finish(step, filled(study, step, 0.1 * (number % 2)))
