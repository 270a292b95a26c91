"""Chromium as a person has it: a window that is never resized, asked from outside."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import json
from pathlib import Path
import shutil
import subprocess
import tempfile
import threading
import time
from typing import Any
from urllib.request import urlopen

import pytest

OPTIONS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader"
    " --enable-unsafe-swiftshader --no-first-run --disable-background-networking"
    " --disable-component-update --disable-sync --hide-scrollbars"
    " --remote-debugging-port=0 --remote-allow-origins=* about:blank"
)
PATIENCE = 240.0  # A busy machine without a graphics card takes seconds for a frame.
# The second of two frames begins once the first has been drawn, however slowly.
AFTER_A_FRAME = """new Promise((done) => requestAnimationFrame(
  () => requestAnimationFrame(
    () => done(document.readyState === "complete" ? %s : null))))"""


class Page:
    """A tab of a running browser, spoken to by the DevTools protocol.

    Attributes:
        errors: What went wrong in the page, one text an error.
    """

    def __init__(self, socket: Any) -> None:
        self.errors: list[str] = []
        self._socket = socket
        self._count = 0
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The browser's answer to a command."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        self._socket.send(json.dumps(message))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def open(self, address: str) -> None:
        """Goes to an address."""
        self.call("Page.navigate", url=address)

    def reload(self) -> None:
        """Loads the page again; the old one is gone when this returns."""
        self.call("Page.reload")
        event: dict[str, Any] = {}
        while event.get("method") != "Page.loadEventFired":
            event = json.loads(self._socket.recv())
            self._note(event.get("method"), event.get("params", {}))

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression, as JSON has it; promises are kept."""
        how = {"returnByValue": True, "awaitPromise": True}
        answer = self.call("Runtime.evaluate", expression=script, **how)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def settle(self, script: str) -> Any:
        """The value of an expression once it is not null and stays as it is.

        Nothing that the value depends on may be read later than the expression stops
        being null: a value that waits for it for a second would count as settled.

        Raises:
            AssertionError: It has not come to rest after a minute.
        """
        values: list[Any] = []
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            time.sleep(0.3)
            values.append(self.evaluate(AFTER_A_FRAME % script))
            if len(values) > 3 and values[-1] == values[-2] == values[-3] is not None:
                return values[-1]
        raise AssertionError(f"{script} did not come to rest: {values[-3:]}")

    def _note(self, kind: str | None, event: dict[str, Any]) -> None:
        if kind == "Runtime.exceptionThrown":
            self.errors.append(str(event["exceptionDetails"]))
        elif kind == "Runtime.consoleAPICalled" and event["type"] == "error":
            self.errors.append(str(event["args"]))
        elif kind == "Log.entryAdded" and event["entry"]["level"] == "error":
            self.errors.append(str(event["entry"]))


@contextmanager
def browser(width: int = 1280, height: int = 800) -> Iterator[Page]:
    """A browser's only tab; the test is skipped where there is no browser."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on PATH")
    websocket = pytest.importorskip("websocket", reason="no websocket-client")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = [f"--user-data-dir={profile}", f"--window-size={width},{height}"]
        process = subprocess.Popen(
            [chromium, *options, *OPTIONS.split()],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            address = _debugging_address(process, Path(profile, "DevToolsActivePort"))
            with closing(websocket.create_connection(address, timeout=PATIENCE)) as s:
                yield Page(s)
        finally:
            process.terminate()
            process.wait()


def _debugging_address(process: subprocess.Popen[bytes], ready: Path) -> str:
    for _ in range(int(PATIENCE / 0.1)):
        if process.poll() is not None:
            pytest.skip(f"chromium does not run here: it ended with {process.poll()}")
        if ready.exists() and ready.read_text().strip():
            break
        time.sleep(0.1)
    port = ready.read_text().split()[0]
    with urlopen(f"http://127.0.0.1:{port}/json") as answer:
        tabs = json.load(answer)
    return next(t["webSocketDebuggerUrl"] for t in tabs if t["type"] == "page")


class _Files(SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/favicon.ico":  # Browsers ask for it; its absence is no error.
            self.send_response(204)
            self.end_headers()
        else:
            super().do_GET()

    def log_message(self, *args: Any) -> None:
        """Nothing."""


@contextmanager
def served(directory: Path) -> Iterator[str]:
    """The address under which a directory is served while the context lasts."""
    handler = partial(_Files, directory=str(directory))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
