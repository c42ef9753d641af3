"""A page of `facerf view` in headless Chromium: what it draws in several states, as it would save it."""

import base64
import html
import io
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

_BUDGET_MS = 1_000_000_000  # of virtual time, which runs on while the page waits for another thread
_AT_ONCE = 20  # states of a page in one run: what a run may take is limited
_BEGIN = """
const waiting = setInterval(() => {}, 20); // without a timer, virtual time runs out before the next frame
const settled = () => new Promise((done) => {
  const look = () => (document.body.dataset.settled === "true" ? done() : setTimeout(look, 20));
  look();
});
const frames = async (count) => {
  for (let i = 0; i < count; i++) await new Promise((done) => requestAnimationFrame(done));
};
addEventListener("load", async () => {
  await settled();
  const results = await (async () => {
"""
_END = """
  })().catch((error) => ({ error: String(error) }));
  const out = document.createElement("pre");
  out.id = "results";
  out.textContent = JSON.stringify(results);
  document.body.append(out);
  clearInterval(waiting);
});
"""
_STATES = """
  const results = [];
  for (const address of %s) {
    document.body.dataset.settled = "";
    location.hash = `${address}&state=${results.length}`; // one that the page has not written itself
    await settled();
    const command = document.getElementById("command").textContent;
    results.push({ command, png: document.getElementById("view").toDataURL("image/png") });
  }
  return results;
"""


@dataclass(frozen=True)
class Drawn:
    """What a page drew: pixels [H, W, 4] in 0..255, and the command that it shows."""

    pixels: np.ndarray
    command: str

    @property
    def ev(self) -> float:
        """The exposure in the command; in the photo's own light it may have none, for 0 EV."""
        found = re.search(r"--exposure (\S+)", self.command)
        assert found or "original" in self.command
        return float(found[1]) if found else 0.0


def chromium() -> str:
    """The path of a browser; skips the test without one."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no chromium on this machine")
    return found


def with_script(page: str, script: str) -> str:
    """A page with a script of a test, which its content security policy would refuse."""
    open_page = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page, flags=re.S)
    return open_page.replace("</body>", f"<script>{script}</script></body>")


def dumped(page: str, folder: Path, *options: str, timeout_s: int = 900) -> str:
    """The document of a page after its scripts have run."""
    made = folder / "driven.html"
    made.write_text(page, encoding="utf-8")
    command = [chromium(), "--headless", "--no-sandbox", "--force-color-profile=srgb", "--dump-dom"]
    command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", *options]
    command += [f"--virtual-time-budget={_BUDGET_MS}", f"--user-data-dir={folder / 'profile'}", made.as_uri()]
    done = subprocess.run(command, capture_output=True, timeout=timeout_s, check=False)
    return done.stdout.decode("utf-8", "replace")


def driven(page: str, script: str, folder: Path, *options: str) -> Any:
    """What a script, the body of an async function, returns in a page once it has settled.

    It has `settled()` and `frames(n)` to wait with. Skips the test where the browser cannot.
    """
    document = dumped(with_script(page, _BEGIN + script + _END), folder, *options)
    found = re.search(r'<pre id="results">(.*?)</pre>', document, re.S)
    if found is None:
        message = re.search(r'<p id="message"[^>]*>(.*?)</p>', document, re.S)
        assert not (message and "cannot be shown" in message[1]), message
        pytest.skip("chromium runs no page here")
    results = json.loads(html.unescape(found[1]))
    assert not (isinstance(results, dict) and "error" in results), results["error"]
    return results


def drawn(page: str, addresses: Sequence[str], folder: Path, *options: str) -> list[Drawn]:
    """What a page draws at each address."""
    found: list[Drawn] = []
    for first in range(0, len(addresses), _AT_ONCE):
        script = _STATES % json.dumps(addresses[first : first + _AT_ONCE])
        states = driven(page, script, folder, *options)
        found += [Drawn(_pixels(one["png"]), one["command"]) for one in states]
    return found


def _pixels(address: str) -> np.ndarray:
    data = base64.b64decode(address.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).astype(np.float64)
