"""The page in a browser: its pixels agree with the numpy twin. Skipped where no Chromium is installed."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerf_cli.viewer.packing import PageMap, packed
from facerf_cli.viewer.page import page
from tests.oracles.viewer_page import Page, direction, document_of
from tests.viewer import toy_basis as toy

# The smallest window of Chromium is wider than the toy, so the frame is scaled by a whole number.
SCALE = 5
MAPS = [PageMap("half", np.zeros((8, 16, 3), np.float32), "facerf envmap -o maps", "maps/half.exr")]
MAPS[0].pixels[:, :8] = 0.7  # azimuth 0 to 180: light from the right


def chromium() -> str:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no chromium on this machine")
    return found


def screenshot(folder: Path, address: str, *options: str) -> np.ndarray:
    """What Chromium shows of a page [H, W, 3], the panel hidden."""
    made = folder / "me.html"
    made.write_text(page("me", "me.jpg", packed(toy.basis(), MAPS), ""), encoding="utf-8")
    shot = folder / "shot.png"
    size = f"{toy.WIDTH_PX * SCALE},{toy.HEIGHT_PX * SCALE}"
    command = [chromium(), "--headless", "--no-sandbox", "--hide-scrollbars", "--force-color-profile=srgb"]
    command += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--virtual-time-budget=20000"]
    command += [f"--user-data-dir={folder / 'profile'}", f"--window-size={size}", f"--screenshot={shot}"]
    command += [*options, f"{made.as_uri()}#{address}&panel=0"]
    subprocess.run(command, capture_output=True, timeout=240, check=False)
    if not shot.exists():
        pytest.skip("chromium takes no screenshot here")
    return np.asarray(Image.open(shot).convert("RGB")).astype(np.float64)


def small(shot: np.ndarray) -> np.ndarray:
    """The middle of each scaled pixel."""
    return shot[SCALE // 2 :: SCALE, SCALE // 2 :: SCALE]


def inside() -> np.ndarray:
    """Pixels of the person whose neighbours are, too: those that scaling does not mix with others."""
    matte = toy.matte() > 0
    for axis in (0, 1):
        matte = matte & np.roll(matte, 1, axis) & np.roll(matte, -1, axis)
    return matte


def test_single_lights_agree(tmp_path: Path) -> None:
    twin = Page(document_of(page("me", "me.jpg", packed(toy.basis(), MAPS), "")))
    shown = small(screenshot(tmp_path, "light=75,20,1,0.5,0.25;-150,10&ev=-0.5"))
    lights = [(direction(75, 20), np.array([1, 0.5, 0.25])), (direction(-150, 10), np.ones(3))]
    error = np.abs(shown - twin.shown(twin.sums(lights), -0.5))[inside()]
    assert error.mean() < 1.5 and np.percentile(error, 99) < 5


def test_exposure_and_a_rotated_map_agree(tmp_path: Path) -> None:
    twin = Page(document_of(page("me", "me.jpg", packed(toy.basis(), MAPS), "")))
    shown = small(screenshot(tmp_path, "env=half&rotate=-90"))
    # Light from azimuth -90 to 90, of radiance 0.7: over each light of the stage its integral over pi.
    stage = twin.stage()
    share = 0.7 * 4 / len(stage) * (stage[:, 2] > 0)
    sums = twin.sums([(toward, np.full(3, weight)) for toward, weight in zip(stage, share, strict=True)])
    error = np.abs(shown - twin.shown(sums, twin.exposure_ev(sums)))[inside()]
    assert error.mean() < 4  # cells of 18 degrees at the border of the lit half


def test_without_webgl_the_photo_is_relit_and_said_so(tmp_path: Path) -> None:
    twin = Page(document_of(page("me", "me.jpg", packed(toy.basis(), MAPS), "")))
    address = "light=40,10&ev=0"
    shown = small(screenshot(tmp_path, address, "--disable-3d-apis"))
    error = np.abs(shown - twin.shown(twin.sums([(direction(40, 10), np.ones(3))]), 0.0))[inside()]
    assert np.median(error) < 3  # nearest pixels of the maps
