"""The report opened in headless Chromium: nothing complains, all images decode, nothing is cut off.

Skipped where there is no such browser (`apt-get install chromium`).
"""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.evaluation.toy_protocol import evaluate

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--disable-dev-shm-usage")
# What the page knows of itself when it has loaded; only the test's copy has a script.
SCRIPT = """<script>addEventListener("load", () => {
  const images = [...document.images], root = document.documentElement;
  const facts = {
    widths: images.map(i => i.naturalWidth), alts: images.map(i => i.alt.length),
    fetched: performance.getEntriesByType("resource").filter(e => !e.name.startsWith("data:")).length,
    overflow: root.scrollWidth - innerWidth, width: innerWidth,
    tables: [...document.querySelectorAll("table")].map(t => t.rows.length),
    cells: [...document.querySelectorAll("main table")][0].innerText,
    drawn: [...document.querySelectorAll("td.plot svg")].map(s => s.getBoundingClientRect().width) };
  const output = document.createElement("output");
  output.textContent = JSON.stringify(facts);
  document.body.append(output);
});</script>"""


@pytest.fixture(scope="module")
def browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is on PATH; install chromium to look at the report")
    return found


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert evaluate(folder) == 0
    return folder / "report.html"


def run(browser: str, folder: Path, page: Path, *flags: str) -> tuple[str, str]:
    profile = f"--user-data-dir={folder / 'profile'}"
    line = [browser, *FLAGS, profile, "--enable-logging=stderr", *flags, page.as_uri()]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


def _complaining(report: Path, folder: Path) -> Path:
    page = folder / "complaining.html"
    page.write_text(report.read_text().replace("</body>", "<script>what is wrong</script></body>"))
    return page


@pytest.mark.parametrize("width", [1280, 500])
def test_it_loads_whole(browser: str, report: Path, tmp_path: Path, width: int) -> None:
    copy = tmp_path / "copy.html"
    copy.write_text(report.read_text().replace("</body>", f"{SCRIPT}</body>"))
    dom, console = run(browser, tmp_path, copy, f"--window-size={width},900", "--dump-dom")
    assert not console
    facts = json.loads(unescape(re.search(r"<output>(.*?)</output>", dom, re.S)[1]))
    assert facts["width"] == width and facts["overflow"] <= 0 and facts["fetched"] == 0
    assert len(facts["widths"]) == 12 and min(facts["widths"]) > 300 and min(facts["alts"]) > 20
    figures = json.loads((report.parent / "summary.json").read_text())["groups"][0]["metrics"]["si_mse"]
    assert all(
        f"{figure[name]:.5f}" in facts["cells"] for figure in figures.values() for name in ("mean", "sd")
    )
    assert min(facts["tables"]) >= 3 and min(w for w in facts["drawn"] if w) > 60


def test_it_can_be_looked_at(browser: str, report: Path, tmp_path: Path) -> None:
    target = tmp_path / "shot.png"
    _, complaints = run(browser, tmp_path, _complaining(report, tmp_path), "--dump-dom")
    assert "Unexpected identifier" in complaints  # or the line below could not fail
    _, console = run(browser, tmp_path, report, "--window-size=1000,1400", f"--screenshot={target}")
    shot = np.asarray(Image.open(target).convert("RGB"))
    assert not console and shot.shape == (1400, 1000, 3)
    assert len(np.unique(shot.astype(int) @ [1 << 16, 1 << 8, 1])) > 100  # text and drawings, no blank page
    assert (shot[:, :10] == shot[0, 0]).all()  # margins are clear
