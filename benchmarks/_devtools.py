"""A page in headless Chromium in real time, driven by the DevTools protocol over a pipe."""

import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from _common import skip

_READ, _WRITE = 3, 4  # of the browser
_FLAGS = ("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome")
_TIMEOUT_S = 120


class LivePage:
    """One page of a browser of its own; WebGL2 is drawn by software."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
        if browser is None:
            skip("Chromium", "install it")
        to_browser, from_browser = os.pipe(), os.pipe()
        self._folder = tempfile.TemporaryDirectory()
        command = [browser, *_FLAGS, "--remote-debugging-pipe", f"--user-data-dir={self._folder.name}"]
        shell = f'exec "$@" {_READ}<&{to_browser[0]} {_WRITE}>&{from_browser[1]}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command, "about:blank"],
            pass_fds=(to_browser[0], from_browser[1]),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser[0])
        os.close(from_browser[1])
        self._to, self._from = to_browser[1], from_browser[0]
        self._count, self._rest, self._session = 0, b"", ""
        (target,) = (x for x in self.call("Target.getTargets")["targetInfos"] if x["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=path.resolve().as_uri())

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._to)
        os.close(self._from)
        self._process.terminate()
        self._process.wait()
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol, and return its result."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < until:
            while b"\0" in self._rest:
                one, _, self._rest = self._rest.partition(b"\0")
                reply: dict[str, Any] = json.loads(one)
                if reply.get("id") == self._count:
                    if "error" in reply:
                        raise RuntimeError(f"{method}: {reply['error']['message']}")
                    found: dict[str, Any] = reply["result"]
                    return found
            if select.select([self._from], [], [], 1)[0]:
                self._rest += os.read(self._from, 1 << 20)
        raise TimeoutError(method)

    def run(self, script: str) -> Any:
        """The value of an expression in the page, awaited if it is a promise."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(str(result["exceptionDetails"].get("exception")))
        return result["result"].get("value")

    def settle(self) -> None:
        """Wait until the page shows its exact image."""
        until = time.monotonic() + _TIMEOUT_S
        while self.run("document.body && document.body.dataset.settled") != "true":
            if time.monotonic() > until:
                raise TimeoutError("the page does not settle")
            time.sleep(0.1)

    def pointer(self, kind: str, x: float, y: float) -> None:
        """Move or press the mouse at a place of the window: mouseMoved, mousePressed, mouseReleased."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
