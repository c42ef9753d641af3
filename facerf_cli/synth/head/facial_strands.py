"""Beard, moustache and lashes of a synthetic head as ribbons, over the hair that is painted on the skin."""

from functools import lru_cache

import numpy as np
from scipy.interpolate import CubicSpline

from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.appearance.facial_hair import beard_density
from facerf_cli.synth.head.hair import ribbons
from facerf_cli.synth.head.hair_styles import HairStyle
from facerf_cli.synth.head.hull import hull_of
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, smoothstep, unit
from facerf_cli.synth.random_fields import CANVAS_SPAN, Window

_BEARD = HairStyle(name="beard", comb="whorl", segments=5, width_mm=0.6)
_LASHES = HairStyle(name="lashes", comb="whorl", segments=4, width_mm=0.22)
_WISPS = 7000  # of a full beard
_MOUTH_V = float(LANDMARK_UV[48:60, 1].mean())
_LIP_M = 0.034  # half width of a moustache
_LEAST_COVER = 0.15  # of a beard that has length
_LIDS = (((36, 37, 38, 39), 110), ((39, 40, 41, 36), 60), ((42, 43, 44, 45), 110), ((45, 46, 47, 42), 60))
_LASH_M = {110: 0.009, 60: 0.0055}  # length of upper and lower lashes, by their number


@lru_cache(maxsize=1)
def _density() -> np.ndarray:
    """Density [T, T] of a beard over the canvas."""
    return np.asarray(beard_density(Window(256, CANVAS_SPAN))[0, 0].numpy())


def grow_beard(
    head: HeadMesh, traits: dict[str, float | str | bool], random: np.random.Generator
) -> HeadMesh | None:
    """Grow the beard and moustache that the traits of a person describe; None if there is none."""
    beard, moustache = float(traits["beard"]), float(traits["moustache"])
    if max(beard, moustache) < _LEAST_COVER:
        return None
    faces = head.triangles[head.part[head.triangles[:, 0]] == PARTS.index("skin")]
    uv = head.uv[faces].mean(1).astype(float)
    corners = head.vertices[faces].astype(float)
    place = ((uv - CANVAS_SPAN[0]) / (CANVAS_SPAN[1] - CANVAS_SPAN[0]) * 256).astype(int).clip(0, 255)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    centre = corners.mean(1)
    on_lip = (uv[:, 1] < _MOUTH_V) & (np.abs(centre[:, 0]) < _LIP_M)
    cover = np.where(on_lip, moustache, beard)
    if float(traits["goatee"]):
        cover = cover * smoothstep(0.042 - np.abs(centre[:, 0]), 0, 0.012)
    chance = area * _density()[place[:, 1], place[:, 0]] ** 1.3 * cover
    if chance.sum() <= 0:
        return None
    count = int(_WISPS * max(beard, 0.35 * moustache))
    chosen = random.choice(len(faces), count, p=chance / chance.sum())
    weights = random.dirichlet([1, 1, 1], count)[..., None]
    roots = (corners[chosen] * weights).sum(1)
    normals = unit((head.normals[faces[chosen]] * weights).sum(1).astype(float))
    longest = random.uniform(0.004, 0.03) * max(beard, 0.3)
    chin = 0.5 + 0.5 * smoothstep(-roots[:, 1], 0.03, 0.08)
    length = np.where(on_lip[chosen], min(longest, 0.009), longest * chin) * random.uniform(0.5, 1.1, count)
    return _labelled(_grown(head, roots, normals, length, random), "beard")


def _grown(
    head: HeadMesh, roots: np.ndarray, normals: np.ndarray, length_m: np.ndarray, random: np.random.Generator
) -> HeadMesh:
    """Grow wisps down along the skin, a little outward."""
    hull = hull_of(head)
    aside = np.sign(roots[:, 0]) * smoothstep(np.abs(roots[:, 0]), 0.0, 0.03) * 0.25
    down = np.stack([aside, -np.ones(len(roots)), 0.15 + 0 * aside], -1)
    stray = random.normal(0, 0.22, roots.shape)
    points, rows = roots - 0.0006 * normals, [roots - 0.0006 * normals]
    for step in range(_BEARD.segments):
        out = 0.75 * (1 - step / _BEARD.segments)
        direction = unit(down + stray + out * normals)
        points = points + length_m[:, None] / _BEARD.segments * direction
        points = hull.lifted(points, 0.0) if step else points
        rows.append(points)
    paths = np.stack(rows, 1)
    return ribbons(paths, np.broadcast_to(normals[:, None], paths.shape), normals, _BEARD, random)


def grow_lashes(landmarks_m: np.ndarray, random: np.random.Generator) -> HeadMesh:
    """Grow lashes along the lids between landmarks [68, 3], curved away from the eye."""
    paths = []
    for ids, count in _LIDS:
        along = np.sort(random.uniform(0.06, 0.97, count))
        lid = CubicSpline(np.linspace(0, 1, 4), landmarks_m[list(ids)])(along)
        eye = landmarks_m[36:42] if ids[0] < 42 else landmarks_m[42:48]
        away = unit((lid - eye.mean(0)) * [1.0, 0.6, 0.0])
        opening = float(np.linalg.norm(eye[[1, 2]].mean(0) - eye[[4, 5]].mean(0)))
        upward = 1.8 * float(smoothstep(np.array(opening), 0.002, 0.007)) - 0.8 if count == 110 else -1.0
        share = np.linspace(0, 1, _LASHES.segments + 1)[:, None, None]
        length = _LASH_M[count] * random.uniform(0.6, 1.1, (count, 1))
        ahead, rise = np.array([0, 0, 1.0]), np.array([0, upward, 0])
        bent = ahead * (share - 0.35 * share**2) + rise * (0.25 * share + 0.5 * share**2) + 0.3 * share * away
        paths.append(np.moveaxis(lid + length * bent + random.normal(0, 2e-4, lid.shape) * share, 0, 1))
    whole = np.concatenate(paths)
    normals = np.broadcast_to([0.0, 0.0, 1.0], whole.shape)
    return _labelled(ribbons(whole, normals, normals[:, 0], _LASHES, random), "eyes")


def _labelled(strands: HeadMesh, name: str) -> HeadMesh:
    strands.label[:] = class_index(name)
    return strands
