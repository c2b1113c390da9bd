"""A headless Chromium for tests of the web pages: it goes to a page, really clicks, types and drags, and takes pictures."""

import base64
import io
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

T = TypeVar("T")
SHIFT, CONTROL = 8, 2
"""Modifiers of clicks and keys, to be added up."""
_CODES = {"Enter": 13, "Tab": 9, "Escape": 27, "Backspace": 8, "Delete": 46, "End": 35, "Home": 36, "PageUp": 33, "PageDown": 34,
          "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, " ": 32}  # fmt: skip


@contextmanager
def chromium(folder: Path, url: str, size: tuple[int, int] = (1100, 700), webgl: bool = True) -> Iterator["Chromium"]:
    """A browser on a page, closed at the end; `folder` keeps its profile. Skips the test where none is installed.

    Pages that need no WebGL are drawn many times faster without: a processor that plays graphics card is slow.
    """
    binary = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if binary is None:
        pytest.skip("no Chromium found: apt-get install chromium")
    browser = Chromium(binary, folder, url, size, webgl)
    try:
        yield browser
    finally:
        browser.close()


class Chromium:
    """One browser window, spoken to over its debugging socket. Positions are pixels from the upper left."""

    def __init__(self, binary: str, folder: Path, url: str, size: tuple[int, int] = (1100, 700), webgl: bool = True):
        drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] if webgl else ["--disable-gpu"]
        command = [
            binary,
            "--headless=new",
            "--no-sandbox",
            *drawing,
            "--hide-scrollbars",
            f"--window-size={size[0]},{size[1]}",
            f"--user-data-dir={folder}",
            "--remote-debugging-port=0",
            "--remote-allow-origins=*",
            "about:blank",
        ]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.count, self.exceptions = 0, []
        port = self.poll(lambda: (folder / "DevToolsActivePort").read_text().split()[0])
        targets = self.poll(lambda: [t for t in self._targets(port) if t["type"] == "page"])
        self.socket = connect(targets[0]["webSocketDebuggerUrl"], max_size=2**26)
        self.call(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
        )
        self.call("Runtime.enable")
        self.go(url)

    @staticmethod
    def _targets(port: str) -> list[dict]:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as reply:
            return json.load(reply)

    @staticmethod
    def poll(ask: Callable[[], T], seconds: float = 60.0) -> T:
        """Ask until the answer is truthy, and return it; the test fails when the time is over."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                if answer := ask():
                    return answer
            except (OSError, IndexError):  # not there yet, or a page on its way
                pass
            time.sleep(0.2)
        pytest.fail("the browser did not get there in time")

    def call(self, method: str, **parameters) -> dict:
        """A command of the DevTools protocol, and its result."""
        self.count += 1
        self.socket.send(json.dumps({"id": self.count, "method": method, "params": parameters}))
        while (reply := json.loads(self.socket.recv(timeout=60))).get("id") != self.count:
            if reply.get("method") == "Runtime.exceptionThrown":
                self.exceptions.append(reply["params"]["exceptionDetails"])
        if "navigated or closed" in str(reply.get("error")):
            raise ConnectionError(f"{method}: the page is on its way to another")
        assert "error" not in reply, f"{method}: {reply['error']}"
        return reply["result"]

    def go(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        self.poll(lambda: self.evaluate("document.readyState") == "complete")

    def evaluate(self, script: str):
        """The value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def screenshot(self, file: Path | None = None) -> np.ndarray:
        """RGB of the window; also written to a file."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            file.write_bytes(data)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def element(self, script: str) -> tuple[float, float]:
        """Centre of the element that a JavaScript expression finds, scrolled into view; waits until it is there."""
        ask = f"""(() => {{ const e = {script}; if (!e) return null; e.scrollIntoView({{block: 'nearest'}});
            const b = e.getBoundingClientRect(); return b.width ? [b.x + b.width / 2, b.y + b.height / 2] : null }})()"""
        return tuple(self.poll(lambda: self.evaluate(ask)))

    def labelled(self, text: str, among: str = "button") -> tuple[float, float]:
        """Centre of the first visible element of a CSS selector with just this text."""
        return self.element(
            f"[...document.querySelectorAll({json.dumps(among)})]"
            f".find(e => e.innerText.trim() === {json.dumps(text)} && e.offsetParent)"
        )

    def click(self, x: float, y: float, modifiers: int = 0, count: int = 1) -> None:
        """Move there, press and release; `count=2` for a double click."""
        self._mouse("mouseMoved", x, y, modifiers)
        for number in range(1, count + 1):
            self._mouse("mousePressed", x, y, modifiers, number)
            self._mouse("mouseReleased", x, y, modifiers, number)

    def click_until(self, find: Callable[[], tuple[float, float]], wanted: Callable[[], bool]) -> None:
        """Click what is found until it has done what is wanted: on a page that is being laid out a click may miss."""
        for _ in range(6):
            self.click(*find())
            end = time.monotonic() + 6
            while time.monotonic() < end:
                if wanted():
                    return
                time.sleep(0.1)
        pytest.fail("a click did nothing")

    def press(self, label: str, wanted: Callable[[], bool]) -> None:
        """Press a button until it has done what is wanted."""
        self.click_until(lambda: self.labelled(label), wanted)

    def drag(self, way: list[tuple[float, float]], modifiers: int = 0, pause_s: float = 0.06) -> None:
        """Press at the first place, go through the others, release at the last."""
        self._mouse("mouseMoved", *way[0], modifiers)
        self._mouse("mousePressed", *way[0], modifiers, 1)
        for x, y in way[1:]:
            time.sleep(pause_s)
            self._mouse("mouseMoved", x, y, modifiers, pressed=True)
        time.sleep(pause_s)
        self._mouse("mouseReleased", *way[-1], modifiers, 1)

    def _mouse(self, kind: str, x: float, y: float, modifiers: int, count: int = 0, pressed: bool = False) -> None:
        button = {"button": "left"} if count or pressed else {}
        held = 1 if pressed or kind == "mousePressed" else 0
        self.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            modifiers=modifiers,
            clickCount=count,
            buttons=held,
            **button,
        )

    def key(self, key: str, modifiers: int = 0) -> None:
        """Press and release one key: a character, or a name such as Enter or ArrowLeft."""
        single = len(key) == 1
        code = _CODES.get(key) or ord(key.upper())
        name = "Space" if key == " " else key
        if single and key.isalnum():
            name = f"Key{key.upper()}" if key.isalpha() else f"Digit{key}"
        about = {"key": key, "code": name, "windowsVirtualKeyCode": code, "modifiers": modifiers}
        typed = "\r" if key == "Enter" else key if single and not modifiers & CONTROL else None
        self.call("Input.dispatchKeyEvent", type="keyDown", **about, **({"text": typed} if typed else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def fill(self, x: float, y: float, text: str) -> None:
        """Click into a text field, replace what it holds, and leave it with Enter."""
        self.click(x, y, count=3)
        self.key("a", CONTROL)
        self.call("Input.insertText", text=text)
        self.key("Enter")

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(20)
