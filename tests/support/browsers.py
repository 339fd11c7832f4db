"""The installed Chromium, driven by Playwright, and pages of a workbench in it."""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import pytest

ARGUMENTS: Final = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
"""Arguments with which Chromium starts: it needs no rights, and requests nothing of its own."""
REMEDY: Final = "no Chromium is installed, so no page was opened: apt-get install chromium"
WIDE: Final = {"width": 1280, "height": 900}
NARROW: Final = {"width": 390, "height": 844}


def find_chromium() -> str:
    """Return the installed Chromium; without one skip the test, or fail in CI."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(REMEDY)
    return found


@contextmanager
def open_browser() -> Iterator[Any]:
    """Start Chromium, and stop it at the end."""
    find_chromium()
    from playwright.sync_api import sync_playwright  # noqa: PLC0415 - only tests of pages need it

    with sync_playwright() as playwright:
        browser = _launch(playwright.chromium)
        yield browser
        browser.close()


def _launch(chromium: Any) -> Any:
    """Return a process of the installed Chromium, by a `BrowserType` of Playwright."""
    return chromium.launch(executable_path=find_chromium(), args=list(ARGUMENTS))


class Visit:
    """A browser that has entered a workbench, with what it requested and what went wrong in its pages.

    Its window is alone in its process: of several, one that is behind gets no keys and draws nothing.

    Parameters
    ----------
    browser : playwright.sync_api.Browser
        Browser like which it is started.
    server : socast.tools.workbench.server.WorkbenchServer
    size : dict
        Width and height of the window.
    scheme : str
        `light` or `dark`.

    Attributes
    ----------
    page : playwright.sync_api.Page
    strangers : list of str
        Addresses of other hosts that a page requested; the requests were blocked.
    errors : list of str
        Messages of errors in the console, and errors that no script caught.
    """

    def __init__(self, browser: Any, server: Any, size: dict[str, int] | None = None, scheme: str = "light") -> None:
        self._server = server
        self._browser = _launch(browser.browser_type)
        self._context = self._browser.new_context(viewport=size or WIDE, color_scheme=scheme, reduced_motion="reduce")
        self.strangers: list[str] = []
        self.errors: list[str] = []
        # a function in place of the pattern would hold each request until the test calls the browser again
        self._context.route(re.compile(rf"^(?!{re.escape(server.origin)}/)"), self._block)
        self.page = self._context.new_page()
        self.page.set_default_timeout(60_000)
        self.page.on("console", self._keep_error)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(server.address)

    def go(self, address: str) -> None:
        """Open a page of the workbench, such as `#/fleet`."""
        self.page.goto(f"{self._server.origin}/{address}")

    def wait(self, script: str, argument: Any = None) -> None:
        """Wait until a script of the page gives a true value; the page's policy forbids Playwright's own way."""
        from tests.support.zenoh_sessions import eventually  # noqa: PLC0415 - Zenoh takes long to import

        assert eventually(lambda: self.page.evaluate(script, argument)), script

    def close(self) -> None:
        """Close the browser."""
        self._browser.close()

    def _keep_error(self, message: Any) -> None:
        """Keep an error of the console, but not the note of the browser on a refusal, which the page itself shows."""
        if message.type == "error" and not message.text.startswith("Failed to load resource"):
            self.errors.append(message.text)

    def _block(self, route: Any) -> None:
        """Block a request to another host and remember it."""
        self.strangers.append(route.request.url)
        route.abort()
