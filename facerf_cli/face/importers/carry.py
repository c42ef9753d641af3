"""A model in its own topology becomes one in the canonical (DESIGN, 'One topology inside')."""

import numpy as np
import torch

from facerf_cli.face.importers.carried_head import carried_head
from facerf_cli.face.importers.registration import register, rigid_alignment
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LANDMARKS_M


def carry_over(source: SourceModel) -> MorphableModel:
    """Carry a model to the canonical topology: its landmarks warp the chart, rays find its surface."""
    rotation, translation = rigid_alignment(source.landmarks, LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights = register(mean, source.triangles, source.landmarks @ rotation.T + translation)

    def carried(field: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(
            np.einsum("...vkc,vk->...vc", field[..., corners, :], weights).astype(np.float32)
        )

    return MorphableModel(
        name=source.name,
        licence=source.licence,
        mean=carried(mean),
        identity=carried(source.identity @ rotation.T),
        expression=carried(source.expression @ rotation.T),
        expression_names=source.expression_names,
        head=None if source.head is None else carried_head(source, source.head, carried(mean).numpy()),
    )
