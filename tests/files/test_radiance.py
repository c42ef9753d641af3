"""Radiance's .hdr files: the orders of their axes, their three forms, and what their headers say."""

from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.read import read_image
from tests.files.made import MAP, TO_709, H, W, long_runs, write_hdr
from tests.kinds import Log


@pytest.mark.parametrize("form", ["plain", "old", "new"])
@pytest.mark.parametrize("order", ["-Y +X", "-Y -X", "+Y -X", "+Y +X", "+X -Y", "-X -Y", "-X +Y", "+X +Y"])
def test_eight_orders_of_axes_and_three_forms(tmp_path: Path, order: str, form: str) -> None:
    path = write_hdr(tmp_path / "a.hdr", MAP, "", order, form)
    np.testing.assert_allclose(read_image(path).pixels, MAP, atol=0.005)


def test_long_old_runs(tmp_path: Path) -> None:
    path = long_runs(tmp_path / "a.hdr")
    assert read_image(path).pixels == pytest.approx(0.25) and path.stat().st_size < 150


def test_exposures_corrections_and_primaries_are_undone(tmp_path: Path, caplog: Log) -> None:
    head = "EXPOSURE=2.0\nEXPOSURE= 3\nCOLORCORR= 1 0.5 .25\n"
    stored = MAP * 6 * (1, 0.5, 0.25)
    np.testing.assert_allclose(
        read_image(write_hdr(tmp_path / "a.hdr", stored, head)).pixels, MAP, rtol=0.02, atol=0.005
    )
    for zeros in ("0 0 0", "0 0 0 0 0 0 0 0"):  # as in the maps of Poly Haven
        found = read_image(write_hdr(tmp_path / "0.hdr", MAP, f"PRIMARIES={zeros}\n"))
        np.testing.assert_allclose(found.pixels, MAP, rtol=0.02, atol=0.005)
    assert caplog.text == ""
    head = "PRIMARIES=0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n"
    found = read_image(write_hdr(tmp_path / "b.hdr", MAP, head)).pixels
    np.testing.assert_allclose(found, MAP @ TO_709.T, atol=0.005)
    wide = read_image(write_hdr(tmp_path / "c.hdr", MAP, "PIXASPECT=0.5\n")).pixels
    assert wide.shape == (H, 2 * W, 3)
