"""A page of `facerf view` drawn by numpy: the slow, obvious twin of its shaders and scripts."""

import base64
import io
import json
import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from PIL import Image


def document_of(text: str) -> dict[str, Any]:
    """The JSON document in a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found
    return json.loads(found[1])


def image(encoded: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded)))).astype(np.float64)


def decoded(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def encoded(linear: np.ndarray) -> np.ndarray:
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    az, el = math.radians(azimuth_deg), math.radians(elevation_deg)
    return np.array([math.cos(el) * math.sin(az), math.sin(el), math.cos(el) * math.cos(az)])


SHADE = 0.06  # of an exposed ratio, below which its colour fades: there it is noise


@dataclass(frozen=True)
class Page:
    document: dict[str, Any]

    def floats(self, name: str, columns: int) -> np.ndarray:
        raw = base64.b64decode(self.document[name])
        return np.frombuffer(raw, "<f4").astype(np.float64).reshape(-1, columns)

    @cached_property
    def rank(self) -> int:
        return len(self.document["scales"])

    @cached_property
    def maps(self) -> np.ndarray:
        """[K, h, w, 3]."""
        atlas = image(self.document["maps"])
        (width, height), (tile_w, tile_h) = self.document["mapSize"], self.document["tile"]
        tiles = []
        for k, scale in enumerate(self.document["scales"]):
            top = k // self.document["columns"] * tile_h
            left = k % self.document["columns"] * tile_w
            tiles.append((atlas[top : top + height, left : left + width] - 128) / 127 * scale)
        return np.stack(tiles)

    def coefficients(self, toward: np.ndarray) -> np.ndarray:
        """[K] of a unit direction [3], linear over the triangle of the rig that it meets."""
        directions, table = self.floats("directions", 3), self.floats("coefficients", self.rank)
        triangles = np.frombuffer(base64.b64decode(self.document["triangles"]), "<u2").reshape(-1, 3)
        for triangle in triangles.astype(int):
            shares = np.linalg.solve(directions[triangle].T, toward)
            if shares.min() > -1e-6:
                return shares / shares.sum() @ table[triangle]
        raise AssertionError("no triangle is met")

    def sums(self, lights: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """[K, 3] of lights: unit directions [3] and rgb weights [3]."""
        total = np.zeros((self.rank, 3))
        for toward, rgb in lights:
            total += self.coefficients(toward)[:, None] * rgb
        return total

    def stage(self) -> np.ndarray:
        """Directions [150, 3] of the rig over which maps are integrated."""
        return self.floats("stage", 3)

    def exposure_ev(self, sums: np.ndarray) -> float:
        about = self.document["exposure"]

        def brighter(name: str, percentile: float) -> float:
            part = about[name]
            raw = np.frombuffer(base64.b64decode(part["factors"]), np.int8).astype(np.float64)
            scales = np.array(part["scales"])[:, None, None]
            factors = raw.reshape(len(scales), part["count"], 3) / 127 * scales
            radiance = np.einsum("knc,kc->nc", factors, sums[: len(scales)])
            return float(np.percentile(radiance @ (0.2126, 0.7152, 0.0722), percentile))

        face, most = (
            brighter(name, p) for name, p in zip(("skin", "person"), about["percentiles"], strict=True)
        )
        if min(face, about["wanted"]) <= 1e-9:
            return 0.0
        gain = min(about["wanted"] / face, 2 * max(1.0, about["own"]) / max(most, 1e-9))
        return round(math.log2(gain), 2)

    def shown(self, sums: np.ndarray, ev: float) -> np.ndarray:
        """The image [H, W, 3] in 0..255, over the photo's background."""
        width, height = self.document["size"]
        left, top, box_w, box_h = self.document["box"]
        small = np.einsum("khwc,kc->hwc", self.maps, sums)
        x = (np.arange(width) + 0.5 - left) / box_w * small.shape[1] - 0.5
        y = (np.arange(height) + 0.5 - top) / box_h * small.shape[0] - 0.5
        ratio = _bilinear(small, y, x)
        grey = ratio.mean(-1, keepdims=True)
        exposed = grey * self.document["gain"] * 2.0**ev
        ratio = (grey + (exposed / SHADE).clip(0, 1) * (ratio - grey)).clip(min=0)
        detail = decoded(image(self.document["detail"]) / 255) * self.document["gain"]
        matte = image(self.document["matte"])[..., None] / 255
        behind = decoded(image(self.document["background"]) / 255)
        return 255 * encoded(behind + matte * detail * ratio * 2.0**ev)


def _bilinear(image: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """An image [h, w, C] at pixel positions y [H] and x [W], its border repeated."""
    for axis, at in ((0, y), (1, x)):
        at = at.clip(0, image.shape[axis] - 1)
        low = np.floor(at).astype(int).clip(0, max(0, image.shape[axis] - 2))
        high = np.minimum(low + 1, image.shape[axis] - 1)
        part = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        image = image.take(low, axis) * (1 - part) + image.take(high, axis) * part
    return image
