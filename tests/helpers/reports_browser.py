"""Headless Chromium, driven by Playwright."""

import contextlib
import shutil
from pathlib import Path

import axe_playwright_python
import pytest
from playwright.sync_api import Error, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
EXECUTABLE = next((path for name in NAMES if (path := shutil.which(name))), None)
HELPERS = """
globalThis.one = (selector) => document.querySelector(selector);
globalThis.all = (selector) => [...document.querySelectorAll(selector)];
globalThis.choose = (select) => {
  select.selectedIndex = select.options.length - 1;
  select.dispatchEvent(new Event("change"));
};
globalThis.slide = (input, value) => { input.value = value; input.dispatchEvent(new Event("input")); };
"""
AXE = Path(axe_playwright_python.__file__).with_name("axe.min.js")
needs_browser = pytest.mark.skipif(
    EXECUTABLE is None, reason=f"no browser is installed: {', '.join(NAMES)}"
)


OF_THE_DRIVER = ("GL Driver Message", "willReadFrequently", "WebGL")
"""Warnings of software that draws in place of a graphics card."""


TRIES = 1200
"""Looks at a page, 50 ms apart, before what is waited for counts as never true."""


class Browser:
    """One page of a headless browser.

    Attributes:
        faults: Console errors, exceptions and failed loads since the last `open`.
        fetched: Addresses that were loaded since then.
    """

    def __init__(self, folder):
        self.faults = []
        self.fetched = []
        self._playwright = sync_playwright().start()
        self._context = self._playwright.chromium.launch_persistent_context(
            folder,
            executable_path=EXECUTABLE,
            args=["--enable-unsafe-swiftshader"],  # figures in space, without a graphics card
        )
        self._page = self._context.pages[0]
        self._session = self._context.new_cdp_session(self._page)
        self._page.on("console", self._hear)
        self._page.on("pageerror", lambda error: self.faults.append(str(error)))
        self._page.on(
            "requestfailed", lambda request: self.faults.append(f"{request.failure} {request.url}")
        )
        self._page.on("request", lambda request: self.fetched.append(request.url))

    def _hear(self, message):
        if message.type in ("error", "warning") and not any(
            word in message.text for word in OF_THE_DRIVER
        ):
            self.faults.append(message.text)

    def close(self):
        self._context.close()
        self._playwright.stop()

    def open(self, path, width=1400, height=900, anchor=""):
        """Open a file and wait until it is loaded."""
        self._page.set_viewport_size({"width": width, "height": height})
        self._page.goto("about:blank")
        self.faults.clear()
        self.fetched.clear()
        self._page.goto(path.absolute().as_uri() + anchor)
        self.run(HELPERS)
        self.settle()

    def settle(self):
        """Wait until what was started has been drawn."""
        self.run(
            "new Promise(done => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 150))"
        )

    def run(self, expression):
        """The value of a JavaScript expression; a promise is waited for."""
        how = {"returnByValue": True, "awaitPromise": True}
        answer = self._session.send("Runtime.evaluate", {"expression": expression, **how})
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression):
        """Wait until an expression is true; the page may give way to another one meanwhile."""
        for _ in range(TRIES):
            with contextlib.suppress(Error):
                if self.run(f"Boolean({expression})"):
                    return
            self._page.wait_for_timeout(50)
        raise AssertionError(f"never true: {expression}")

    def violations(self):
        """What axe-core finds against accessibility: rule, first element, and why."""
        self.run(AXE.read_text(encoding="utf-8") + ";0")
        first = "[rule.id, rule.nodes.length, rule.nodes[0].html.slice(0, 200), rule.nodes[0].failureSummary]"
        # what passes is not described: that takes longest
        options = "{preload: false, resultTypes: ['violations']}"
        return self.run(
            f"axe.run({options}).then(({{violations}}) => violations.map((rule) => {first}))"
        )

    def prefer(self, scheme):
        """Colour scheme of the system: ``light`` or ``dark``."""
        self._page.emulate_media(color_scheme=scheme)

    def picture(self, path):
        """A screenshot of the whole page as PNG."""
        self._page.screenshot(path=path, full_page=True)
