"""Offsets of frames, found in pixels."""

import numpy as np
import pytest

from facerf_cli.capture.checks.motion import peak


def test_a_sampled_parabola_has_its_maximum_between_samples() -> None:
    values = 3 - (np.arange(5.0) - 1.8) ** 2
    assert peak(values, 2) == pytest.approx(1.8)
    assert peak(values, 0) == 0.0 and peak(values, 4) == 4.0 and peak(np.ones(4), 2) == 2.0
