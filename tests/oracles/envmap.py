"""Weights of an environment map: the nearest light at many points of every pixel; slow and obvious."""

import math

import numpy as np


def envmap_weights_slowly(
    envmap: np.ndarray, directions: np.ndarray, rotate_deg: float, samples: int = 80
) -> np.ndarray:
    """Return weights [L, 3] of lights [L, 3] under a map [H, W, 3], from samples x samples points a pixel."""
    height, width = envmap.shape[:2]
    weights = np.zeros((len(directions), 3))
    for row in range(height):
        for column in range(width):
            for k in range(samples):
                for m in range(samples):
                    u, v = (column + (m + 0.5) / samples) / width, (row + (k + 0.5) / samples) / height
                    elevation = math.pi * (0.5 - v)
                    azimuth = math.pi * (1 - 2 * u) + math.radians(rotate_deg)
                    direction = [
                        math.cos(elevation) * math.sin(azimuth),
                        math.sin(elevation),
                        math.cos(elevation) * math.cos(azimuth),
                    ]
                    nearest = int((directions @ direction).argmax())
                    solid_angle = 2 * math.pi**2 * math.cos(elevation) / (height * width * samples**2)
                    weights[nearest] += envmap[row, column] * solid_angle / math.pi
    return weights
