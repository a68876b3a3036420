"""A real browser without a window, driven over a pipe by its own protocol (JSON, a zero byte after each message)."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_ARGUMENTS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)

_START = """
import os, sys
for end, other in ((sys.argv[1], 20), (sys.argv[2], 21)):
    os.dup2(int(end), other)
for end, other in ((3, 20), (4, 21)):
    os.dup2(other, end)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""A browser reads from 3 and writes to 4; the detour keeps either from being overwritten before it is used."""


class Browser:
    """One page. ``requested`` holds the address of every request it made."""

    def __init__(self, profile: Path, width: int = 1280, height: int = 1000) -> None:
        if CHROMIUM is None:
            raise RuntimeError("there is no browser")
        to_read, self._write = os.pipe()
        self._read, to_write = os.pipe()
        options = [*_ARGUMENTS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
        command = [sys.executable, "-c", _START, str(to_read), str(to_write), CHROMIUM, *options]
        quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(command, pass_fds=(to_read, to_write), **quiet)
        os.close(to_read)
        os.close(to_write)
        self._waiting = b""
        self._number = 0
        self._session: str | None = None
        self.requested: list[str] = []
        self.logged: list[str] = []
        pages = [t for t in self.ask("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        attached = self.ask("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Network", "Page", "Log", "Runtime"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> Any:
        """One command's result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            answer = self._next(deadline)
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]
        raise TimeoutError(method)

    def open(self, address: str) -> None:
        """Go there; what the page before logged is forgotten."""
        self.ask("Page.navigate", url=address)
        self.logged.clear()

    def value(self, script: str) -> Any:
        """What a script gives."""
        found = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, script: str, seconds: float = 15.0) -> None:
        """Until what a script gives is true."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if self.value(f"(() => {{ try {{ return Boolean({script}); }} catch {{ return null; }} }})()"):
                return
            time.sleep(0.05)
        raise AssertionError(f"never true: {script}\n{self.value('document.body.innerText')}\n{self.logged}")

    def resize(self, width: int, height: int, dark: bool = False) -> None:
        """As if the window had that size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1}
        self.ask("Emulation.setDeviceMetricsOverride", mobile=width < 600, **size)
        wish = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[wish])

    def picture(self, path: Path) -> None:
        """A screenshot."""
        path.write_bytes(base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """End it."""
        self._session = None
        try:
            self.ask("Browser.close")
            self._process.wait(10)
        except (OSError, TimeoutError, subprocess.TimeoutExpired, AssertionError):
            self._process.kill()
            self._process.wait()
        for end in (self._write, self._read):
            os.close(end)

    def _next(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._waiting:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            data = os.read(self._read, 1 << 16) if ready else b""
            if not data:
                raise TimeoutError("the browser does not answer")
            self._waiting += data
        text, _, self._waiting = self._waiting.partition(b"\0")
        message: dict[str, Any] = json.loads(text)
        if message.get("method") == "Network.requestWillBeSent":
            self.requested.append(message["params"]["request"]["url"])
        if message.get("method") in ("Log.entryAdded", "Runtime.exceptionThrown"):
            self.logged.append(json.dumps(message["params"])[:400])
        return message
