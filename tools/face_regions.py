"""The outlines of the face's regions: smooth curves through landmarks, and a few measures of our own.

`python -m tools.face_regions` writes them to `assets/face_regions.npz`.
"""

import numpy as np

from facerf_cli.face.topology import LANDMARK_UV, OUTLINES_PATH, REGIONS, UV_SIZE_MM

_BROW_ABOVE_MM, _BROW_BELOW_MM = (0.5, 1.5, 2.0, 2.0, 0.5), (1.0, 2.5, 4.0, 5.5, 5.0)  # of landmarks 17 to 21
_NOSTRIL_CENTRE_UV, _NOSTRIL_HALF_MM, _NOSTRIL_TILT_DEG = (0.4650, 0.5720), (4.2, 2.0), 14.0
_FOREHEAD_UV = [(0.955, 0.17), (0.86, 0.075), (0.68, 0.045), (0.5, 0.04)]  # the image's right half


def build() -> dict[str, np.ndarray]:
    """Draw the outlines of all regions but `skin`, which is the rest."""
    return {name: outline_mm(name) for name in REGIONS if name != "skin"}


def outline_mm(name: str) -> np.ndarray:
    """Draw the closed outline [N, 2] of a region on the unrolled cylinder, in millimetres."""
    landmarks = LANDMARK_UV * UV_SIZE_MM
    if name == "eyes":
        arcs = [landmarks[[36, 37, 38, 39]], landmarks[[39, 40, 41, 36]]]
    elif name == "brows":
        above = landmarks[17:22] - np.stack([np.zeros(5), _BROW_ABOVE_MM], -1)
        below = landmarks[17:22] + np.stack([np.zeros(5), _BROW_BELOW_MM], -1)
        arcs = [above, below[::-1]]
    elif name == "lips":
        arcs = [landmarks[48:55], landmarks[[*range(54, 60), 48]]]
    elif name == "mouth":
        arcs = [landmarks[60:65], landmarks[[64, 65, 66, 67, 60]]]
    elif name == "nostrils":
        turn, tilt = np.linspace(0, 2 * np.pi, 40), np.radians(_NOSTRIL_TILT_DEG)
        along, across = _NOSTRIL_HALF_MM[0] * np.cos(turn), _NOSTRIL_HALF_MM[1] * np.sin(turn)
        ellipse = [along * np.cos(tilt) + across * np.sin(tilt), across * np.cos(tilt) - along * np.sin(tilt)]
        arcs = [np.stack(ellipse, -1) + np.array(_NOSTRIL_CENTRE_UV) * UV_SIZE_MM]
    elif name == "neck":
        corners = np.array([(2, LANDMARK_UV[16, 1]), (2, 2), (-1, 2), (-1, LANDMARK_UV[0, 1])]) * UV_SIZE_MM
        return np.concatenate([cubic_spline(landmarks[:17]), corners])
    else:
        assert name == "face", name
        forehead = [*_FOREHEAD_UV, *((1 - u, v) for u, v in _FOREHEAD_UV[-2::-1])]
        arcs = [landmarks[:17], np.array([LANDMARK_UV[16], *forehead, LANDMARK_UV[0]]) * UV_SIZE_MM]
    return np.concatenate([cubic_spline(arc) for arc in arcs])


def cubic_spline(points: np.ndarray, steps: int = 6) -> np.ndarray:
    """Sample a cubic spline [N, 2] through `points`, parametrised by chord length."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    knots = np.arange(len(points))
    at = np.interp(np.linspace(0, knots[-1], knots[-1] * steps + 1), knots, length)
    gap = np.diff(length)[:, None]
    slope = np.diff(points, axis=0) / gap
    system, right = np.zeros((len(points), len(points))), np.zeros_like(points)  # of the slopes at knots
    for i in knots[1:-1]:
        system[i, i - 1 : i + 2] = gap[i, 0], 2 * (gap[i - 1, 0] + gap[i, 0]), gap[i - 1, 0]
        right[i] = 3 * (gap[i] * slope[i - 1] + gap[i - 1] * slope[i])
    for a, b in ((0, 1), (-1, -2)):  # the two pieces at an end are one polynomial
        both = gap[a] + gap[b]
        system[a, [a, b]] = gap[b, 0], both[0]
        right[a] = ((gap[a] + 2 * both) * gap[b] * slope[a] + gap[a] ** 2 * slope[b]) / both
    tangent = np.linalg.solve(system, right)
    bend = (tangent[:-1] + tangent[1:] - 2 * slope) / gap
    piece = (np.searchsorted(length, at, "right") - 1).clip(0, len(gap) - 1)
    z = (at - length[piece])[:, None]
    turn = ((slope - tangent[:-1]) / gap - bend)[piece]
    return np.asarray(points[piece] + tangent[piece] * z + turn * z * z + (bend / gap)[piece] * (z * z * z))


if __name__ == "__main__":
    np.savez_compressed(OUTLINES_PATH, allow_pickle=False, **build())
