"""The face's textures under the lights over which maps are integrated, factored into sums."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from facerf_cli.field import Field
from facerf_cli.light.sphere import RIG_LIGHTS, rig_directions

RANK = 96
_EVENNESS, _LEAST_BRIGHTNESS = 0.4, 0.03  # of a light: exponent; floor, as a share of the median
_TILE = 8  # a JPEG's blocks: tiles of the atlas begin on them
_ZERO, _STEPS = 128, 127  # the byte of 0 in a map, and that of its scale above it


@dataclass(frozen=True, eq=False)
class StageTextures:
    """Textures [L, 3, T, T] of lights [L, 3] as a product of coefficients [L, K] and maps [K, T, T, 3]."""

    directions: np.ndarray
    coefficients: np.ndarray
    maps: np.ndarray

    @staticmethod
    def of(field: Field, rank: int = RANK) -> "StageTextures":
        """Predict and factor the textures of the 150 lights of `facerf relight`."""
        rig = rig_directions(RIG_LIGHTS)
        textures = torch.cat(list(field.olats(rig))).permute(0, 2, 3, 1).numpy()
        seen = field.face.visible.numpy()
        brightness = _brightness(textures, seen)
        weights = np.sqrt(field.face.texture.permute(1, 2, 0).numpy().clip(1e-3)) * (seen[..., None] + 0.05)
        maps, coefficients = factored(textures / brightness[:, None, None, None], weights, rank)
        return StageTextures(rig.numpy(), coefficients * brightness[:, None], maps)


def _brightness(textures: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Brightness [L] by which textures are divided first: a dim light is shown at a higher exposure."""
    mean = (textures.mean(-1) * seen).sum((1, 2)) / max(float(seen.sum()), 1e-6)
    floor = max(_LEAST_BRIGHTNESS * float(np.median(mean)), 1e-6)
    return np.asarray(np.maximum(mean, floor) ** _EVENNESS, np.float32)


def factored(images: np.ndarray, weights: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Maps [K, ...] and orthonormal coefficients [L, K] whose products come nearest to images [L, ...].

    An error counts in proportion to `weights`, which broadcast to an image. By the eigenvectors of the
    Gram matrix of the images: there are far fewer lights than pixels.
    """
    flat = images.reshape(len(images), -1)
    weighted = flat * np.broadcast_to(weights, images.shape[1:]).reshape(-1)
    _, vectors = np.linalg.eigh((weighted @ weighted.T).astype(np.float64))
    coefficients = np.ascontiguousarray(vectors[:, ::-1][:, :rank], np.float32)
    return (coefficients.T @ flat).reshape(-1, *images.shape[1:]), coefficients


def atlas(maps: np.ndarray) -> tuple[np.ndarray, list[float], int, list[int]]:
    """Maps [K, h, w, 3] as bytes side by side, their scales, tiles in a row, and a tile's size."""
    count, height, width = maps.shape[:3]
    tile_h, tile_w = (-(-side // _TILE) * _TILE for side in (height, width))
    columns = max(1, round(math.sqrt(count * tile_h / tile_w)))
    data = np.full((-(-count // columns) * tile_h, columns * tile_w, 3), _ZERO, np.uint8)
    scales = [max(float(np.abs(one).max()), 1e-9) for one in maps]
    for index, (one, scale) in enumerate(zip(maps, scales, strict=True)):
        steps = np.round(_ZERO + _STEPS * one / scale).astype(np.uint8)
        top, left = index // columns * tile_h, index % columns * tile_w
        padding = ((0, tile_h - height), (0, tile_w - width), (0, 0))
        data[top : top + tile_h, left : left + tile_w] = np.pad(steps, padding, mode="edge")
    return data, scales, columns, [tile_w, tile_h]
