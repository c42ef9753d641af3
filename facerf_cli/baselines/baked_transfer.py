"""A fitted mesh's transfer of light, baked once and kept in the user's cache for the next run.

    CACHE/transfer/KEY.npy   [2, K, t, t] float16; KEY is the digest of the mesh and of the bake's settings

The folder is kept below `_MOST_BYTES`: the oldest go first.
"""

import hashlib
import logging
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.errors import FacerfError
from facerf_cli.face.topology import GRID, LAYOUT_VERSION, grid_triangles
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.downloads import cache_folder
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.records import LOGGER_NAME, json_line

_MOST_BYTES = 256 << 20
_VERSION = 1  # of what is computed; a change of it leaves old files unused
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class TransferSettings:
    """Harmonics up to `order`, on `side` texels, from `lights` lamps as wide as their cells."""

    order: int = 4
    side: int = 128
    lights: int = 200
    lamp_samples: int = 4
    bounce_samples: int = 16
    blur_texels: float = 1.0  # against the grain of few samples


def baked_transfer(vertices_head: Tensor, settings: TransferSettings, cache: Path | None = None) -> Tensor:
    """Transfer vectors [2, K, t, t] of a mesh [V, 3] in the head frame, from the cache if they are there.

    Times a light's coefficients they give a white diffuse face's radiance: direct with its own shadows, and
    after one bounce off a face of albedo 1.
    """
    path = (cache or cache_folder() / "transfer") / f"{_key(vertices_head, settings)}.npy"
    kept = _read(path, settings)
    if kept is not None:
        return kept
    transfer = bake_transfer(vertices_head, settings).half()
    try:
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.save(file, transfer.numpy())
        _forget_oldest(path)
    except FacerfError as error:
        log.warning("%s; the next run bakes again", error)
    return transfer.float()


def bake_transfer(vertices_head: Tensor, settings: TransferSettings) -> Tensor:
    """The transfer, baked (Sloan, Kautz and Snyder, *Precomputed Radiance Transfer*, 2002)."""
    positions = bake_attributes(vertices_head, GRID, settings.side).permute(1, 2, 0)
    normals = normal_map(vertices_head, grid_triangles(), settings.side).permute(1, 2, 0)
    directions = rig_directions(settings.lights)
    cell_deg = float(np.degrees(2 / np.sqrt(settings.lights)))  # the radius of a cap of its solid angle
    transport = bake_transport(
        positions.numpy(),
        normals.numpy(),
        vertices_head.numpy(),
        grid_triangles().numpy(),
        directions.numpy(),
        BakeSettings(settings.lamp_samples, cell_deg, settings.bounce_samples),
    )
    cosines = torch.einsum("lc,ijc->lij", directions, normals).clamp_min(0)
    direct = torch.from_numpy(transport.visibility) * cosines
    both = torch.stack([direct, torch.from_numpy(transport.bounce).float()])
    # Sum over equal cells of 4 pi / L; over pi as the coefficients are of radiance.
    basis = sh_basis(directions, settings.order) * (4 / settings.lights)
    transfer = torch.einsum("lk,nlij->nkij", basis, both).numpy()
    blur = settings.blur_texels
    return torch.from_numpy(gaussian_filter(transfer, (0, 0, blur, blur), mode="nearest"))


def _key(vertices_head: Tensor, settings: TransferSettings) -> str:
    rounded_um = np.round(vertices_head.double().numpy() * 1e6).astype(np.int64)
    made = json_line({"version": _VERSION, "layout": LAYOUT_VERSION, **asdict(settings)})
    return hashlib.sha256(made.encode() + rounded_um.tobytes()).hexdigest()[:32]


def _read(path: Path, settings: TransferSettings) -> Tensor | None:
    """What is kept; None where nothing is, or nothing whole."""
    shape = (2, (settings.order + 1) ** 2, settings.side, settings.side)
    try:
        kept = np.load(path, allow_pickle=False)
        os.utime(path)  # it was of use
    except (OSError, ValueError, EOFError):
        return None
    if kept.shape != shape or kept.dtype != np.float16 or not np.isfinite(kept).all():
        return None
    return torch.from_numpy(kept).float()


def _forget_oldest(newest: Path) -> None:
    """Remove files that were not used for longest until the folder is small enough; others may do so, too."""
    found = []
    for path in newest.parent.glob("*.npy"):
        try:
            facts = path.stat()
            found.append((facts.st_mtime_ns, facts.st_size, path))
        except OSError:
            continue
    total = sum(size for _, size, _ in found)
    for _, size, path in sorted(found):
        if total <= _MOST_BYTES or path == newest:
            break
        path.unlink(missing_ok=True)
        total -= size
