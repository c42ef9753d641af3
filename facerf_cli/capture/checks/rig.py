"""Normals of a mean face laid onto a camera's frames: what photometric stereo should find there.

All lamps mirrored or turned together, two cameras' frames swapped, a camera misplaced: the face tells.

Frames then agree with each other. But the face's normals, known from a mean face laid over it, are mirrored
or turned against those of photometric stereo: by what is wrong with the rig, or by the turn from one camera
to the other.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, Stereo
from facerf_cli.capture.checks.shading import angle_deg
from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera, fit_views
from facerf_cli.face.landmarks import choose_face, detect_landmarks, to_display
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles

_FACING = 0.3  # cosine: vertices seen more obliquely are hidden behind the nose or are not skin


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """Pixels [N] of a camera's small frames, laid flat, where a vertex is seen, and its normal [N, 3]."""

    pixels: np.ndarray
    normals: np.ndarray  # unit, camera space


def find_face_normals(frames: CameraFrames, posed: PosedCamera) -> FaceNormals | None:
    """A mean face fitted to the landmarks found on the mean of all frames; None where there is no face."""
    rgb = np.repeat(frames.lit[..., None], 3, -1).clip(0)
    faces = detect_landmarks(to_display(rgb)) if rgb.max() > 0 else []
    if not faces:
        return None
    landmarks_px = choose_face(faces, "largest", frames.camera)[0].landmarks_px * frames.lit_scale
    try:
        joint = fit_views(_mean_face(), [posed], [landmarks_px])
    except InputError:
        return None
    return _on_pixels(frames, posed, joint.vertices_world(_mean_face()))


@cache
def _mean_face() -> MorphableModel:
    return load_face_model()


def _on_pixels(frames: CameraFrames, posed: PosedCamera, vertices: torch.Tensor) -> FaceNormals:
    """Vertices [V, 3] of the world, and their normals, where the camera sees them."""
    corners = vertices[grid_triangles().long()]  # [F, 3, 3]
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add(
        0, grid_triangles().long().flatten(), flat.repeat_interleave(3, 0)
    )
    normals = (F.normalize(summed, dim=-1) @ posed.rotation.double().mT).numpy()
    px = np.floor(posed.project(vertices).numpy() / frames.scale).astype(int)
    height, width = frames.grey.shape[1:]
    seen = ((px >= 0) & (px < [width, height])).all(1) & (normals[:, 2] > _FACING)
    return FaceNormals(px[seen, 1] * width + px[seen, 0], normals[seen])


_TURN_DEG = 20.0  # sound rigs are found turned by 1 to 11, on Extended Yale B and synthetic faces
_SWAP_DEG, _LIKE_DEG = 12.0, 12.0  # and two cameras each turned to the other, as near as that
_BETTER = 0.03  # of the mean cosine between normals, by which a mirrored rig must win
# A face seen from the side may be laid on turned by 42 degrees, on synthetic faces. What tells that from a
# wrong pose are normals that look away from the camera, less of them after the turn: by 0.02 of all at most
# on sound cameras, by 0.04 to 0.3 where one is turned to a side by 40 degrees or more.
_LOOK_AWAY = 0.03
_APART_DEG = 45.0  # between normals after the first turn: glasses, hair
_LEAN = 0.3  # correlation of a normal's x with the pixel's: 0.6 to 0.9 on heads


@dataclass(frozen=True, eq=False)
class Turn:
    """The rotation [3, 3] that takes the normals found onto those of the face, and their mean cosine then."""

    rotation: np.ndarray
    likeness: float

    @property
    def degrees(self) -> float:
        """How far it turns."""
        return float(np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1))))

    def of(self, normals: np.ndarray) -> np.ndarray:
        """Normals [N, 3], turned."""
        return normals @ self.rotation.T


@dataclass(frozen=True, eq=False)
class Rig:
    """How the lamps lie against the face that a camera sees, as they are and mirrored left to right."""

    camera: str
    turn: Turn
    mirrored: Turn
    turn_in_world: np.ndarray  # [3, 3] the turn's rotation; all cameras of a turned rig have the same
    looking_away: float  # share of the normals that look away from the camera, less that after the turn
    other: str  # the camera whose place explains the turn, if there is one

    @property
    def is_mirrored(self) -> bool:
        """Whether the lights fit the face better when mirrored."""
        return self.mirrored.likeness > self.turn.likeness + _BETTER

    @property
    def is_off(self) -> bool:
        """Whether the lights do not fit the face."""
        return self.is_mirrored or self.turn.degrees > _TURN_DEG


def measure_rig(
    frames: CameraFrames, stereo: Stereo, face: FaceNormals, cameras: Mapping[str, PosedCamera]
) -> Rig | None:
    """None where too little of the face is lit."""
    place = np.full(stereo.lit.size, -1)
    place[stereo.lit.ravel()] = np.arange(stereo.lit.sum())
    rows = place[face.pixels]
    found, known = stereo.normals[rows[rows >= 0]], face.normals[rows >= 0]
    if len(found) < 100:
        return None
    turn = best_turn(found, known)
    to_camera = cameras[frames.camera].rotation.double().numpy()
    before, after = ((normals[:, 2] < 0).mean() for normals in (stereo.normals, turn.of(stereo.normals)))
    return Rig(
        camera=frames.camera,
        turn=turn,
        mirrored=best_turn(found * [-1, 1, 1], known),
        turn_in_world=to_camera.T @ turn.rotation @ to_camera,
        looking_away=float(before - after),
        other=_other_camera(turn, frames.camera, cameras),
    )


def best_turn(found: np.ndarray, known: np.ndarray) -> Turn:
    """Of normals onto others [N, 3] (Kabsch)."""
    near = np.ones(len(found), bool)
    for _ in range(2):
        u, _, vh = np.linalg.svd(found[near].T @ known[near])
        rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vh))]) @ vh).T
        turned = found @ rotation.T
        near = angle_deg(turned, known) < _APART_DEG
        if near.sum() < 50:
            near[:] = True
    return Turn(rotation, float((turned * known).sum(1).mean()))


def _other_camera(turn: Turn, camera: str, cameras: Mapping[str, PosedCamera]) -> str:
    """The camera that one would have to be for its normals to be the face's; empty where none comes near."""
    back = turn.rotation @ cameras[camera].rotation.double().numpy()
    off_deg = {
        name: Turn(back @ posed.rotation.double().numpy().T, 1.0).degrees
        for name, posed in cameras.items()
        if name != camera
    }
    nearest = min(off_deg, key=lambda name: off_deg[name], default="")
    return nearest if nearest and turn.degrees > _SWAP_DEG and off_deg[nearest] < _LIKE_DEG else ""


def check_rigs(subject: str, rigs: Sequence[Rig]) -> Iterator[Finding]:
    """An error for the rig where most cameras find the lights off alike, else one for each that does.

    Before that one for each camera whose place is that of another, and the other's its own.
    """
    others = {rig.camera: rig.other for rig in rigs}
    swapped = [rig for rig in rigs if rig.other and others.get(rig.other) == rig.camera]
    for rig in swapped:
        words = (
            f"is lit as camera {rig.other} would be, and that one as this; swap their frames, or K and poses"
        )
        figures = {"turned_deg": round(rig.turn.degrees, 1)}
        yield Finding("error", "camera", subject, words, rig.camera, figures=figures)
    rest = [rig for rig in rigs if rig not in swapped]
    off = [rig for rig in rest if rig.is_off]
    if 2 * len(off) > len(rest) and _is_of_all(rest):
        what = "their directions or world_to_camera, or names that are one off"
        yield _off(subject, off[0], "rig", "the lights are", what)
        return
    for rig in off:
        if rig.is_mirrored or rig.looking_away > _LOOK_AWAY:
            here = "unlike in other cameras, the lights are"
            yield _off(subject, rig, "camera", here, "its world_to_camera, or its frames")


def _is_of_all(rigs: Sequence[Rig]) -> bool:
    """Whether most cameras find the lights mirrored, or all in the mean that they are turned the same way.

    Faces seen from the left and from the right are laid on wrongly in opposite ways.
    """
    if 2 * sum(rig.is_mirrored for rig in rigs) > len(rigs):
        return True
    u, _, vh = np.linalg.svd(np.mean([rig.turn_in_world for rig in rigs], axis=0))
    return Turn(u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh, 1.0).degrees > _TURN_DEG


def _off(subject: str, rig: Rig, check: str, what: str, mend: str) -> Finding:
    """An error: what is mirrored or turned against the face, and what to mend."""
    turn = rig.mirrored if rig.is_mirrored else rig.turn
    ways = ["mirrored left to right"] if rig.is_mirrored else []
    ways += [f"turned by {turn.degrees:.0f} degrees"] if turn.degrees > _TURN_DEG else []
    words = f"{what} {' and '.join(ways)} against the face as this camera sees it; mend {mend}"
    figures = {
        "turned_deg": round(rig.turn.degrees, 1),
        "likeness": round(rig.turn.likeness, 3),
        "mirrored": round(rig.mirrored.likeness, 3),
    }
    return Finding("error", check, subject, words, rig.camera, figures=figures)


def check_rig_roughly(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """One error where normals lean left on the right of the object: for cameras without a face to compare."""
    columns = np.nonzero(stereo.lit)[1].astype(float)
    leaning = float(np.corrcoef(stereo.normals[:, 0], columns)[0, 1])
    if leaning < -_LEAN:
        words = "what is lit is hollow from left to right; are the lights mirrored, or the pictures?"
        figures = {"leaning": round(leaning, 2)}
        yield Finding("error", "rig", frames.subject, words, frames.camera, figures=figures)
