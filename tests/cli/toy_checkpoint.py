"""A small untrained Reflectance Network in a checkpoint, for tests of the command line."""

from pathlib import Path

import torch

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings
from facerf_cli.raster.texture import normal_map

WIDTHS = (4, 8, 8)


def save_toy_checkpoint(path: Path) -> DefaultReflectanceNetwork:
    """Save the network, and return it."""
    torch.manual_seed(0)
    network = DefaultReflectanceNetwork(DefaultReflectanceSettings(64, WIDTHS, WIDTHS, rig_lights=8))
    normals = normal_map(load_face_model("builtin").mean, grid_triangles(), 64)
    network.set_mean_face(normals, torch.ones(8, 64, 64), rig_directions(8))
    save_networks(path, {"reflectance": network}, {"layout_version": LAYOUT_VERSION})
    return network
