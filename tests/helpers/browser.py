"""A headless Chromium driven through its DevTools protocol: open a page, press its buttons, take a picture."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu-sandbox",
    "--use-angle=swiftshader",
    "--no-first-run",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--window-size=1100,700",
    "--disable-dev-shm-usage",
)


def find_browser() -> str | None:
    """The program, if there is one."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Tab:
    """One page in the browser."""

    def __init__(self, socket):
        self.socket, self.number = socket, 0

    def call(self, method: str, **values) -> dict:
        """Send a command of the protocol and wait for its result."""
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": values}))
        while True:
            answer = json.loads(self.socket.recv(timeout=180))
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]

    def text(self) -> str:
        """All text that can be read on the page."""
        return self.run("document.body?.innerText ?? ''")

    def run(self, script: str):
        """The value of a line of JavaScript."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def press(self, label: str) -> None:
        """Click the button with this label."""
        named = f"b => b.innerText.trim() == {json.dumps(label)}"
        assert self.run(f"[...document.querySelectorAll('button')].filter({named}).map(b => b.click()).length") == 1

    def wait_for(self, text: str, seconds: float = 60) -> None:
        """Until the page shows a text."""
        end = time.monotonic() + seconds
        while text not in self.text():
            assert time.monotonic() < end, f"{text!r} never appeared; the page reads: {self.text()!r}"
            time.sleep(0.2)

    def picture(self, path: Path) -> Path:
        """A PNG of the page."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return path


@contextlib.contextmanager
def open_tab(program: str, address: str, folder: Path) -> Iterator[Tab]:
    """A headless browser with one page; `folder` takes its profile."""
    from websockets.sync.client import connect

    words = [program, *FLAGS, f"--user-data-dir={folder}", "about:blank"]
    browser = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        note = folder / "DevToolsActivePort"
        for _ in range(300):
            if note.is_file() and len(note.read_text().split()) == 2:
                break
            time.sleep(0.1)
        port, path = note.read_text().split()
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as socket:
            tab = Tab(socket)
            pages = [info for info in tab.call("Target.getTargets")["targetInfos"] if info["type"] == "page"]
            target = pages[0]["targetId"]
        with connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_size=None) as socket:
            tab = Tab(socket)
            tab.call("Emulation.setFocusEmulationEnabled", enabled=True)  # a page in the background stands still
            tab.call("Page.bringToFront")
            tab.call("Page.navigate", url=address)
            yield tab
    finally:
        browser.terminate()
        browser.wait(timeout=30)
