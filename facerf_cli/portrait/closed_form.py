"""Closed-form matting (Levin et al., *A closed-form solution to natural image matting*, 2008)."""

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array, dia_array
from scipy.sparse.linalg import cg

_SMOOTHNESS = 1e-5  # variance of the colours of a window, sRGB in 0..1, below which its alpha is constant
_PULL = 3e-3  # toward the expected alpha
_TOLERANCE, _MOST_STEPS = 1e-3, 200
_WINDOW = 9  # pixels


def solve_matte(image_srgb: np.ndarray, expected: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Find alpha [H, W] in 0..1 where it is unknown [H, W]; elsewhere it is as expected [H, W].

    Around each pixel alpha is a linear function of the colour of the image [H, W, 3] in 0..1. Only windows of
    3 x 3 pixels that touch unknown ones are looked at, so the cost goes with their number.
    """
    alpha = np.array(expected, np.float64)
    if not unknown.any() or min(unknown.shape) < 3:
        return alpha.astype(np.float32)
    pixels = _windows(unknown)
    affinity = _affinities(image_srgb.reshape(-1, 3)[pixels])
    count = int(unknown.sum())
    number = np.full(unknown.size, -1)
    number[unknown.ravel()] = np.arange(count)
    rows, columns = (
        np.broadcast_to(number[pixels][sides], affinity.shape)
        for sides in (np.s_[:, :, None], np.s_[:, None])
    )
    inner, border = (rows >= 0) & (columns >= 0), (rows >= 0) & (columns < 0)
    laplacian = csr_array((affinity[inner], (rows[inner], columns[inner])), (count, count))
    known = np.broadcast_to(alpha.ravel()[pixels][:, None], affinity.shape)
    right = -np.bincount(rows[border], affinity[border] * known[border], count)
    start = alpha[unknown]
    system = laplacian + dia_array((np.full((1, count), _PULL), [0]), (count, count))
    scaled = dia_array((1 / system.diagonal()[None], [0]), (count, count))
    solved, _ = cg(system, right + _PULL * start, start, rtol=_TOLERANCE, maxiter=_MOST_STEPS, M=scaled)
    alpha[unknown] = solved.clip(0, 1)
    return alpha.astype(np.float32)


def _windows(unknown: np.ndarray) -> np.ndarray:
    """Numbers [N, 9] of the pixels of each window that touches an unknown pixel."""
    middle = binary_dilation(unknown, np.ones((3, 3)))
    middle[[0, -1], :] = middle[:, [0, -1]] = False
    offsets = np.arange(-1, 2)[:, None] * unknown.shape[1] + np.arange(-1, 2)
    return np.flatnonzero(middle)[:, None] + offsets.ravel()


def _affinities(colours: np.ndarray) -> np.ndarray:
    """The matting Laplacian's entries [N, 9, 9] of windows with colours [N, 9, 3] (equation 12)."""
    centred = colours.astype(np.float64) - colours.mean(1, keepdims=True)
    covariance = centred.transpose(0, 2, 1) @ centred / _WINDOW + _SMOOTHNESS / _WINDOW * np.eye(3)
    alike = centred @ np.linalg.inv(covariance) @ centred.transpose(0, 2, 1)
    return np.asarray(np.eye(_WINDOW) - (1 + alike) / _WINDOW)
