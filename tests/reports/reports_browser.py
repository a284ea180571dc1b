"""Headless Chromium, driven through its own debugging pipe: nothing but the browser is needed."""

import base64
import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest

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
AXE_PACKAGE = importlib.util.find_spec("axe_playwright_python")
AXE = AXE_PACKAGE and Path(AXE_PACKAGE.origin).with_name("axe.min.js")
needs_browser = pytest.mark.skipif(EXECUTABLE is None, reason=f"no browser is installed: {', '.join(NAMES)}")


OF_THE_DRIVER = ("GL Driver Message", "willReadFrequently", "WebGL")
"""Warnings of software that draws in place of a graphics card."""


class CommandError(AssertionError):
    """A command that the browser refused, for example as its page was left meanwhile."""


class Browser:
    """One page of a headless browser.

    Attributes:
        faults: Console errors, exceptions and failed loads since the last `open`.
        fetched: Addresses that were loaded since then.
    """

    def __init__(self, folder):
        read_in, self._write = os.pipe()
        self._read, write_out = os.pipe()
        command = [
            *(EXECUTABLE, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"),
            *("--remote-debugging-pipe", f"--user-data-dir={folder}", "--no-first-run", "--disable-extensions"),
            "--enable-unsafe-swiftshader",  # figures in space, without a graphics card
            *("--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage"),
        ]
        script = 'exec 3<&"$1" 4>&"$2"; shift 2; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "-", str(read_in), str(write_out), *command],
            pass_fds=(read_in, write_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_in)
        os.close(write_out)
        self._number, self._rest, self._session, self._events = 0, b"", None, []
        self.faults, self.fetched = [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def close(self):
        with contextlib.suppress(OSError):
            self.call("Browser.close")
        self._process.wait(20)
        os.close(self._write)
        os.close(self._read)

    def call(self, method, **parameters):
        """Send one command and wait for its answer; events that arrive meanwhile are kept."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise CommandError(method, answer["error"])
                return answer["result"]

    def _next(self):
        while b"\0" not in self._rest:
            piece = os.read(self._read, 1 << 20)
            if not piece:
                raise OSError("the browser is gone")
            self._rest += piece
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        self._note(message)
        return message

    def _note(self, message):
        kind, given = message.get("method"), message.get("params", {})
        self._events.append(kind)
        if kind == "Runtime.exceptionThrown":
            details = given["exceptionDetails"]
            self.faults.append(details.get("exception", {}).get("description", details["text"]))
        elif kind == "Runtime.consoleAPICalled" and given["type"] in ("error", "warning"):
            self.faults.append(str(given["args"]))
        elif kind == "Log.entryAdded" and given["entry"]["level"] in ("error", "warning"):
            if not any(word in given["entry"]["text"] for word in OF_THE_DRIVER):
                self.faults.append(given["entry"]["text"] + " " + given["entry"].get("url", ""))
        elif kind == "Network.requestWillBeSent":
            self.fetched.append(given["request"]["url"])
        elif kind == "Network.loadingFailed":
            self.faults.append(given["errorText"])

    def open(self, path, width=1400, height=900, anchor=""):
        """Open a file and wait until it is loaded."""
        self.size(width, height)
        self.call("Page.navigate", url="about:blank")
        self.faults.clear()
        self.fetched.clear()
        self._events.clear()
        self.call("Page.navigate", url=path.absolute().as_uri() + anchor)
        while "Page.loadEventFired" not in self._events:
            self._next()
        self.until("location.protocol === 'file:' && document.readyState === 'complete'", tries=200)
        self.run(HELPERS)
        self.settle()

    def size(self, width, height=900):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def settle(self):
        """Wait until what was started has been drawn."""
        self.run("new Promise(done => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(done)), 150))")

    def run(self, expression):
        """The value of a JavaScript expression; a promise is waited for."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression, tries=40):
        """Wait until an expression is true; the page may give way to another one meanwhile."""
        for _ in range(tries):
            with contextlib.suppress(CommandError):
                if self.run(f"Boolean({expression})"):
                    return
            time.sleep(0.05)
        raise AssertionError(f"never true: {expression}")

    def violations(self):
        """What axe-core finds against accessibility: rule, first element, and why."""
        self.run(AXE.read_text(encoding="utf-8") + ";0")
        first = "[rule.id, rule.nodes.length, rule.nodes[0].html.slice(0, 200), rule.nodes[0].failureSummary]"
        return self.run(f"axe.run({{preload: false}}).then(({{violations}}) => violations.map((rule) => {first}))")

    def prefer(self, scheme):
        """Colour scheme of the system: ``light`` or ``dark``."""
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def picture(self, path, whole=True):
        """A screenshot as PNG."""
        data = self.call("Page.captureScreenshot", captureBeyondViewport=whole, **(self._whole() if whole else {}))
        path.write_bytes(base64.b64decode(data["data"]))

    def _whole(self):
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        return {"clip": {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}}

    def pdf(self, path):
        """The page as it is printed."""
        data = self.call("Page.printToPDF", printBackground=True, preferCSSPageSize=True)
        path.write_bytes(base64.b64decode(data["data"]))
