"""Arms of a synthetic person: bent at shoulders and elbows from MakeHuman's resting pose.

Body and garment are bent alike. A point turns about a joint by its share of the angle, which rises along the
arm, so that shoulders and elbows keep their thickness. Joints are MakeHuman's, of the left arm, in
decimetres; the right one is bent in a mirror.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head.mesh import HeadMesh, smooth_normals, smoothstep, unit
from facerf_cli.synth.random_fields import Random

NECK_DM = np.array([0.0, 5.95, 0.22])  # origin of the packed meshes
_SHOULDER, _ELBOW, _WRIST = np.array([[1.68, 5.25, 0.15], [3.13, 3.49, 0.13], [4.31, 2.45, 1.76]])
_UPPER, _FORE = unit(_ELBOW - _SHOULDER), unit(_WRIST - _ELBOW)
_BEGIN_DM, _END_DM = 1.2, 2.6  # |x| where the arm begins to turn, and where it turns fully
_ROUND_DM = (0.9, 1.4)  # distance from the bones within which all is arm, and beyond which nothing is,
_ASIDE_DM = (2.2, 2.8)  # but for what lies so far aside: wide sleeves
_BEND_DM = 0.5  # the forearm begins to turn this far before the elbow, and turns fully this far after
# Ranges of the angles in degrees: the arm is lowered, swung forward and twisted inward; the elbow is bent.
_LOWERED, _FORWARD, _TWISTED, _BENT = (0.0, 42.0), (-12.0, 40.0), (-25.0, 50.0), (-42.0, 60.0)
_ALIKE_SHARE = 0.4  # of people who hold both arms alike


def bend_arms(person: HeadMesh, origin_m: np.ndarray, grown: np.ndarray, random: Random) -> HeadMesh:
    """Bend the arms of a person and their sleeves at random.

    A packed point [3] lies at `grown` [3] times it plus `origin_m` [3]. Skin beyond the wrist becomes hand.
    """
    left = _draw_pose(random)
    right = left if random.random() < _ALIKE_SHARE else _draw_pose(random)
    places = 10 * (person.vertices - origin_m) / grown + NECK_DM
    held = places.copy()
    for side, pose in ((1, left), (-1, right)):
        of_side = places[:, 0] * side > _BEGIN_DM
        held[of_side] = _bent(places[of_side] * [side, 1, 1], *pose) * [side, 1, 1]
    moved = np.abs(held - places).max(1) > 0
    vertices = np.where(moved[:, None], (held - NECK_DM) / 10 * grown + origin_m, person.vertices)
    normals = smooth_normals(vertices, person.triangles)
    aside = np.abs(places[:, 0])
    along = (np.stack([aside, places[:, 1], places[:, 2]], -1) - _WRIST) @ _FORE
    hand = person.is_part("skin") & (aside > _ELBOW[0]) & (along > 0)
    return replace(
        person,
        vertices=vertices.astype(np.float32),
        normals=np.where(moved[:, None], normals, person.normals).astype(np.float32),
        label=np.where(hand, class_index("hand"), person.label).astype(np.uint8),
    )


def _draw_pose(random: Random) -> tuple[Rotation, Rotation]:
    """Draw turns of the left arm about the shoulder and of its forearm about the elbow."""
    lowered, forward, twisted, bent = (
        np.radians(random.uniform(*ends)) for ends in (_LOWERED, _FORWARD, _TWISTED, _BENT)
    )
    shoulder = Rotation.from_rotvec([-forward, 0, 0]) * Rotation.from_rotvec([0, 0, -lowered])
    return shoulder * Rotation.from_rotvec(twisted * _UPPER), Rotation.from_rotvec(
        bent * unit(np.cross(_UPPER, _FORE))
    )


def _bent(places: np.ndarray, shoulder: Rotation, elbow: Rotation) -> np.ndarray:
    """Bend points [N, 3] on the left of a resting body."""
    near = np.minimum(_off_bone(places, _SHOULDER, _ELBOW), _off_bone(places, _ELBOW, 2 * _WRIST - _ELBOW))
    is_arm = np.maximum(1 - smoothstep(near, *_ROUND_DM), smoothstep(places[:, 0], *_ASIDE_DM))
    arm = smoothstep(places[:, 0], _BEGIN_DM, _END_DM) * is_arm
    fore = smoothstep((places - _ELBOW) @ unit(_UPPER + _FORE), -_BEND_DM, _BEND_DM)
    turned = _turned(places, _ELBOW, elbow, arm * fore)
    return _turned(turned, _SHOULDER, shoulder, arm)


def _off_bone(places: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distance [N] of points [N, 3] from a bone."""
    along = np.clip((places - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return np.asarray(np.linalg.norm(places - start - along[:, None] * (end - start), axis=1))


def _turned(places: np.ndarray, joint: np.ndarray, turn: Rotation, share: np.ndarray) -> np.ndarray:
    """Turn points [N, 3] about a joint by fractions [N] of a turn."""
    return np.asarray(joint + Rotation.from_rotvec(share[:, None] * turn.as_rotvec()).apply(places - joint))
