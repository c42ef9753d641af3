"""Random subjects of the synthetic light stage: head, expression, skin, hair, clothes and glasses."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.morphable import EXPRESSION_STD, MorphableModel
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.synth.appearance.materials import Appearance, canvas_uv, draw_appearance, with_short_hair
from facerf_cli.synth.bank.heads import HeadBakeSettings, draw_coefficients
from facerf_cli.synth.head.body import chin_height_m, draw_body
from facerf_cli.synth.head.glasses import draw_glasses
from facerf_cli.synth.head.hair import draw_hair, grow_beard, grow_lashes
from facerf_cli.synth.head.hair_styles import scalp_cover
from facerf_cli.synth.head.mesh import HeadMesh, joined
from facerf_cli.synth.head.shell import shell_head
from facerf_cli.synth.head.worn import Headwear, draw_earrings, draw_hand, draw_headwear, draw_microphone
from facerf_cli.synth.random_fields import Random, generators
from facerf_cli.synth.views import more_landmarks

_SMALL_PX = 96  # images up to this side show coarse meshes
_BODY_EDGE_M = 0.008  # mean length of an edge of body and garment, in larger images
_POSE_STD_DEG = (6.0, 4.0, 2.0)  # yaw, pitch and roll of subjects who look ahead
_GAZE_STD_DEG = 6.0
_CLOSED_SHARE, _GLASSES_SHARE, _HEADWEAR_SHARE = 0.08, 0.15, 0.15  # with closed eyes, glasses, headwear
_HELD, _HELD_SHARES, _EARRINGS_SHARE = ("none", "hand", "microphone"), (0.89, 0.08, 0.03), 0.2


@dataclass(frozen=True, eq=False)
class SyntheticPerson:
    """Person in the stage: mesh in world space (m) and materials."""

    mesh: HeadMesh
    appearance: Appearance
    head_to_world: Tensor  # [3, 3]
    face_vertices: Tensor  # [GRID * GRID, 3] of the canonical mesh, head frame
    landmarks_world: np.ndarray  # [68, 3], m
    more_landmarks_world: dict[str, list[float]]  # of `views.more_landmarks`, m
    traits: dict[str, Any]
    lenses: HeadMesh | None = None  # of glasses, in world space


def draw_person(
    model: MorphableModel, index: int, seed: int, size_px: int, arms: bool = False
) -> SyntheticPerson:
    """Draw subject number `index`, a function of (model, seed, index); `size_px` sets only its resolution.

    It reaches to the chest, or with whole `arms` to the hips.
    """
    random, generator = generators(seed, index)
    alpha, beta = draw_coefficients(model, random, HeadBakeSettings())
    closed = random.random() < _CLOSED_SHARE
    if closed:
        beta = _eyes_closed(model, beta)
    gaze = random.normal(0, _GAZE_STD_DEG, 2)
    pose_deg = random.normal(0, _POSE_STD_DEG)
    side = 512 if size_px <= 256 else 1024  # texels of the skin
    subdivisions = 0 if size_px <= _SMALL_PX else 1 if size_px <= 384 else 2  # edges of about a pixel
    appearance = draw_appearance(side, generator)
    face_vertices = model.vertices(alpha[None], beta[None])[0]
    bare = shell_head(face_vertices, (float(gaze[0]), float(gaze[1])), subdivisions)
    landmarks_m = model.landmarks(face_vertices[None])[0].numpy()
    edge_m = _BODY_EDGE_M if size_px > _SMALL_PX else 3 * _BODY_EDGE_M
    dressed, garment = draw_body(bare, random, edge_m, arms)
    headwear = draw_headwear(bare, chin_height_m(bare), random) if random.random() < _HEADWEAR_SHARE else None
    hair, style = draw_hair(dressed, random, headwear)
    cover = torch.from_numpy(scalp_cover(canvas_uv(side).numpy(), style))
    appearance = with_short_hair(appearance, cover, generator)
    more = more_landmarks(bare)
    lobes = [place for name, place in more.items() if name.endswith("ear lobe")]
    worn, lenses, seen = _worn(bare, landmarks_m, lobes, appearance, headwear, random)
    head_to_world = pose_to_rotation(*(float(angle) for angle in pose_deg))
    turn = head_to_world.numpy()
    mesh = _rotated(joined(dressed, *([hair] if hair else []), *worn), turn)
    more_world = {name: (place @ turn.T).round(6).tolist() for name, place in more.items()}
    traits = appearance.traits | {
        "hair": style.name,
        "garment": garment,
        "headwear": headwear.kind if headwear else "none",
        **seen,
        "eyes_closed": closed,
        "pose_deg": pose_deg.round(3).tolist(),
        "gaze_deg": gaze.round(3).tolist(),
    }
    return SyntheticPerson(
        mesh,
        appearance,
        head_to_world,
        face_vertices,
        landmarks_m @ turn.T,
        more_world,
        traits,
        _rotated(lenses, turn) if lenses else None,
    )


def _worn(
    bare: HeadMesh,
    landmarks_m: np.ndarray,
    lobes: list[np.ndarray],
    appearance: Appearance,
    headwear: Headwear | None,
    random: Random,
) -> tuple[list[HeadMesh], HeadMesh | None, dict[str, Any]]:
    """Draw what a head wears and holds, with lashes and beard; return also lenses and the traits."""
    beard = grow_beard(bare, appearance.traits, random)
    meshes = [grow_lashes(landmarks_m, random), *([beard] if beard else [])]
    glasses, held = random.random() < _GLASSES_SHARE, str(random.choice(_HELD, p=_HELD_SHARES))
    drawn = draw_glasses(bare, landmarks_m, random) if glasses else None
    if drawn:
        meshes.append(drawn.frame)
    if headwear:
        meshes.append(headwear.mesh)
    if held != "none":
        meshes.append(draw_hand(bare, random) if held == "hand" else draw_microphone(random))
    earrings = random.random() < _EARRINGS_SHARE and (not headwear or headwear.kind != "headscarf")
    if earrings and lobes:
        meshes.append(draw_earrings(lobes, random))
    traits = {"glasses": glasses, "held": held, "earrings": earrings}
    return meshes, drawn.lenses if drawn else None, traits


def _eyes_closed(model: MorphableModel, beta: Tensor) -> Tensor:
    """Close the eyes of an expression [Ke], and drop its other eye shapes."""
    lids = torch.tensor([name.startswith(("eyeBlink", "eye_close")) for name in model.expression_names])
    others = torch.tensor([name.startswith(("eye", "cheekSquint")) for name in model.expression_names])
    return torch.where(lids, 1 / EXPRESSION_STD, beta * ~others)


def _rotated(mesh: HeadMesh, rotation: np.ndarray) -> HeadMesh:
    fields = {name: getattr(mesh, name) @ rotation.T for name in ("vertices", "normals", "tangents")}
    return replace(mesh, **fields)
