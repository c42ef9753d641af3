"""Mixed precision where it is wanted and possible."""

import logging

import pytest
import torch

from facerf_cli.network import base
from facerf_cli.network.base import mixed_precision

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _fresh() -> None:
    base._has_bf16.cache_clear()


@pytest.mark.parametrize(("wanted", "has"), [(True, True), (True, False), (False, True)])
def test_bfloat16_needs_the_wish_and_the_instructions(
    wanted: bool, has: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: has, raising=False)
    caplog.set_level(logging.INFO)
    layer, x = torch.nn.Linear(2, 2), torch.ones(1, 2)
    for _ in range(2):
        with mixed_precision(CPU, wanted):
            assert layer(x).dtype is (torch.bfloat16 if wanted and has else torch.float32)
    assert len(caplog.messages) == (wanted and not has)
