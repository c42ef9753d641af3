"""Checks of the rig against the face: lights mirrored or turned as a whole, cameras swapped or misplaced.

Such faults leave the frames consistent with each other. But the normals of photometric stereo are then
mirrored or turned against those of a mean face fitted to the frames: by the fault of the rig, or by the
rotation from one camera to another.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.checks.frames import CameraFrames
from facerf_cli.capture.checks.shading import Stereo, angle_deg
from facerf_cli.capture.findings import Finding
from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera, fit_views
from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.portrait.find import choose_face, detect_faces
from facerf_cli.relighting.models import Networks

_TURN_DEG = 20.0  # sound rigs give 1 to 11, on Extended Yale B and synthetic faces
_SWAP_DEG, _LIKE_DEG = 12.0, 12.0  # least turn of a swapped camera; largest distance from the other's pose
_BETTER = 0.03  # least gain in mean cosine of a mirrored rig
# The mean face fitted to a side view may be turned by 42 degrees, on synthetic faces. Normals that face away
# from the camera tell this from a wrong pose. After the turn their share drops by 0.02 at most on sound
# cameras, by 0.04 to 0.3 where one is turned to a side by 40 degrees or more.
_LOOK_AWAY = 0.03
_APART_DEG = 45.0  # between normals after the first turn; beyond it are outliers such as glasses and hair
_LEAST_PX, _LEAST_NEAR = 100, 50  # pixels to compare, and those kept without outliers
_LEAN = 0.3  # correlation of a normal's x with the pixel's x, which is 0.6 to 0.9 on heads
_FACING = 0.3  # cosine to the camera: vertices at lower ones are hidden by the nose, or not skin


@dataclass(frozen=True, eq=False)
class Turn:
    """Best rotation of the measured normals onto those of the face."""

    rotation: np.ndarray  # [3, 3]
    likeness: float  # mean cosine between the normals after it

    @property
    def degrees(self) -> float:
        """Angle of the rotation."""
        return float(np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1))))

    def apply(self, normals: np.ndarray) -> np.ndarray:
        """Rotate normals [N, 3]."""
        return normals @ self.rotation.T


@dataclass(frozen=True, eq=False)
class RigFit:
    """Fit of the lights to the face that a camera sees, as declared and mirrored left to right."""

    camera: str
    turn: Turn
    mirrored: Turn
    turn_in_world: np.ndarray  # [3, 3] rotation of `turn`; equal in all cameras of a turned rig
    looking_away: float  # share of normals that face away from the camera, before less after the turn
    other: str  # camera whose pose would explain the turn; empty if none

    @property
    def is_mirrored(self) -> bool:
        """Tell whether the lights fit the face better when mirrored."""
        return self.mirrored.likeness > self.turn.likeness + _BETTER

    @property
    def is_off(self) -> bool:
        """Tell whether the lights do not fit the face."""
        return self.is_mirrored or self.turn.degrees > _TURN_DEG


def check_rigs(subject: str, rigs: Sequence[RigFit]) -> Iterator[Finding]:
    """Report swapped cameras, and either a rig that is off in most cameras or each camera that is off."""
    others = {rig.camera: rig.other for rig in rigs}
    swapped = [rig for rig in rigs if rig.other and others.get(rig.other) == rig.camera]
    for rig in swapped:
        words = (
            f"is lit as camera {rig.other} should be, and that one as this; swap their frames, or K and poses"
        )
        figures = {"turned_deg": round(rig.turn.degrees, 1)}
        yield Finding("error", "camera", subject, words, rig.camera, figures=figures)
    rest = [rig for rig in rigs if rig not in swapped]
    off = [rig for rig in rest if rig.is_off]
    if 2 * len(off) > len(rest) and _is_of_all(rest):
        advice = "their directions, their names or world_to_camera"
        yield _off(subject, off[0], "rig", "the lights are", advice)
        return
    for rig in off:
        if rig.is_mirrored or rig.looking_away > _LOOK_AWAY:
            what = "unlike in other cameras, the lights are"
            yield _off(subject, rig, "camera", what, "its world_to_camera, or its frames")


def _is_of_all(rigs: Sequence[RigFit]) -> bool:
    """Tell whether most cameras find the lights mirrored, or their mean turn is large.

    A mean face fitted to views from the left and from the right is turned in opposite ways; the mean cancels
    that.
    """
    if 2 * sum(rig.is_mirrored for rig in rigs) > len(rigs):
        return True
    u, _, vh = np.linalg.svd(np.mean([rig.turn_in_world for rig in rigs], axis=0))
    return Turn(u @ np.diag([1, 1, np.linalg.det(u @ vh)]) @ vh, 1.0).degrees > _TURN_DEG


def _off(subject: str, rig: RigFit, check: str, what: str, advice: str) -> Finding:
    """Error of lights that are mirrored or turned against the face."""
    turn = rig.mirrored if rig.is_mirrored else rig.turn
    ways = ["mirrored left to right"] if rig.is_mirrored else []
    ways += [f"turned by {turn.degrees:.0f} degrees"] if turn.degrees > _TURN_DEG else []
    words = f"{what} {' and '.join(ways)} against the face as this camera sees it; correct {advice}"
    figures = {
        "turned_deg": round(rig.turn.degrees, 1),
        "likeness": round(rig.turn.likeness, 3),
        "mirrored": round(rig.mirrored.likeness, 3),
    }
    return Finding("error", check, subject, words, rig.camera, figures=figures)


def check_rig_roughly(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Report mirrored lights without a face: the object's normals then point left on its right side."""
    columns = np.nonzero(stereo.lit)[1].astype(float)
    leaning = float(np.corrcoef(stereo.normals[:, 0], columns)[0, 1])
    if leaning < -_LEAN:
        words = "the object looks hollow from left to right; check whether lights or images are mirrored"
        yield frames.error("rig", words, leaning=round(leaning, 2))


@dataclass(frozen=True, eq=False)
class FaceNormals:
    """Normals of the fitted mean face at the pixels of a camera's small frames."""

    pixels: np.ndarray  # [N] indices into the flattened image, one for each visible vertex
    normals: np.ndarray  # [N, 3] unit, camera space


def find_face_normals(frames: CameraFrames, posed: PosedCamera, networks: Networks) -> FaceNormals | None:
    """Fit the mean face to the landmarks in the mean of all frames; None without a face."""
    rgb = np.repeat(frames.lit[..., None], 3, -1).clip(0)
    faces = detect_faces(networks.parsing, to_display(rgb)) if rgb.max() > 0 else []
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
    """Project the vertices [V, 3] in world space, and their normals, to the pixels that see them."""
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


def measure_rig(
    frames: CameraFrames, stereo: Stereo, face: FaceNormals, cameras: Mapping[str, PosedCamera]
) -> RigFit | None:
    """Compare the normals of photometric stereo with the face; None where too little of it is lit."""
    place = np.full(stereo.lit.size, -1)
    place[stereo.lit.ravel()] = np.arange(stereo.lit.sum())
    rows = place[face.pixels]
    found, known = stereo.normals[rows[rows >= 0]], face.normals[rows >= 0]
    if len(found) < _LEAST_PX:
        return None
    turn = best_turn(found, known)
    to_camera = cameras[frames.camera].rotation.double().numpy()
    before, after = ((normals[:, 2] < 0).mean() for normals in (stereo.normals, turn.apply(stereo.normals)))
    return RigFit(
        camera=frames.camera,
        turn=turn,
        mirrored=best_turn(found * [-1, 1, 1], known),
        turn_in_world=to_camera.T @ turn.rotation @ to_camera,
        looking_away=float(before - after),
        other=_other_camera(turn, frames.camera, cameras),
    )


def best_turn(found: np.ndarray, known: np.ndarray) -> Turn:
    """Fit the rotation of normals [N, 3] onto others by the Kabsch algorithm, once more without outliers."""
    near = np.ones(len(found), bool)
    for _ in range(2):
        u, _, vh = np.linalg.svd(found[near].T @ known[near])
        rotation = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vh))]) @ vh).T
        turned = found @ rotation.T
        near = angle_deg(turned, known) < _APART_DEG
        if near.sum() < _LEAST_NEAR:
            near[:] = True
    return Turn(rotation, float((turned * known).sum(1).mean()))


def _other_camera(turn: Turn, camera: str, cameras: Mapping[str, PosedCamera]) -> str:
    """Camera whose pose would turn the normals onto the face's; empty if none is near."""
    back = turn.rotation @ cameras[camera].rotation.double().numpy()
    off_deg = {
        name: Turn(back @ posed.rotation.double().numpy().T, 1.0).degrees
        for name, posed in cameras.items()
        if name != camera
    }
    nearest = min(off_deg, key=lambda name: off_deg[name], default="")
    return nearest if nearest and turn.degrees > _SWAP_DEG and off_deg[nearest] < _LIKE_DEG else ""
