"""Chromium without a window, driven through its DevTools protocol."""

import json
import os
import shutil
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-quic",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL on a CPU
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)
START_SECONDS, ANSWER_SECONDS = 60, 240


@contextmanager
def open_browser(folder: Path):
    """Start a browser with a new profile in `folder`; skip the test where there is none."""
    program = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no browser is installed: name one in the environment variable CHROMIUM")
    connect = pytest.importorskip("websockets.sync.client").connect
    port = folder / "DevToolsActivePort"
    command = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **quiet) as process:
        try:
            end = time.monotonic() + START_SECONDS
            while not (port.is_file() and len(port.read_text().split()) == 2):
                assert process.poll() is None and time.monotonic() < end, "no browser starts"
                time.sleep(0.05)
            number, address = port.read_text().split()
            with connect(f"ws://127.0.0.1:{number}{address}", max_size=None) as socket:
                yield Browser(socket)
        finally:
            process.terminate()


class Browser:
    def __init__(self, socket):
        self._socket, self._number = socket, 0
        self.events = []

    def send(self, method: str, session: str | None = None, **params) -> dict:
        """Return the answer to a command; keep the events that come before it."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        self._socket.send(json.dumps(message | ({"sessionId": session} if session else {})))
        while True:
            answer = json.loads(self._socket.recv(timeout=ANSWER_SECONDS))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def open(self, path: Path, width: int = 640, height: int = 480, script: str = "") -> "Tab":
        """Open a file in a new tab, of a size in pixels, after a script."""
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        attached = self.send("Target.attachToTarget", targetId=target, flatten=True)
        tab = Tab(self, attached["sessionId"])
        for domain in ("Page", "Runtime", "Log", "Network"):
            tab.send(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        tab.send("Emulation.setDeviceMetricsOverride", **size)
        tab.send("Page.addScriptToEvaluateOnNewDocument", source=script)
        tab.send("Page.navigate", url=path.absolute().as_uri())
        tab.evaluate(LOADED)
        return tab


LOADED = """new Promise((done) => {
  if (document.readyState === "complete") done(); else addEventListener("load", () => done());
})"""


class Tab:
    def __init__(self, browser: Browser, session: str):
        self._browser, self._session = browser, session

    def send(self, method: str, **params) -> dict:
        return self._browser.send(method, self._session, **params)

    def evaluate(self, expression: str):
        """Return the value of an expression in JavaScript, or of its promise."""
        options = {"awaitPromise": True, "returnByValue": True}
        answer = self.send("Runtime.evaluate", expression=expression, **options)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until an expression is true."""
        check = f"check = () => {{ if ({condition}) done(); else setTimeout(check, 20); }}"
        self.evaluate(f"new Promise((done) => {{ const {check}; check(); }})")

    def events(self, *methods: str) -> list[dict]:
        """Return the parameters of the tab's events of these kinds."""
        return [
            event["params"]
            for event in self._browser.events
            if event.get("sessionId") == self._session and event["method"] in methods
        ]

    def mouse(self, kind: str, x: float, y: float, **more) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)
