"""Proxy geometry of a person in a photo: the fitted face on a mean head with ears, neck, hair and bust.

It gives each pixel a normal and a position, and tells which lights reach it. Shadows of nose, brow, chin,
hair and head come from it; what it gets wrong, the Portrait Network corrects. Its shading under the light
that explains the photo best is a first guess of the photo's light, from which that network starts.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import PASS_LANDMARKS, Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.face.view import photo_camera
from facerf_cli.light.estimate import least_non_negative
from facerf_cli.light.transport import build_scene, occluded, on_disc, places_on_disc, tangents
from facerf_cli.network.checkpoint import load_checkpoint
from facerf_cli.network.portrait import SKIN
from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import blurred, inpaint, vertex_normals
from facerf_cli.run.threads import in_threads

ASSET = Path(__file__).parents[1] / "assets" / "proxy_person.safetensors"
_HAIR_M = 0.07  # most that the scalp is pushed out by
_ANGLES, _SMOOTH = 48, 2.0  # around the head, in which the hair's outline is measured, and its smoothing
OFF_M = 0.003  # of rays, from the surface: hides its facets
RADIUS_DEG, _RAYS = 3.0, 2  # of the disc of a light, and rays to it from each point
_SOFT_PX = 0.7  # standard deviation of a blur of visibility
_SEED = 7
_SOLVED_PX, _SOLVED_SIDES = 48, 3.0  # side at which the light is estimated, in a square of so many faces
_SURE = 0.8  # share of skin, and cover of the proxy, of the pixels that are explained
_RIDGE = 0.05  # of the weights, per root of the number of pixels: many lights explain a photo alike
_LEAST_PIXELS = 30
_BRIGHTEST = 3.0  # over the mean: clipped, so that highlights count little


@dataclass(frozen=True, eq=False)
class _MeanPerson:
    """The mean person, head frame: vertices [N, 3], triangles [F, 3].

    A vertex follows the displacement of the face's vertices `carriers` [N, 4] by `weights` [N, 4] times
    `follows` [N]; `hair` [N] is the share of the hair's thickness by which it is pushed out.
    """

    vertices_m: Tensor
    triangles: Tensor
    carriers: Tensor
    weights: Tensor
    follows: Tensor
    hair: Tensor
    face_m: Tensor  # [GRID * GRID, 3] of the mean face


@dataclass(frozen=True, eq=False)
class Proxy:
    """The mesh of a person in camera space: vertices and unit normals [N, 3], triangles [F, 3]."""

    vertices: Tensor
    normals: Tensor
    triangles: Tensor
    scene: Any  # for tracing of rays

    @staticmethod
    def of(vertices: Tensor, triangles: Tensor) -> "Proxy":
        """Compute the normals and the scene."""
        scene = build_scene(vertices.numpy(), triangles.numpy())
        return Proxy(vertices, vertex_normals(vertices, triangles), triangles, scene)


@dataclass(frozen=True, eq=False)
class ProxyMaps:
    """The proxy seen in a square of side S, camera space; where it is not covered, filled from around.

    normals [3, S, S] unit; positions_m [3, S, S]; covered [S, S] 0 or 1.
    """

    normals: Tensor
    positions_m: Tensor
    covered: Tensor


def proxy_of(model: MorphableModel, fit: FaceFit, classes: Tensor, square: Crop) -> Proxy:
    """Shape the proxy of a fitted face; classes [C, S, S] are what is seen in the square around it."""
    person = _mean_person()
    face = model.vertices(fit.alpha[None], fit.beta[None])[0]
    mean = person.face_m
    scale = ((face - face.mean(0)) * (mean - mean.mean(0))).sum(0) / (mean - mean.mean(0)).square().sum(0)
    shift = face.mean(0) - scale * mean.mean(0)
    rest = face - (scale * mean + shift)
    carried = (person.weights[..., None] * rest[person.carriers]).sum(1) * person.follows[:, None]
    vertices = (scale * person.vertices_m + shift + carried) @ fit.rotation.mT + fit.translation_m
    camera = square_camera(fit, square)
    return Proxy.of(_with_hair(vertices, person.hair, camera, classes), person.triangles)


def square_camera(fit: FaceFit, square: Crop) -> Camera:
    """The camera of a square of the photo that a face was fitted in."""
    whole = photo_camera(fit.crop, square.size_px, square.size_px)
    return Camera(
        whole.focal_px * square.scale,
        square.size_px,
        square.size_px,
        (whole.cx_px - square.x0_px) * square.scale,
        (whole.cy_px - square.y0_px) * square.scale,
    )


def proxy_maps(proxy: Proxy, camera: Camera, filled: bool = True) -> ProxyMaps:
    """Render normals and positions; not `filled`, they are 0 where the proxy does not cover the square."""
    fragments = rasterize(proxy.vertices, proxy.triangles, camera)
    seen = interpolate(torch.cat([proxy.normals, proxy.vertices], 1), proxy.triangles, fragments)
    covered = fragments.covered.float()
    if not covered.any():
        raise InputError(f"the fitted face lies outside the image; {PASS_LANDMARKS}")
    maps = inpaint(seen.permute(2, 0, 1), covered) if filled else seen.permute(2, 0, 1)
    return ProxyMaps(F.normalize(maps[:3], dim=0), maps[3:], covered)


class Shadows:
    """Lights that reach each pixel of a proxy's maps, where it shades itself.

    A surface that faces away is not reached. What all lights share is computed once: the pixels that are
    covered [s, s], the rays' origins [N, 3], and numbers [rays, 2, N, 1] in 0..1, which place their ends on
    the disc of a light.
    """

    def __init__(self, proxy: Proxy, maps: ProxyMaps) -> None:
        self.covered, self._inside = maps.covered, maps.covered.numpy() > 0
        normals, points = (field.numpy()[:, self._inside].T for field in (maps.normals, maps.positions_m))
        self.origins = (points + OFF_M * normals).astype(np.float32)
        self._scene = proxy.scene
        # by pixel of the square, so that those of neighbouring frames of a shot are alike
        numbers = np.random.default_rng(_SEED).random((_RAYS, 2, *self._inside.shape)).astype(np.float32)
        self.numbers = numbers[:, :, self._inside][..., None]
        self._places = [places_on_disc(RADIUS_DEG, *pair) for pair in self.numbers]
        discs = (np.hstack([np.ones_like(r), r * cos, r * sin]) for r, cos, sin in self._places)
        self._discs = [disc / np.linalg.norm(disc, axis=1, keepdims=True) for disc in discs]

    def along(self, directions: Tensor) -> Tensor:
        """Share [L, s, s] of lights from camera-space directions [L, 3] that arrives."""
        axes = directions.numpy()
        frames = np.stack([axes, *tangents(axes)], 1).astype(np.float32)  # [L, 3, 3]
        return self._reached(len(axes), lambda number: (disc @ frames[number] for disc in self._discs))

    def toward(self, places_m: Tensor) -> Tensor:
        """Share [P, s, s] of lights at camera-space places [P, 3] that arrives."""
        offsets = places_m.numpy()[:, None] - self.origins  # [P, N, 3]
        distances_m = np.linalg.norm(offsets, axis=2)
        axes = offsets / distances_m[..., None].clip(min=1e-6)

        def rays(number: int) -> Iterator[np.ndarray]:
            return (on_disc(axes[number], places) for places in self._places)

        return self._reached(len(axes), rays, distances_m)

    def _reached(
        self, lights: int, rays: Callable[[int], Iterator[np.ndarray]], reach_m: np.ndarray | None = None
    ) -> Tensor:
        """Visibility [L, s, s] of lights, from the unit `rays` [N, 3] to each, within a reach [L, N]."""
        found = np.zeros((lights, *self._inside.shape), np.float32)

        def trace(number: int) -> None:
            reach = None if reach_m is None else reach_m[number]
            blocked = [occluded(self._scene, self.origins, ray, reach) for ray in rays(number)]
            found[number, self._inside] = 1 - np.mean(blocked, 0)

        list(in_threads(trace, range(lights)))
        filled = inpaint(torch.from_numpy(found), self.covered)
        return blurred(filled, _SOFT_PX)


def _with_hair(vertices: Tensor, hair: Tensor, camera: Camera, classes: Tensor) -> Tensor:
    """Push the scalp out to the outline of hair and headwear in the image.

    The thickness is measured along directions from the middle of the scalp in the image, and continued over
    the parts that face the camera or lie behind.
    """
    scalp = hair > 0.5
    centre_m = vertices[scalp].mean(0)
    places = project(vertices, camera)
    middle = project(centre_m[None], camera)[0]
    bald_px = _reach(places[scalp] - middle, torch.ones(int(scalp.sum()), dtype=torch.bool))
    side = classes.shape[-1]
    y, x = torch.meshgrid(*(torch.arange(side) + PIXEL_CENTRE,) * 2, indexing="ij")
    own = classes[class_index("hair")] + classes[class_index("headwear")]
    pixels = (torch.stack([x, y], -1) * (camera.width_px / side)).view(-1, 2) - middle
    outline_px = _reach(pixels, (own > 0.5).flatten())
    per_metre = camera.focal_px / float(-centre_m[2])
    angles = (np.arange(_ANGLES) + 0.5) * 2 * np.pi / _ANGLES  # of the bins, clockwise from the right
    upper = np.sin(angles) < 0.3  # image directions upward and to the sides; y points down
    thick_m = ((outline_px - bald_px) / per_metre).clip(0, _HAIR_M) * (bald_px > 0) * upper
    thick_m = gaussian_filter1d(thick_m, _SMOOTH, mode="wrap")
    offset = (places - middle).numpy()
    at = _bin_of(offset)
    near_outline = (np.linalg.norm(offset, axis=1) / np.maximum(bald_px[at], 1e-6)).clip(0, 1) ** 2
    mean_m = thick_m[upper].mean()
    push_m = torch.from_numpy(mean_m + near_outline * (thick_m[at] - mean_m)).float() * hair
    outward = F.normalize(vertices - centre_m, dim=1)
    return vertices + push_m[:, None] * outward


def _bin_of(offset: np.ndarray) -> np.ndarray:
    angle = np.arctan2(offset[:, 1], offset[:, 0]) % (2 * np.pi)
    return (angle * _ANGLES / (2 * np.pi)).astype(int) % _ANGLES


def _reach(offset_px: Tensor, chosen: Tensor) -> np.ndarray:
    """Largest distance [A] of the chosen places [N, 2] from the middle, by angle; 0 without any."""
    offset = offset_px[chosen].numpy()
    reach = np.zeros(_ANGLES)
    np.maximum.at(reach, _bin_of(offset), np.linalg.norm(offset, axis=1))
    return reach


def _mean_person() -> _MeanPerson:
    tensors, metadata = load_checkpoint(ASSET)
    if metadata.get("layout_version") != LAYOUT_VERSION:
        raise InputError(f"{ASSET}: made for another UV layout; make it again")
    model = load_face_model(BUILTIN)
    face = model.vertices(torch.zeros(1, len(model.identity)), torch.zeros(1, len(model.expression)))[0]
    tensors["triangles"], tensors["carriers"] = tensors["triangles"].long(), tensors["carriers"].long()
    return _MeanPerson(**tensors, face_m=face)


def own_shading(
    image: Tensor, classes: Tensor, normals: Tensor, rig: Tensor, visible: Tensor, sides: float
) -> Tensor:
    """Shade a proxy by a photo's estimated light: [1, S, S], with a mean of 1 over the skin.

    The skin is taken to be of one colour and matt.

    Args:
        image: Scene-linear [3, S, S].
        classes: Shares [C, S, S].
        normals: Of the proxy [3, S, S].
        rig: Unit directions [L, 3] all around.
        visible: Visibility [L, s, s] of each light.
        sides: Width of the square, in faces.
    """
    solved_px = _SOLVED_PX * max(1, round(sides / _SOLVED_SIDES))
    skin = _at(classes[SKIN : SKIN + 1], solved_px)[0]
    olats = _olats(_at(normals, solved_px), rig, _at(visible, solved_px))
    grey = _at(image.mean(0, keepdim=True), solved_px)[0]
    sure = skin > _SURE
    side = image.shape[-1]
    if sure.sum() < _LEAST_PIXELS:
        return torch.ones(1, side, side)
    wanted = (grey[sure] / grey[sure].mean().clamp_min(1e-6)).clamp(max=_BRIGHTEST)
    columns = olats[:, sure].T
    ridge = _RIDGE * len(columns) ** 0.5 * torch.eye(len(olats))
    padded = torch.cat([wanted, torch.zeros(len(olats))])
    system = torch.cat([columns, ridge]).double().numpy()
    solved = least_non_negative(system.T @ system, system.T @ padded.double().numpy())
    weights = torch.from_numpy(solved).float()
    coarse = torch.einsum("l,lij->ij", weights, _olats(_at(normals, visible.shape[-1]), rig, visible))
    shading = _at(coarse[None], side)
    share = classes[SKIN]
    return shading / ((shading[0] * share).sum() / share.sum().clamp_min(1e-3)).clamp_min(1e-3)


def _olats(normals: Tensor, rig: Tensor, visible: Tensor) -> Tensor:
    """Shading [L, s, s] of a white matt proxy under each light, with a little light in shadows."""
    cosine = torch.einsum("lc,cij->lij", rig, F.normalize(normals, dim=0)).clamp_min(0)
    return visible * cosine + 0.02


def _at(maps: Tensor, side: int) -> Tensor:
    mode = "area" if side < maps.shape[-1] else "bilinear"
    return F.interpolate(maps[None], size=(side, side), mode=mode)[0]
