"""Uniform draws lie between their bounds and have the requested shape."""

import torch

from facerf_cli.synth.random_fields import Uniform


def test_uniform_numbers_fill_their_bounds() -> None:
    uniform = Uniform(torch.Generator().manual_seed(0), (2, 1000))
    numbers = uniform(-3, 5)
    assert numbers.shape == (2, 1000) and uniform(0, 1, 4, 1).shape == (4, 1)
    assert -3 <= float(numbers.min()) < -2.9 and 4.9 < float(numbers.max()) <= 5
    assert abs(float(numbers.mean()) - 1) < 0.2
    assert Uniform(torch.Generator().manual_seed(0))(2, 2).shape == ()
