"""A sample of a stage depends on no neighbour, and a batch's terms are the means of its samples'."""

import torch
from torch import Tensor

from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.training.objective import Objective, seeded


def assert_samples_are_alone(stage: Objective, count: int = 3) -> None:
    whole = stage.draw(count, lambda i: seeded(1, i), 0)
    parts = [stage.draw(1, lambda i, k=k: seeded(1, k), 0) for k in range(count)]
    for one, other in zip(_tensors(whole), _tensors(concatenate(parts)), strict=True):
        assert torch.equal(one, other)
    terms = [stage(part) for part in parts]
    for name, value in stage(whole).items():
        mean = torch.stack([term[name] for term in terms]).mean()
        torch.testing.assert_close(value, mean, rtol=1e-3, atol=1e-6, msg=name)


def _tensors(batch: Batch) -> list[Tensor]:
    tensors: list[Tensor] = []
    batch.each(lambda values: (tensors.append(values), values)[1])
    return tensors
