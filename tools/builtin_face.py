"""The built-in morphable model: mean, identities and expressions made from tables of measures, not scans.

`python -m tools.builtin_face` writes it to `assets/builtin_face.npz`.

The identity basis is a Gaussian process on the mean face (Lüthi et al., 'Gaussian Process Morphable Models'):
smooth deformations at three length scales, mostly mirror symmetric, without rigid motion and with little
change of size, reduced to their largest modes.

Each expression is a short table of the displacements of landmarks and a few named skin points at the full
expression, in millimetres; all other control points stay. A thin-plate spline in UV space interpolates
between them; for the spline the mouth is pulled open, so that the two lips are neighbours only at the
corners. Two rules complete them: a lid slides over the eyeball, and the jaw turns about its hinge.
"""

import numpy as np
import torch
from scipy.interpolate import CubicSpline, RBFInterpolator
from scipy.linalg import eigh

from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, MorphableModel, save_face_model
from facerf_cli.face.topology import (
    BOTTOM_M,
    GRID,
    LANDMARK_UV,
    MIRROR_68,
    TOP_M,
    UV_SIZE_MM,
    grid_uv,
    inside_mm,
    locate,
)
from tools.anatomy import EYE_CENTRE_MM, EYE_RADIUS_MM, mean_vertices

IDENTITIES = 80  # modes kept
_SCALES_MM = ((80.0, 2.8), (35.0, 1.75))  # length scale, standard deviation along each axis
_DETAIL_SCALE_MM, _DETAIL_STD_MM = 14.0, (0.4, 1.1)  # at the rim of the face and around the nose
_DETAIL_CENTRE_MM, _DETAIL_REACH_MM = np.array([0, 2, 115.0]), 50.0
_ASYMMETRIC_SHARE = 0.02  # of the variance
_SIZE_STD = 0.035  # of the scale of the whole face
_NODE_STEP = 4  # the process is solved on every fourth row and column of vertices (Nyström)
_MIRROR = np.array([-1.0, 1, 1])

EXPRESSION_STD = 0.5  # one standard deviation is half the full expression

# Control points on the skin, on the image's left and the midline: name, x, y in millimetres.
_SKIN_POINTS = """
cheekbone -50 16 | apple -37 8 | under_eye -31 20 | cheek -45 -10 | buccal -42 -28 | crease -25 -14
nasal_side -12 22 | alar_groove -20 -2 | lid_crease -31 46 | outer_lid -50 41 | forehead -25 78
forehead_side -52 76 | temple -66 55 | chin_side -18 -56 | mouth_side -33 -36 | jaw -52 -42
"""
_MIDLINE_POINTS = "glabella 0 50 | forehead_mid 0 78 | chin_pad 0 -62 | mentolabial 0 -51 | bridge 0 30"
_LID_U = np.linspace(LANDMARK_UV[36, 0], LANDMARK_UV[39, 0], 9)[1:-1]  # control points along both lids

# expression | point:dx,dy,dz in millimetres; x is positive toward the midline. A row serves left and right.
_PAIRED = """
smile | 48:-7,7.5,-7 49:-5,4.5,-4.5 50:-2,2,-2 51:0,1.5,-1.5 59:-5,4.5,-4 58:-3,2.5,-2 57:0,2,-1.2
    60:-6,6.5,-6 61:-3,3,-2 62:0,1.9,-1 67:-3,3,-1.5 66:0,1.9,-.7 apple:-1.5,4,2 cheekbone:-.5,2,.5
    under_eye:-.5,1.5,.5 cheek:-3,3,1 buccal:-5,3,-1.5 crease:-4,4,.5 alar_groove:-1.5,1.5,0
    31:-1,.8,-.5 mouth_side:-6,5,-5.5 41:0,.8,0 40:0,.5,0 chin_side:-1,1,0
frown | 48:-1,-6,-2 49:-.5,-2.5,-.8 50:0,-1,-.4 59:-1,-3,-.5 58:-.4,-1,0 60:-1,-5,-1.5 61:0,-1.6,-.4
    67:0,-1.6,-.3 mouth_side:-1.5,-6,-1 buccal:-.5,-3,.5 crease:0,-1.8,-.5 chin_side:0,1,1
    chin_pad:0,1,.8
brow_up | 17:-.3,5,-1 18:-.4,7.5,-1.5 19:-.3,8,-1.5 20:0,7.5,-.8 21:.3,6.5,-.3 glabella:0,2,0
    forehead:0,3.5,0 forehead_side:0,2.5,0 forehead_mid:0,1.5,0 lid_crease:0,3,-.5
    outer_lid:0,1.5,-.3 temple:0,1,0
brow_down | 17:1,-1.5,1.2 18:2.5,-3.5,1.8 19:3,-4.5,1.5 20:2.5,-5,1.2 21:2,-4,1.5 glabella:.7,-2,.8
    forehead:.8,-1.8,0 forehead_side:.5,-1.2,0 lid_crease:.5,-3,.3 outer_lid:0,-1,.3 37:0,-.8,0
    38:0,-.8,0
eye_wide | 37:0,2,-.6 38:0,2.2,-.7 41:0,-.9,0 40:0,-.9,0 lid_crease:0,1.3,-.3
cheek_puff | cheek:-3,0,6.5 buccal:-5,0,9 crease:-1,0,3.5 mouth_side:-2,0,7 48:1,0,3 59:.5,0,2.5
    49:.5,.3,2.5 60:.8,0,2.5 apple:-.5,1,2 jaw:-3.5,0,3.5 chin_side:0,0,2 4:-3,0,1.5 3:-2.5,0,1
    5:-1,0,1.5
nose_wrinkle | 31:-.8,4,-.8 32:-.2,2.2,-.3 33:0,1.2,-.3 30:0,1,-.5 alar_groove:-1,5,.8
    nasal_side:.3,3,1.6 crease:-.5,5.5,.5 under_eye:0,2.5,1 apple:0,3,1 50:-.3,4,0 49:-.3,3.5,0
    51:0,2.2,0 61:-.2,3,0 62:0,1.8,0 48:-.3,2,0 60:-.3,1.8,0 21:1,-3,.6 20:1,-2.4,.6 19:.6,-1.6,.3
    glabella:.3,-1.8,.7 29:0,.6,.3 41:0,.8,0 40:0,1,0 bridge:0,.3,.6
upper_lip_raise | 50:-.6,5.5,-.6 49:-.8,4.5,-.4 51:0,4.5,-.5 61:-.6,5.5,-.5 62:0,4.5,-.3 48:-.3,2,0
    60:-.3,1.6,0 crease:-1,4,.5 31:-1,2.2,-.6 alar_groove:-1,2.8,.3 33:0,.8,0 32:0,1,0 apple:0,2,.8
lower_lip_drop | 59:-1.5,-4.5,-1 58:-.8,-6.5,-1 57:0,-6.5,-1 67:-.8,-6,-1 66:0,-6,-1 60:0,-.6,0
    48:0,-.8,0 mentolabial:0,-3,.4 chin_side:-.6,-1.5,.4 chin_pad:0,-.8,.2
mouth_stretch | 48:-7,-3,-5.5 60:-6,-2.6,-4.8 49:-3.5,-.6,-2.5 59:-4.5,-2.5,-2.5 58:-2,-1.5,-1.5
    67:-2.2,-1,-1.5 61:-2,-.6,-1.5 50:-1.2,0,-1 mouth_side:-6.5,-3.5,-3 buccal:-4,-2.5,1
    chin_side:-1.5,-1.5,0 crease:-1.5,-1,0
"""
_WHOLE = """
pucker | 48:8,.6,6.5 60:7.5,.4,6.5 49:5,1.5,7.5 50:2,2.2,8 51:0,2.4,8 61:3.2,.6,7.5 62:0,0,7.2
    59:5.5,0,7.5 58:3,-1.2,7 57:0,-1.6,6.5 67:3.4,.2,7.6 66:0,.5,7.4 mouth_side:6,0,3
    crease:2.2,-1,2.5 buccal:2.5,0,-.5 chin_side:1,1,1.5 mentolabial:0,.5,2 chin_pad:0,1.2,1
    33:0,-.6,.8
funnel | 48:6,0,6.5 60:5.5,0,6 49:3,3.5,7 50:1,5,7 51:0,5.4,7 61:1.5,4.6,5.5 62:0,4.8,5.5 59:3,-4,6
    58:1.2,-7,5 57:0,-7.5,4.6 67:1.6,-6.4,5.5 66:0,-6.8,5.5 mouth_side:4.5,0,3 crease:1.5,0,2
    mentolabial:0,-4.5,1 chin_side:.5,-2.5,0 chin_pad:0,-3,-1 8:0,-3,-1 7:0,-2.7,-1 6:0,-2,-.6
    33:0,.3,.4
lip_press | 51:0,-2.2,-3 50:0,-2.4,-3 49:-.5,-1.5,-2 48:-.8,-.3,-1 60:-.8,-.3,-1 61:0,-.4,-2.4
    62:0,-.8,-2.6 57:0,3,-2.4 58:0,2.8,-2.2 59:-.3,1.6,-1.4 66:0,.6,-2.4 67:0,.3,-2.2
    mentolabial:0,1.6,.8 chin_pad:0,1.4,.8 chin_side:0,1,.5 mouth_side:-.5,0,.5
lip_roll_in | 51:0,-3.4,-3 50:0,-3.6,-3 49:0,-2.2,-1.6 61:0,-.4,-3.6 62:0,-.6,-3.8 57:0,3.4,-2.6
    58:0,3.2,-2.6 59:0,1.7,-1.4 66:0,.6,-3.8 67:0,.3,-3.6
"""
# Jaw: share of the turn about the hinge at each control point; the corners of the lips follow about halfway.
_JAW_HINGE_MM, _JAW_TURN_DEG = np.array([0, 12.0, 25.0]), 17.0
_JAW_SHARE = """
2:.06 3:.2 4:.5 5:.85 6:1 7:1 8:1 48:.42 60:.42 59:.78 58:.96 57:1 67:.95 66:1 49:.14 50:.05 51:.03 61:.05
62:.03 mentolabial:1 chin_pad:1 chin_side:1 mouth_side:.5 buccal:.36 jaw:.5 cheek:.12 crease:.1
"""
_JAW_SIDEWAYS_MM = 9.0
_LIDS = {"upper_lid": [36, 37, 38, 39], "lower_lid": [36, 41, 40, 39]}
# A closed lid: distance from the eyeball, share of the opening that it closes, height of skin that follows.
_LID_OVER_BALL_MM, _LID_FALL, _LID_SKIN_MM = 1.5, 0.96, 11.0
_MOUTH_GAP_MM = 15.0  # by which the mouth is pulled open for the spline
_MOUTH_HOLLOW = 0.5  # depth of the opened mouth as a share of the distance between the lips


def build() -> MorphableModel:
    """Build the model; the result is the same on every call."""
    mean_m = mean_vertices()
    shapes = expression_shapes(mean_m)
    identity_m = identity_basis(mean_m * 1000) / 1000
    expression_m = EXPRESSION_STD * np.stack(list(shapes.values()))
    mean, identity, expression = (
        torch.from_numpy(array.astype(np.float32)) for array in (mean_m, identity_m, expression_m)
    )
    return MorphableModel(BUILTIN, "facerf's own (see LICENSE)", mean, identity, expression, tuple(shapes))


def identity_basis(mean_mm: np.ndarray) -> np.ndarray:
    """The largest modes [K, V, 3] in millimetres, scaled by their standard deviations, largest first."""
    nodes = np.arange(GRID * GRID).reshape(GRID, GRID)[::_NODE_STEP, ::_NODE_STEP].reshape(-1)
    motions = _similarity_motions(mean_mm)
    fit_motions = np.linalg.pinv(motions[nodes].reshape(-1, 7))  # least squares over the nodes
    still = np.eye(len(nodes) * 3) - motions[nodes].reshape(-1, 7) @ fit_motions
    size = _SIZE_STD * motions[..., 6]
    size_nodes = size[nodes].reshape(-1)
    covariance = still @ _covariance(mean_mm[nodes], mean_mm[nodes]) @ still
    covariance = covariance + np.outer(size_nodes, size_nodes)
    count = len(covariance)
    variance, modes = eigh(covariance, subset_by_index=(count - IDENTITIES, count - 1))
    variance, modes = variance[::-1], modes[:, ::-1]
    modes = modes * np.sign(modes[np.abs(modes).argmax(0), range(IDENTITIES)])  # same sign everywhere
    parts = np.array_split(mean_mm, 16)
    smooth = np.concatenate([_covariance(part, mean_mm[nodes]) @ (still @ modes) for part in parts])
    smooth = smooth.reshape(-1, 3, IDENTITIES)
    smooth = smooth - motions @ (fit_motions @ smooth[nodes].reshape(-1, IDENTITIES))
    grown = size[..., None] * (size_nodes @ modes)
    return np.moveaxis((smooth + grown) / np.sqrt(variance), -1, 0)  # Nyström's extension from the nodes


def _covariance(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """Matrix-valued kernel [A * 3, B * 3] in square millimetres between points a [A, 3] and b [B, 3].

    The symmetric part is the covariance of (f(x) + M f(M x)) / sqrt 2 with M the mirror.
    """
    direct, across = _kernel(a_mm, b_mm), _kernel(a_mm, b_mm * _MIRROR)
    own = direct[:, None, :, None] * np.eye(3)[:, None]
    mirrored = across[:, None, :, None] * np.diag(_MIRROR)[:, None]
    return (own + (1 - 2 * _ASYMMETRIC_SHARE) * mirrored).reshape(len(a_mm) * 3, len(b_mm) * 3)


def _kernel(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """Scalar covariance [A, B]: Gaussians of two broad scales and of a fine one that varies over the face."""
    squared = _squared_distance(a_mm, b_mm)
    broad = sum(std**2 * np.exp(-squared / (2 * scale**2)) for scale, std in _SCALES_MM)
    return broad + _detail(a_mm)[:, None] * _detail(b_mm) * np.exp(-squared / (2 * _DETAIL_SCALE_MM**2))


def _detail(points_mm: np.ndarray) -> np.ndarray:
    """Standard deviation [N] of fine deformation: larger at the features than at the forehead."""
    rim, features = _DETAIL_STD_MM
    nearness = np.exp(-((points_mm - _DETAIL_CENTRE_MM) ** 2).sum(-1) / (2 * _DETAIL_REACH_MM**2))
    return rim + (features - rim) * nearness


def _squared_distance(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    return (a_mm**2).sum(-1)[:, None] + (b_mm**2).sum(-1) - 2 * a_mm @ b_mm.T


def _similarity_motions(mean_mm: np.ndarray) -> np.ndarray:
    """Displacements [V, 3, 7] of the mean by translation, rotation and scaling about its centre."""
    centred = mean_mm - mean_mm.mean(0)
    shifts = np.broadcast_to(np.eye(3), (len(mean_mm), 3, 3))
    turns = np.cross(np.eye(3)[None], centred[:, None]).transpose(0, 2, 1)
    return np.concatenate([shifts, turns, centred[..., None]], -1)


def expression_shapes(mean_m: np.ndarray) -> dict[str, np.ndarray]:
    """Full displacements [V, 3] in metres by name of expression; `_left` is the subject's left."""
    uv = _point_uv(mean_m * 1000)
    shapes: dict[str, np.ndarray] = {}
    for name, moves in _rows(_PAIRED).items():
        right = _spread(uv, moves, other_side=0)
        shapes[name + "_left"], shapes[name + "_right"] = _mirror(right), right
    closed = _lid_closed(mean_m * 1000)
    shapes["eye_close_left"], shapes["eye_close_right"] = _mirror(closed), closed
    for name, moves in _rows(_WHOLE).items():
        shapes[name] = _spread(uv, moves, other_side=1)
    share = {name: float(part) for name, part in (cell.split(":") for cell in _JAW_SHARE.split())}
    cos, sin = np.cos(np.radians(_JAW_TURN_DEG)), np.sin(np.radians(_JAW_TURN_DEG))
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]) - np.eye(3)
    place = {name: _surface_mm(mean_m * 1000, uv[name]) - _JAW_HINGE_MM for name in share}
    shapes["jaw_open"] = _spread(uv, {name: part * turn @ place[name] for name, part in share.items()}, 1)
    aside = np.array([_JAW_SIDEWAYS_MM, 0, 0])
    sideways = _spread(uv, {name: part * aside for name, part in share.items()}, -1)
    shapes["jaw_left"], shapes["jaw_right"] = sideways, -sideways
    return {name: shape / 1000 for name, shape in shapes.items()}


def _rows(text: str) -> dict[str, dict[str, np.ndarray]]:
    """Parse a table into the moves [3] of control points by name of expression."""
    table: dict[str, dict[str, np.ndarray]] = {}
    for row in text.strip().replace("\n   ", "").splitlines():
        name, cells = row.split(" | ")
        pairs = (cell.split(":") for cell in cells.split())
        table[name] = {point: np.array([float(x) for x in move.split(",")]) for point, move in pairs}
    return table


def _point_uv(mean_mm: np.ndarray) -> dict[str, np.ndarray]:
    """The (u, v) [2] of every control point on the image's left half and midline, by name."""
    uv = {str(i): LANDMARK_UV[i] for i in range(68) if MIRROR_68[i] >= i and LANDMARK_UV[i, 0] <= 0.5}
    uv |= {str(i): LANDMARK_UV[i] for i in (48, 49, 50, 58, 59, 60, 61, 67)}
    rows = mean_mm.reshape(GRID, GRID, 3)
    for cell in (_SKIN_POINTS.replace("\n", "|") + "|" + _MIDLINE_POINTS).split("|"):
        if cell.strip():
            name, x, y = cell.split()
            v = (TOP_M - float(y) / 1000) / (TOP_M - BOTTOM_M)
            row = rows[round(v * (GRID - 1))]
            uv[name] = np.array([np.interp(float(x), row[:, 0], np.linspace(0, 1, GRID)), v])
    for lid, line in zip(_LIDS, _lid_lines(_LID_U), strict=True):
        uv |= {f"{lid}{k}": np.array([u, v]) for k, (u, v) in enumerate(zip(_LID_U, line, strict=True))}
    return uv


def _surface_mm(mean_mm: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The point [3] of the mean at one (u, v) [2]."""
    corners, weights = (tensor.numpy() for tensor in locate(uv[None]))
    return (mean_mm[corners[0]] * weights[0][:, None]).sum(0)


def _spread(uv: dict[str, np.ndarray], moves: dict[str, np.ndarray], other_side: int) -> np.ndarray:
    """Interpolate the moves of control points to a displacement [V, 3] in millimetres.

    On the other half of the face `other_side` 1 mirrors the moves, -1 repeats them, 0 sets them to zero.
    """
    moves = _along_lids(uv, moves)
    assert moves.keys() <= uv.keys(), moves.keys() - uv.keys()
    left = np.stack(list(uv.values()))
    move = np.stack([moves.get(name, np.zeros(3)) for name in uv])
    midline = left[:, 0] == 0.5
    side = ~midline
    if other_side == 0:
        move[midline] *= [0, 0.5, 0.5]
    mirrored = move[side] * {1: [-1, 1, 1], -1: [1, 1, 1], 0: [0, 0, 0]}[other_side]
    edge = [(u, v) for u in (0, 1) for v in np.linspace(0, 1, 7)] + [(u, 0) for u in (0.2, 0.4, 0.6, 0.8)]
    anchors = np.concatenate([left, left[side] * [-1, 1] + [1, 0], edge])
    values = np.concatenate([move, mirrored, np.zeros((len(edge), 3))])
    field = RBFInterpolator(_mouth_pulled_open(anchors), values, kernel="thin_plate_spline")
    grid = grid_uv().double().numpy()
    shape = field(_mouth_pulled_open(grid))
    upper, lower = _inner_lips(grid[:, 0])
    lips = (field(_mouth_pulled_open(np.stack([grid[:, 0], v], -1)))[:, 1] for v in (upper, lower))
    parted = np.maximum(np.subtract(*lips), 0)
    slit = np.clip(inside_mm("mouth", grid) / 0.8, 0, 1)
    shape[:, 2] -= _MOUTH_HOLLOW * slit * parted  # the slit of an open mouth shows its inside
    return shape


def _along_lids(uv: dict[str, np.ndarray], moves: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Add the moves of control points between a lid's landmarks, where the table does not set them."""
    filled = dict(moves)
    for lid, corners in _LIDS.items():
        ends = np.stack([moves.get(str(i), np.zeros(3)) for i in corners])
        for k, u in enumerate(_LID_U):
            between = [np.interp(u, LANDMARK_UV[corners, 0], ends[:, axis]) for axis in range(3)]
            filled.setdefault(f"{lid}{k}", np.array(between))
    return filled


def _mouth_pulled_open(uv: np.ndarray) -> np.ndarray:
    """Positions [N, 2] in mm on the unrolled cylinder with the lips apart, so that each lip moves alone."""
    upper, lower = _inner_lips(uv[:, 0])
    half_mm = np.maximum((lower - upper) / 2 * UV_SIZE_MM[1], 0.3)
    from_seam_mm = (uv[:, 1] - (upper + lower) / 2) * UV_SIZE_MM[1]
    corner = np.clip(1 - ((uv[:, 0] - 0.5) / (0.5 - LANDMARK_UV[60, 0])) ** 2, 0, None) ** 1.5
    side = np.clip(from_seam_mm / half_mm, -1, 1)
    apart = _MOUTH_GAP_MM * corner * side * np.exp(-np.abs(from_seam_mm) / 25)
    return uv * UV_SIZE_MM + np.stack([np.zeros_like(apart), apart], -1)


def _inner_lips(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The v [N] of the inner lines of upper and lower lip at u [N]."""
    inside = np.clip(u, LANDMARK_UV[60, 0], LANDMARK_UV[64, 0])
    lines = ([60, 61, 62, 63, 64], [60, 67, 66, 65, 64])
    upper, lower = (CubicSpline(LANDMARK_UV[ids, 0], LANDMARK_UV[ids, 1])(inside) for ids in lines)
    return upper, lower


def _lid_closed(mean_mm: np.ndarray) -> np.ndarray:
    """The displacement [V, 3] in mm that closes the upper lid over the eyeball on the image's left."""
    uv = grid_uv().double().numpy()
    (upper, lower), tall = _lid_lines(uv[:, 0]), (TOP_M - BOTTOM_M) * 1000
    opening = np.maximum(lower - upper, 0) * tall
    height = (lower - uv[:, 1]) * tall  # above the lower lid
    above = np.clip((height - opening) / _LID_SKIN_MM, 0, 1)
    fall = np.minimum(np.maximum(height, 0), opening) * _LID_FALL * (1 - above) ** 2 * (1 + 2 * above)
    moved = mean_mm - EYE_CENTRE_MM - fall[:, None] * [0, 1, 0]
    distance = np.linalg.norm(moved, axis=-1)
    lifted = moved * np.maximum(1, (EYE_RADIUS_MM + _LID_OVER_BALL_MM) / distance)[:, None]
    share = np.clip(fall / 2, 0, 1)[:, None]
    return EYE_CENTRE_MM + moved + share * (lifted - moved) - mean_mm


def _lid_lines(u: np.ndarray) -> list[np.ndarray]:
    """The v [N] of the margins of upper and lower lid at u [N]; equal at the corners and beyond."""
    inside = np.clip(u, LANDMARK_UV[36, 0], LANDMARK_UV[39, 0])
    return [CubicSpline(LANDMARK_UV[ids, 0], LANDMARK_UV[ids, 1])(inside) for ids in _LIDS.values()]


def _mirror(shape: np.ndarray) -> np.ndarray:
    """Mirror a displacement [V, 3] about the midline."""
    return (shape.reshape(GRID, GRID, 3)[:, ::-1] * [-1, 1, 1]).reshape(-1, 3)


if __name__ == "__main__":
    BUILTIN_PATH.parent.mkdir(exist_ok=True)
    save_face_model(BUILTIN_PATH, build())
