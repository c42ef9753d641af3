"""Relightable images in the web format of CNR's Relight, which OpenLIME shows: info.json and JPEG planes.

The format is that of its README (github.com/cnr-isti-vclab/relight, 'Relight web format'): basis `rbf`,
colour space `mrgb`. A pixel of L images of lights, 3 L display values, is a mean and a weighted sum of P
components; the weights are stored in planes, three an image. Between lights the components are interpolated
by Gaussians of the distance of directions. Lights come from in front: the viewer has no others.
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import json_text

_INFO = "info.json"
_PLANES = 18  # of weights, a multiple of three
_QUALITY = 95
_BYTES, _ZERO = 255, 127  # of the basis: steps, and the byte of 0
_SPACING = 0.5  # sigma of the Gaussians, as a share of the distance between lights
_CLIPPED = 0.1  # percent of a plane's weights beyond the range of its bytes, on each side
_VALUES_AT_ONCE = 1 << 23


def write_relight_web(
    folder: Path,
    images: np.ndarray,
    directions: np.ndarray,
    metadata: dict[str, Any] | None = None,
) -> None:
    """Write display images [L, H, W, 3] in 0..255 of lights from unit directions [L, 3] to a folder."""
    lights, height, width, _ = images.shape
    planes = min(_PLANES, 3 * lights)
    mean, components = _principal(images, planes)
    some = [((values - mean) @ components.T)[::4] for _, values in _blocks(images)]
    low, high = np.percentile(np.concatenate(some), (_CLIPPED, 100 - _CLIPPED), axis=0)  # but for few pixels
    spread = np.maximum(high - low, 1e-6)
    document = {
        "width": width,
        "height": height,
        "format": "jpg",
        "type": "rbf",
        "colorspace": "mrgb",
        "nplanes": planes,
        "quality": _QUALITY,
        "sigma": _SPACING * float(np.sqrt(2 * np.pi / lights)),
        "lights": np.round(directions, 5).ravel().tolist(),
        "materials": [
            {
                "scale": spread.tolist(),
                "bias": (-low / spread).tolist(),
                "range": [_ZERO / max(float(np.abs(one).max()), 1e-9) for one in components],
            }
        ],
        "basis": _basis(mean, components),
        **(metadata or {}),
    }
    with atomic_path(folder) as temporary:
        temporary.mkdir()
        for first in range(0, planes, 3):
            stored = np.zeros((height * width, 3), np.uint8)
            for rows, values in _blocks(images):
                weights = (values - mean) @ components[first : first + 3].T
                part = (weights - low[first : first + 3]) / spread[first : first + 3]
                stored[rows] = np.round(part.clip(0, 1) * _BYTES)
            stream = io.BytesIO()
            plane = Image.fromarray(stored.reshape(height, width, 3))
            plane.save(stream, "JPEG", quality=_QUALITY, subsampling=0)
            (temporary / f"plane_{first // 3}.jpg").write_bytes(stream.getvalue())
        (temporary / _INFO).write_text(json_text(document), encoding="utf-8")


def _blocks(images: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Pixels of all images [n, 3 L] in 0..1, some at a time, and their place among all."""
    flat = images.reshape(len(images), -1, 3)
    pixels = max(1, _VALUES_AT_ONCE // (3 * len(images)))
    for first in range(0, flat.shape[1], pixels):
        rows = slice(first, min(flat.shape[1], first + pixels))
        values = flat[:, rows].transpose(1, 0, 2).reshape(rows.stop - first, -1)
        yield rows, values.astype(np.float32) / _BYTES


def _principal(images: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean [3 L] of all pixels and their principal components [P, 3 L]."""
    size = 3 * len(images)
    total, moment, number = np.zeros(size), np.zeros((size, size)), 0
    for _, values in _blocks(images):
        total += values.sum(0)
        moment += values.T @ values
        number += len(values)
    mean = total / number
    mean = np.round(mean * _BYTES) / _BYTES  # as it is stored
    vectors = np.linalg.eigh(moment / number - np.outer(mean, mean))[1]
    return mean.astype(np.float32), np.ascontiguousarray(vectors.T[::-1][:count], np.float32)


def _basis(mean: np.ndarray, components: np.ndarray) -> list[int]:
    """The mean and the components as bytes, a plane after the other, [L, 3] each."""
    whole = [np.round(mean * _BYTES)]
    whole += [np.round(_ZERO + _ZERO * one / max(float(np.abs(one).max()), 1e-9)) for one in components]
    return [int(value) for value in np.concatenate(whole).clip(0, _BYTES)]
