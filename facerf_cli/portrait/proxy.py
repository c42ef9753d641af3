"""Proxy geometry of a person in a photo: the fitted face on a mean head with ears, neck, hair and bust.

It gives each pixel a normal, a position and the visibility of each light: shadows of nose, brow, chin, hair
and head. The Portrait Network corrects its errors. Its shading under the light that explains the photo best
is a first estimate of the photo's light, which is an input of that network.
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
from facerf_cli.raster.texture import Inpainting, blurred, inpaint, vertex_normals
from facerf_cli.run.threads import in_threads

ASSET = Path(__file__).parents[1] / "assets" / "proxy_person.safetensors"
_HAIR_M = 0.07  # largest thickness of hair
_ANGLES, _SMOOTH = 48, 2.0  # directions for the hair's outline, and standard deviation of its smoothing
OFF_M = 0.003  # distance of ray origins from the surface: hides its facets
RADIUS_DEG, _RAYS = 3.0, 2  # of the disc of a light, and rays to it from each point
_SOFT_PX = 0.7  # standard deviation of the blur of visibility
_SEED = 7
_SOLVED_PX, _SOLVED_SIDES = 48, 3.0  # side for estimating the light, in a square this many faces wide
_SURE = 0.8  # least fraction of skin of the pixels that are explained
_RIDGE = 0.05  # of the weights, per root of the number of pixels, because many lights explain a photo
_LEAST_PIXELS = 30
_BRIGHTEST = 3.0  # clipping relative to the mean, so that highlights count little


@dataclass(frozen=True, eq=False)
class _MeanPerson:
    """Mean person in the head's frame: vertices [N, 3], triangles [F, 3].

    A vertex follows the displacement of the face's vertices `carriers` [N, 4] by `weights` [N, 4] times
    `follows` [N]; `hair` [N] is the fraction of the hair's thickness by which it is pushed out.
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
    """Mesh of a person in camera space: vertices and unit normals [N, 3], triangles [F, 3]."""

    vertices: Tensor
    normals: Tensor
    triangles: Tensor
    scene: Any  # for tracing of rays

    @staticmethod
    def of(vertices: Tensor, triangles: Tensor) -> "Proxy":
        scene = build_scene(vertices.numpy(), triangles.numpy())
        return Proxy(vertices, vertex_normals(vertices, triangles), triangles, scene)


@dataclass(frozen=True, eq=False)
class ProxyMaps:
    """The proxy in a square of side S, camera space; where it covers nothing, extended from around.

    normals [3, S, S] unit; positions_m [3, S, S]; covered [S, S] 0 or 1.
    """

    normals: Tensor
    positions_m: Tensor
    covered: Tensor


def proxy_of(model: MorphableModel, fit: FaceFit, classes: Tensor, square: Crop) -> Proxy:
    """Shape the proxy of a fitted face from the classes [C, S, S] in the square around it."""
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
    """Return the camera of a square of the photo that a face was fitted in."""
    whole = photo_camera(fit.crop, square.size_px, square.size_px)
    return Camera(
        whole.focal_px * square.scale,
        square.size_px,
        square.size_px,
        (whole.cx_px - square.x0_px) * square.scale,
        (whole.cy_px - square.y0_px) * square.scale,
    )


def proxy_maps(proxy: Proxy, camera: Camera, filled: bool = True) -> ProxyMaps:
    """Render normals and positions; if not `filled`, they are 0 where the proxy covers nothing."""
    fragments = rasterize(proxy.vertices, proxy.triangles, camera)
    attributes = torch.cat([proxy.normals, proxy.vertices], 1)
    maps = interpolate(attributes, proxy.triangles, fragments).permute(2, 0, 1)
    covered = fragments.covered.float()
    if not covered.any():
        raise InputError(f"the fitted face lies outside the image; {PASS_LANDMARKS}")
    maps = inpaint(maps, covered) if filled else maps
    return ProxyMaps(F.normalize(maps[:3], dim=0), maps[3:], covered)


class Shadows:
    """Visibility of lights from each pixel of a proxy's maps, which the proxy itself occludes.

    A surface that faces away sees no light. Independent of the light are the rays' origins [N, 3], and
    numbers [rays, 2, N, 1] in 0..1, which place the rays on the disc of a light.
    """

    def __init__(self, proxy: Proxy, maps: ProxyMaps) -> None:
        self._inside, self._inpainted = maps.covered.numpy() > 0, Inpainting(maps.covered)
        normals, points = (field.numpy()[:, self._inside].T for field in (maps.normals, maps.positions_m))
        self.origins = (points + OFF_M * normals).astype(np.float32)
        self._scene = proxy.scene
        # by pixel of the square, so that neighbouring frames of a shot have the same noise
        numbers = np.random.default_rng(_SEED).random((_RAYS, 2, *self._inside.shape)).astype(np.float32)
        self.numbers = numbers[:, :, self._inside][..., None]
        self._places = [places_on_disc(RADIUS_DEG, *pair) for pair in self.numbers]
        discs = (np.hstack([np.ones_like(r), r * cos, r * sin]) for r, cos, sin in self._places)
        self._discs = [disc / np.linalg.norm(disc, axis=1, keepdims=True) for disc in discs]

    def along(self, directions: Tensor) -> Tensor:
        """Return the visibility [L, s, s] of lights in camera-space directions [L, 3]."""
        axes = directions.numpy()
        frames = np.stack([axes, *tangents(axes)], 1).astype(np.float32)  # [L, 3, 3]
        return self._reached(len(axes), lambda number: (disc @ frames[number] for disc in self._discs))

    def toward(self, places_m: Tensor) -> Tensor:
        """Return the visibility [P, s, s] of lights at camera-space positions [P, 3]."""
        offsets = places_m.numpy()[:, None] - self.origins  # [P, N, 3]
        distances_m = np.linalg.norm(offsets, axis=2)
        axes = offsets / distances_m[..., None].clip(min=1e-6)

        def rays(number: int) -> Iterator[np.ndarray]:
            return (on_disc(axes[number], places) for places in self._places)

        return self._reached(len(axes), rays, distances_m)

    def _reached(
        self, lights: int, rays: Callable[[int], Iterator[np.ndarray]], reach_m: np.ndarray | None = None
    ) -> Tensor:
        """Trace the unit `rays` [N, 3] to each light, within a reach [L, N]; return visibility [L, s, s]."""
        visible = np.zeros((lights, *self._inside.shape), np.float32)

        def trace(number: int) -> None:
            reach = None if reach_m is None else reach_m[number]
            blocked = [occluded(self._scene, self.origins, ray, reach) for ray in rays(number)]
            visible[number, self._inside] = 1 - np.mean(blocked, 0)

        list(in_threads(trace, range(lights)))
        return blurred(self._inpainted(torch.from_numpy(visible)), _SOFT_PX)


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
    """Return the largest distance [A] per angle of the chosen points [N, 2]; 0 without points."""
    offset = offset_px[chosen].numpy()
    reach = np.zeros(_ANGLES)
    np.maximum.at(reach, _bin_of(offset), np.linalg.norm(offset, axis=1))
    return reach


def _mean_person() -> _MeanPerson:
    tensors, metadata = load_checkpoint(ASSET)
    if metadata.get("layout_version") != LAYOUT_VERSION:
        raise InputError(f"{ASSET}: has another UV layout; run tools/proxy_person.py")
    model = load_face_model(BUILTIN)
    face = model.vertices(torch.zeros(1, len(model.identity)), torch.zeros(1, len(model.expression)))[0]
    tensors["triangles"], tensors["carriers"] = tensors["triangles"].long(), tensors["carriers"].long()
    return _MeanPerson(**tensors, face_m=face)


def own_shading(
    image: Tensor, classes: Tensor, normals: Tensor, rig: Tensor, visible: Tensor, sides: float
) -> Tensor:
    """Shade a proxy by a photo's estimated light: [1, S, S], with a mean of 1 over the skin.

    The skin is assumed to be diffuse and of one colour.

    Args:
        image: Scene-linear [3, S, S].
        classes: Probabilities [C, S, S].
        normals: Normals of the proxy [3, S, S].
        rig: Unit directions [L, 3] around the person.
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
    shading, skin = _at(coarse[None], side), classes[SKIN]
    return shading / ((shading[0] * skin).sum() / skin.sum().clamp_min(1e-3)).clamp_min(1e-3)


def _olats(normals: Tensor, rig: Tensor, visible: Tensor) -> Tensor:
    """Shade a white diffuse proxy under each light [L, s, s], with a little light in shadows."""
    cosine = torch.einsum("lc,cij->lij", rig, F.normalize(normals, dim=0)).clamp_min(0)
    return visible * cosine + 0.02


def _at(maps: Tensor, side: int) -> Tensor:
    mode = "area" if side < maps.shape[-1] else "bilinear"
    return F.interpolate(maps[None], size=(side, side), mode=mode)[0]
