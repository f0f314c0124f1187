"""Chromium without a window, as far as tests need it: its DevTools protocol through two pipes, which takes no library."""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from contextlib import contextmanager

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--remote-debugging-pipe",
)
# What a person sees: Bokeh's widgets keep their content in trees of their own
TEXT = """(() => {
    const text = node => {
        if (node.nodeType === Node.TEXT_NODE) return node.textContent;
        if (node.nodeType === Node.ELEMENT_NODE) {
            if (["STYLE", "SCRIPT", "TEMPLATE"].includes(node.tagName)) return "";
            if (getComputedStyle(node).display === "none") return "";
            if (node.tagName === "DETAILS" && !node.open) {
                // Not there yet while the page is read
                const summary = node.querySelector("summary");
                return summary === null ? "" : text(summary);
            }
        }
        const children = [...(node.shadowRoot ? node.shadowRoot.childNodes : []), ...node.childNodes];
        return children.map(text).join(" ");
    };
    return document.body === null ? "" : text(document.body).replace(/\\s+/g, " ");
})()"""
PICTURES = """(() => {
    const all = node => [
        ...node.querySelectorAll("img"),
        ...[...node.querySelectorAll("*")].filter(one => one.shadowRoot).flatMap(one => all(one.shadowRoot)),
    ];
    return all(document).map(one => [one.alt, one.naturalWidth, one.getBoundingClientRect().width]);
})()"""
OVERFLOW = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


def find():
    """Its path, None where there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page, with what it asked for and what it complained of."""

    def __init__(self, write, read):
        self._write, self._read, self._left, self._number, self._session = write, read, b"", 0, None
        self.requests, self.complaints = [], []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **parameters):
        self._number += 1
        number = self._number
        message = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next(60.0)
            if answer.get("id") == number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def _next(self, seconds):
        deadline = time.monotonic() + seconds
        while b"\0" not in self._left:
            ready, _, _ = select.select([self._read], [], [], max(0.0, deadline - time.monotonic()))
            data = os.read(self._read, 1 << 20) if ready else b""
            assert data, "Chromium does not answer"
            self._left += data
        message, _, self._left = self._left.partition(b"\0")
        message = json.loads(message)
        self._note(message.get("method"), message.get("params", {}))
        return message

    def _note(self, method, parameters):
        if method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.requests.append(parameters["url"])
        elif method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(parameters["exceptionDetails"]))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] in ("warning", "error"):
            self.complaints.append(parameters["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("warning", "error", "assert"):
            self.complaints.append(json.dumps(parameters["args"]))

    def open(self, url, width=1200, height=1600):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.call("Page.navigate", url=url)

    def evaluate(self, script):
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self):
        return self.evaluate(TEXT)

    def wait_for(self, *parts, seconds=90.0):
        """Until the page says all of these; what it says then."""
        deadline = time.monotonic() + seconds
        while True:
            text = self.text()
            missing = [part for part in parts if part not in text]
            if not missing:
                return text
            assert time.monotonic() < deadline, f"it does not say {missing}: {text}"
            time.sleep(0.2)

    def screenshot(self, path, whole=True):
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"clip": {**size, "scale": 1}, "captureBeyondViewport": True} if whole else {}
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png", **clip)["data"]))


@contextmanager
def browser(profile):
    """A new Chromium with a fresh profile in this folder."""
    read_commands, write = os.pipe()
    read, write_answers = os.pipe()
    command = [find(), *FLAGS, f"--user-data-dir={profile}"]
    # Chromium reads from 3 and writes to 4
    script = f'exec "$@" 3<&{read_commands} 4>&{write_answers}'
    process = subprocess.Popen(
        ["bash", "-c", script, "bash", *command],
        pass_fds=(read_commands, write_answers),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(read_commands)
    os.close(write_answers)
    try:
        yield Browser(write, read)
    finally:
        os.close(write)
        os.close(read)
        process.terminate()
        process.wait(30)
