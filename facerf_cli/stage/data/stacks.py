"""A dataset's OLAT stacks: what goes into one beside its lights' pictures."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from facerf_cli.face.fit import FaceFit, fit_to_arrays
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.raster.rasterize import front_facing, interpolate, rasterize
from facerf_cli.raster.texture import vertex_normals


def constant_weights(directions: np.ndarray) -> np.ndarray:
    """Weights [L] of lights [L, 3] under a map of radiance 1: the solid angle of each one's cell over pi."""
    white = torch.ones(2, 4, 3)
    return envmap_weights(white, torch.from_numpy(directions).float())[:, 0].numpy()


def stack_header(
    model: MorphableModel,
    fit: FaceFit,
    directions: np.ndarray,
    source: np.ndarray,
    inside: np.ndarray,
    metadata: Mapping[str, Any],
) -> StackHeader:
    """The header of a stack of pictures [S, S, 3] in a fit's crop, lit from camera-space directions [L, 3].

    `source` [S, S, 3] is the crop under a constant map of radiance 1; `inside` [S, S] tells which of its
    pixels the photo holds. The face is seen where the front of the fitted mesh covers those.
    """
    vertices, triangles = fit.vertices_camera(model), grid_triangles()
    fragments = rasterize(vertices, triangles, fit.camera)
    front = front_facing(vertices, triangles)[fragments.triangle] & fragments.covered
    normals = interpolate(vertex_normals(vertices, triangles), triangles, fragments)
    normals = torch.nn.functional.normalize(normals, dim=-1)
    return StackHeader(
        kind="image",
        directions=directions,
        rotation=fit.rotation.double().numpy(),
        source=source,
        seen=(front.numpy() & inside).astype(np.float32),
        normals=normals.numpy(),
        layout_version=LAYOUT_VERSION,
        fit=fit_to_arrays(fit),
        metadata=dict(metadata),
    )
