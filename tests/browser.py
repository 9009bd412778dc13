"""A real browser for tests of pages; without one they are skipped with the reason."""
import contextlib
import shutil
import time

import pytest

from scanprep.viewer.server import Server

# all panes of a program are drawn
DRAWN = "Boolean(window.program?.figure && program.state) && program.figure.panes.every((pane) => pane.drawn > 1)"
NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync")
WITHOUT_3D = ("--headless", "--no-sandbox", "--disable-3d-apis", *FLAGS[5:])


@contextlib.contextmanager
def chromium(flags=FLAGS):
    """A browser of its own, such as one without WebGL (`WITHOUT_3D`); not inside another one."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)}")
    with playwright.sync_playwright() as started:
        launched = started.chromium.launch(executable_path=path, args=list(flags))
        try:
            yield launched
        finally:
            launched.close()


@pytest.fixture(scope="module")
def browser():
    """The browser of one file of tests: while it is open, no test of the process can start a loop of asyncio."""
    with chromium() as launched:
        yield launched


@pytest.fixture
def new_page(browser):
    """A function that opens a page in a context of its own, with what went wrong in it and what it asked for.

    `new_page(offline=True, viewport={"width": 420, "height": 800})`: options of `browser.new_context`. The page has the
    lists `errors` (of the console, and uncaught) and `requests` (addresses).
    """
    with contextlib.ExitStack() as opened:
        def open_page(**options):
            context = opened.enter_context(contextlib.closing(browser.new_context(**options)))
            return watched(context)

        yield open_page


@pytest.fixture
def page(new_page):
    """One such page, online."""
    return new_page()


@contextlib.contextmanager
def opened(new_page, app, ready=DRAWN, width=1200, height=800, **options):
    """The page of an app, when it is ready; nothing went wrong in it."""
    with Server(app, say=lambda line: None) as server:
        page = new_page(viewport={"width": width, "height": height}, **options)
        page.goto(server.opening())
        wait_until(page, ready, 20)
        yield page
        assert not [error for error in page.errors if "ERR_CONNECTION" not in error]


def watched(context):
    """A new page of a context that collects its `errors` and `requests`."""
    page = context.new_page()
    page.errors, page.requests = [], []
    page.on("console", lambda told: page.errors.append(told.text) if told.type == "error" else None)
    page.on("pageerror", lambda error: page.errors.append(str(error)))
    page.on("request", lambda request: page.requests.append(request.url))
    return page


def wait_until(page, expression, seconds=10.0):
    """Wait until a JavaScript expression is true; `page.wait_for_function` needs eval, which our pages forbid."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"{expression} did not become true; errors of the page: {page.errors}"
        page.wait_for_timeout(20)


def take_away(page, names):
    """Choose landmarks of the second pane by their names in the list, and press Delete."""
    for name in names:
        page.locator(".sk-names li").filter(has_text=name).first.click()
        wait_until(page, f"program.state.chosen === '{name}'")
        page.keyboard.press("Delete")
        wait_until(page, f"!('{name}' in program.state.panes[1].places)")
