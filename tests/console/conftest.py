"""Chromium, the robot that the pages drive, and pages in which nothing may go wrong."""

import asyncio
import inspect

import pytest
from console_pages import (
    CHROMIUM,
    FLAGS,
    KEEP_SOCKETS,
    PAD,
    SIZE,
    WAIT_MS,
    expect_body,
    make_demo,
    release_by_enter,
    watched_page,
)
from console_servers import DRIVE, PATIENT, WAIT_S, WATCH, Backend, token_file

from instant_ic.console import ConsoleServer, ConsoleServerConfig
from instant_ic.console.access import AccessConfig


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """Runs a test that is a coroutine."""
    test = pyfuncitem.obj
    if not inspect.iscoroutinefunction(test):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in inspect.signature(test).parameters}
    asyncio.run(asyncio.wait_for(test(**arguments), 2 * WAIT_S))
    return True


@pytest.fixture
def files(tmp_path):
    return {
        "token_file": token_file(tmp_path, "drive", DRIVE),
        "watch_token_file": token_file(tmp_path, "watch", WATCH),
    }


@pytest.fixture
def serve():
    """Starts servers, and stops them."""
    servers = []

    def start(access=None, drive=PATIENT, page=None, **config):
        access = AccessConfig(**({"simulated": True} | (access or {})))
        server = ConsoleServer(Backend(), ConsoleServerConfig(port=0, drive=drive, access=access, **config), page)
        server.start()
        servers.append(server)
        return server

    yield start
    for server in servers:
        server.stop()


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    assert CHROMIUM, "chromium is missing: apt install chromium"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def demo():
    demo = make_demo()
    yield demo
    demo.stop()


@pytest.fixture
def sharp_demo():
    """With pictures fine enough to be compared with the room."""
    demo = make_demo(panorama_width=640, view_width=384)
    yield demo
    demo.stop()


@pytest.fixture
def open_page(browser, request):
    """Opens pages of ``demo`` (or ``at``), and closes them; an error in one fails the test."""
    contexts = []

    def open_one(query="", driver="you", at=None, **options):
        context = browser.new_context(**({"viewport": SIZE} | options))
        context.set_default_timeout(WAIT_MS)
        contexts.append(context)
        page = watched_page(context)
        page.goto((at or request.getfixturevalue("demo")).server.url + query)
        expect_body(page, "driver", driver)
        return page

    yield open_one
    faults = [fault for context in contexts for page in context.pages for fault in page.faults]
    for context in contexts:
        context.close()
    assert not faults


@pytest.fixture(scope="module")
def shared_demo():
    demo = make_demo()
    yield demo
    demo.stop()


@pytest.fixture(scope="module")
def shared_page(browser, shared_demo):
    context = browser.new_context(viewport=SIZE, accept_downloads=True)
    context.set_default_timeout(WAIT_MS)
    context.add_init_script(KEEP_SOCKETS)
    page = watched_page(context)
    page.goto(shared_demo.server.url)
    yield page
    context.close()


@pytest.fixture
def driver(shared_page, shared_demo):
    """The driver's page, one for all tests of a module: a new one each would be most of their time."""
    shared_demo.reset()
    expect_body(shared_page, "driver", "you")
    yield shared_page
    for key in ("w", "a", "s", "d"):
        shared_page.keyboard.up(key)
    shared_page.evaluate(
        "() => { delete document.hidden; document.activeElement.blur();"
        "for (const dialog of document.querySelectorAll('dialog[open]')) dialog.close(); }"
    )
    if shared_demo.estop:
        release_by_enter(shared_page, shared_demo)
    faults, shared_page.faults = shared_page.faults, []
    assert not faults


@pytest.fixture
def pad(driver):
    """The driver's page with a gamepad, which leaves afterwards."""
    driver.evaluate(f"() => {{ {PAD} }}")
    driver.bring_to_front()
    yield driver
    driver.evaluate("pad.connected = false")
    expect_body(driver, "pad", "none")
