"""A Chromium without a window, steered by its DevTools protocol."""

import base64
import json
import re
import shutil
import subprocess
import time
from contextlib import contextmanager
from itertools import count

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
FLAGS += ("--remote-debugging-port=0", "--no-first-run", "--disable-background-networking")


def find_chromium() -> str | None:
    """Return the path of a Chromium, None where none is on PATH."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Tab:
    """One page; the errors of its console and its network are kept in `errors`."""

    def __init__(self, socket):
        self._socket, self._numbers, self.errors = socket, count(1), []

    def __call__(self, method: str, **params) -> dict:
        """Send a command of the protocol and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            self._note(message)
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def _note(self, message: dict) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"])
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append([arg.get("value") for arg in params["args"]])
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(params["entry"])
        elif method == "Network.loadingFailed":
            self.errors.append(params)

    def evaluate(self, script: str):
        return self("Runtime.evaluate", expression=script)["result"].get("value")

    def click(self, x: float, y: float) -> None:
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self) -> np.ndarray:
        """Return what the page shows, RGB in [0, 1]."""
        png = base64.b64decode(self("Page.captureScreenshot", format="png")["data"])
        pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        return pixels[..., ::-1].astype(np.float32) / 255


@contextmanager
def open_page(chromium: str, url: str, folder, width: int, height: int):
    """Open a page in a browser of its own, whose profile lies in `folder`."""
    from websockets.sync.client import connect

    with open(folder / "chromium.log", "w+") as log:
        process = subprocess.Popen(
            [chromium, *FLAGS, f"--user-data-dir={folder}/profile", "about:blank"], stderr=log
        )
        try:
            address = _wait_for(
                lambda: re.search(r"ws://\S+", (folder / "chromium.log").read_text())
            )
            root = address[0].partition("/devtools")[0]
            with connect(address[0], max_size=None) as browser:
                target = Tab(browser)("Target.createTarget", url="about:blank")["targetId"]
            with connect(f"{root}/devtools/page/{target}", max_size=None) as socket:
                tab = Tab(socket)
                for domain in ("Page", "Runtime", "Log", "Network"):
                    tab(f"{domain}.enable")
                metrics = {"width": width, "height": height, "deviceScaleFactor": 1}
                tab("Emulation.setDeviceMetricsOverride", mobile=False, **metrics)
                tab("Page.navigate", url=url)
                yield tab
        finally:
            process.terminate()
            process.wait()


def _wait_for(find, seconds: float = 60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := find():
            return found
        time.sleep(0.05)
    raise TimeoutError("Chromium did not start")
