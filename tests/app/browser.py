"""A headless Chromium that a test drives through a pipe (Chrome DevTools Protocol)."""

import base64
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
FLAGS = (
    "--headless=new --no-sandbox --disable-gpu --disable-background-networking --no-first-run "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --hide-scrollbars "
    "--remote-debugging-pipe"
).split()
# Chromium reads commands from descriptor 3 and writes answers to descriptor 4.
LAUNCH = """import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for end, wanted in zip(ends, (3, 4)):
    os.dup2(end, wanted)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Tab:
    """One page. `shown` is what `open` has loaded, `errors` are the complaints of the console and of
    the page, and `requests` the addresses that it asked for, files and data apart."""

    def __init__(self, read: Any, write: Any):
        self._read, self._write, self._count, self._session = read, write, 0, ""
        self.shown: tuple[Path | str, int, str] | None = None
        self.errors: list[str] = []
        self.requests: list[str] = []
        target = self("Target.createTarget", url="about:blank")["targetId"]
        attached = self("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self(f"{domain}.enable")

    def __call__(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._count += 1
        sent = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            sent["sessionId"] = self._session
        self._write.write(json.dumps(sent).encode() + b"\0")
        self._write.flush()
        return self._until(lambda answer: answer.get("id") == sent["id"])["result"]

    def _until(self, is_wanted: Any) -> dict[str, Any]:
        while True:
            text = bytearray()
            while (byte := self._read.read(1)) != b"\0":
                assert byte, "the browser ended"
                text += byte
            answer = json.loads(text)
            assert "error" not in answer, answer
            self._note(answer.get("method"), answer.get("params", {}))
            if is_wanted(answer):
                return answer

    def _note(self, method: str | None, about: dict[str, Any]) -> None:
        if method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(about["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning"):
            self.errors.append(json.dumps(about["args"]))
        elif method == "Log.entryAdded" and about["entry"]["level"] in ("error", "warning"):
            self.errors.append(about["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            address = about["request"]["url"]
            # The page itself, and data inside it.
            if not address.startswith(("file:", "data:", "blob:")):
                self.requests.append(address)

    def open(
        self, page: Path | str, width: int = 1280, height: int = 900, scheme: str = "light"
    ) -> None:
        """Load a file or an address in a window of this size, and wait until a report is drawn."""
        self.shown = (page, width, scheme)
        self.errors.clear()
        self.requests.clear()
        self(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1,
            mobile=width < 500,
        )  # fmt: skip
        self.set_scheme(scheme)
        self("Page.navigate", url=page if isinstance(page, str) else f"file://{page}")
        self._until(lambda answer: answer.get("method") == "Page.loadEventFired")
        self.run("window.report ? window.report.ready : null")

    def set_scheme(self, scheme: str) -> None:
        """Make the system light or dark."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self("Emulation.setEmulatedMedia", features=features)

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression; a promise is awaited."""
        found = self("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, script: str, seconds: float = 60.0) -> Any:
        """Wait until an expression is true, and return it."""
        end = time.monotonic() + seconds
        while not (found := self.run(script)):
            assert time.monotonic() < end, f"{script} stayed {found!r}; {self.errors}"
            time.sleep(0.05)
        return found

    def place(self, selector: str) -> dict[str, float]:
        """Return x, y, width and height of an element on the page."""
        return self.run(
            f"(({{ x, y, width, height }}) => ({{ x: x + scrollX, y: y + scrollY, width, height }}))"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )

    def picture(self, selector: str = "body") -> bytes:
        """Return a PNG of an element."""
        clip = {**self.place(selector), "scale": 1}
        shot = self("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)
        return base64.b64decode(shot["data"])

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at a point of the window, move it, and release it."""
        for kind, (x, y) in (
            ("mouseMoved", start), ("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end),
        ):  # fmt: skip
            self(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=1,
                clickCount=1,
            )


@contextmanager
def browser(profile: Path) -> Iterator[Tab]:
    """Start Chromium with an empty profile, and end it."""
    assert CHROMIUM is not None
    commands, to_browser = os.pipe()
    from_browser, answers = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", LAUNCH, str(commands), str(answers), CHROMIUM, *FLAGS,
         f"--user-data-dir={profile}"],
        pass_fds=(commands, answers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(commands)
    os.close(answers)
    with open(to_browser, "wb") as write, open(from_browser, "rb") as read:
        try:
            tab = Tab(read, write)
            yield tab
            tab("Browser.close")
        finally:
            process.kill()
            process.wait()
