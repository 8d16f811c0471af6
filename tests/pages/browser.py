"""A headless Chromium, driven by its own protocol: opens a page, asks it in JavaScript, takes pictures."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (  # software rendering has to be asked for: without it WebGL is null and a test sees nothing
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--hide-scrollbars",
)
RENDERER = """(() => { const gl = document.createElement('canvas').getContext('webgl2');
if (!gl) return null; const info = gl.getExtension('WEBGL_debug_renderer_info');
return gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER); })()"""


class Tab:
    """The one tab of a browser."""

    def __init__(self, socket) -> None:
        self._socket, self._numbers = socket, count(1)

    def call(self, method: str, **given):
        """Answer of the browser to one of its methods."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": given}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]

    def ask(self, script: str):
        """Value of a JavaScript expression."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait_for(self, script: str, seconds: float = 30.0):
        """Value of an expression as soon as it is true."""
        until = time.monotonic() + seconds
        while not (value := self.ask(script)):
            assert time.monotonic() < until, f"still not: {script}\n{self.ask('document.body.innerText')}"
            time.sleep(0.2)
        return value

    def text(self) -> str:
        """All that one can read."""
        return self.ask("document.body.innerText")

    def picture(self) -> bytes:
        """Take what the tab shows, as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])


@contextmanager
def chromium(width: int = 1200, height: int = 800, *, modest: bool = False) -> Iterator[Tab]:
    """Yield a tab of a browser of its own; a ``modest`` one gets what processor others leave."""
    from websockets.sync.client import connect

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [
            *(("nice", "-n", "19") if modest else ()),
            CHROMIUM,
            *FLAGS,
            f"--window-size={width},{height}",
            "--remote-debugging-port=0",
            f"--user-data-dir={folder}",
            "about:blank",
        ]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=dict(os.environ))
        try:
            port = _port(Path(folder) / "DevToolsActivePort")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=30) as answer:
                address = next(page for page in json.load(answer) if page["type"] == "page")["webSocketDebuggerUrl"]
            with connect(address, max_size=None, open_timeout=30) as socket:
                yield Tab(socket)
        finally:
            process.terminate()
            process.wait(20)


def _port(file: Path) -> int:
    until = time.monotonic() + 30.0
    while not (file.exists() and file.read_text().strip()):
        assert time.monotonic() < until, "chromium did not start"
        time.sleep(0.1)
    return int(file.read_text().split()[0])
