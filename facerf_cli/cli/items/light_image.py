"""A light estimate as one image: photo, explanation, difference, and two balls under the light."""

import numpy as np
import torch
from torch import Tensor

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb, srgb_to_linear
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import region_mask
from facerf_cli.face.view import render_face, see_face
from facerf_cli.files.drawings import labels
from facerf_cli.light.envmap import ball
from facerf_cli.network.inputs import resize

TILE_PX = 256
_LABEL_PX = 20
_LABELS = ("photo", "explained", "red: too bright, blue: too dark", "mirror ball", "diffuse ball")
_BALL_PX = 236  # within its tile


def draw_estimate(head: Head, model: MorphableModel, explained: Tensor, envmap: Tensor) -> np.ndarray:
    """Five tiles side by side [H, W, 3], linear, exposed for display; labels above.

    `explained` [3, t, t] is the face's texture as its light explains it; `envmap` [H, 2 H, 3] that light.
    """
    whole = Crop(0.0, 0.0, float(len(head.cropped)), TILE_PX)
    image, mask = _explained_in_crop(head, model, explained)
    gain = np.float32(2 ** auto_exposure_ev(head.cropped, mask))
    photo, remade = (
        head.cropped * gain,
        (mask[..., None] * image + (1 - mask[..., None]) * head.cropped) * gain,
    )
    faces = [whole.apply(tile.clip(0, 1)) for tile in (photo, remade, _difference(photo, remade, mask))]
    both = np.stack([ball(envmap.clamp_min(0), _BALL_PX, kind).numpy() for kind in ("mirror", "diffuse")])
    both *= np.float32(2 ** auto_exposure_ev(both[1], both[1].max(-1) > 0))
    margin = (TILE_PX - _BALL_PX) // 2
    balls = np.pad(both.clip(0, 1), ((0, 0), (margin, margin), (margin, margin), (0, 0)))
    tiles = np.concatenate([*faces, *balls], 1)
    return np.concatenate([labels(_LABELS, TILE_PX, _LABEL_PX), tiles])


def _explained_in_crop(head: Head, model: MorphableModel, explained: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The explained face in the crop [S, S, 3], and how far it stands there for the photo [S, S] in 0..1."""
    uv, coverage = see_face(head.fit.vertices_camera(model), head.fit.camera)
    side = head.face.texture.shape[-1]
    inside = (head.face.visible * region_mask("face", side))[None]
    planes = torch.cat([resize(explained[None], side)[0], inside])
    rendered = render_face(planes[None], uv, coverage)[0].permute(1, 2, 0).numpy()
    return rendered[..., :3], rendered[..., 3].clip(0, 1)


def _difference(photo: np.ndarray, remade: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """On grey: red where the face was made too bright for the eye, blue where too dark."""
    encoded = [linear_to_srgb(tile.clip(0, 1)).mean(-1) for tile in (remade, photo)]
    error = 2 * (encoded[0] - encoded[1]) * mask
    bright, dark = error.clip(0, 0.5), (-error).clip(0, 0.5)
    shown = np.stack([0.5 + bright - dark, 0.5 - bright - dark, 0.5 - bright + dark], -1)
    return np.asarray(srgb_to_linear(shown.astype(np.float32)))
