"""Heads agree with the canonical mesh, shut their eyes and open their mouths."""

import numpy as np
import pytest
import torch
import trimesh

from facerf_cli.face.importers.find_landmarks import nearest_on_mesh
from facerf_cli.face.importers.resample import skin_uv
from facerf_cli.face.morphable import HEAD_PARTS, MorphableModel, load_face_model
from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.head import heads
from facerf_cli.synth.head.heads import build_head
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, loop_step

FULL = 1 / 0.3  # the coefficient of a whole blendshape


def beta(model: MorphableModel, **strengths: float) -> torch.Tensor:
    out = torch.zeros(len(model.expression))
    for name, strength in strengths.items():
        out[model.expression_names.index(name)] = strength * FULL
    return out


def head(model: MorphableModel, alpha=(0.0, 0.0), gaze_deg=(0.0, 0.0), subdivisions=1, **strengths):
    return build_head(model, torch.tensor(alpha), beta(model, **strengths), gaze_deg, subdivisions)


def seen_parts(mesh: HeadMesh, centre_m: tuple[float, float, float], across_m: float) -> dict[str, int]:
    """Number of pixels, of a 256 x 256 image from the front, that show each part."""
    side = 256
    camera = Camera(side / across_m, side, side, side / 2, side / 2)
    vertices = torch.from_numpy(mesh.vertices) - torch.tensor(centre_m) - torch.tensor([0, 0, 1.0])
    shown = rasterize(vertices, torch.from_numpy(mesh.triangles), camera).triangle
    owner = mesh.part[mesh.triangles[shown[shown >= 0].numpy(), 0]]
    return {name: int((owner == index).sum()) for index, name in enumerate(PARTS)}


LEFT_EYE, MOUTH = (0.031, 0.034, 0.0), (0.0, -0.034, 0.0)


@pytest.mark.parametrize(("alpha", "jaw"), [((0.0, 0.0), 0.0), ((1.5, -1.0), 0.4)])
def test_the_head_and_the_canonical_mesh_agree(ict_model, alpha, jaw):
    found = head(ict_model, alpha, jawOpen=jaw)
    canonical = ict_model.vertices(torch.tensor([alpha]), beta(ict_model, jawOpen=jaw)[None])
    surface = trimesh.Trimesh(found.vertices, found.triangles, process=False)
    landmarks = ict_model.landmarks(canonical)[0].numpy()
    off_m = np.linalg.norm(nearest_on_mesh(surface, landmarks)[0] - landmarks, axis=-1)
    assert off_m.max() < 0.001 and np.median(off_m) < 0.0002


def test_its_mesh_is_whole_and_subdivision_slides_the_texture_along(ict_model):
    mesh = head(ict_model)
    assert (mesh.part[mesh.triangles] == mesh.part[mesh.triangles[:, :1]]).all()
    assert len(np.unique(mesh.triangles)) == len(mesh.vertices)
    assert {PARTS[index] for index in np.unique(mesh.part)} == set(HEAD_PARTS)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-5)
    around = (mesh.part == 0) & (mesh.vertices[:, 1] < 0.1)  # below the crown's pole
    turns = np.ptp(mesh.uv[mesh.triangles[around[mesh.triangles].all(-1)]][..., 0], axis=1)
    assert turns.max() < 0.2  # no triangle goes all around by way of the face
    kinds = (mesh.vertices, mesh.normals, mesh.uv, mesh.tangents)
    assert all(values.dtype == np.float32 for values in kinds)
    assert mesh.triangles.dtype == np.int64 and mesh.part.dtype == np.uint8
    beside = np.abs(np.abs(mesh.uv[:, 0] - 0.5) - 0.3) < 0.08
    cheek = np.flatnonzero((mesh.part == 0) & beside & (np.abs(mesh.uv[:, 1] - 0.6) < 0.2))
    expected = skin_uv(mesh.vertices[cheek].astype(np.float64), ict_model.mean.numpy())
    off = np.abs(mesh.uv[cheek] - expected)
    assert np.percentile(off, 99) < 0.0006  # 0.1 mm; left where they were they zigzag by five times that


def test_normals_look_outward_and_subdivision_refines_the_skin(ict_model):
    mesh = head(ict_model)
    skull = (mesh.part == 0) & (mesh.vertices[:, 1] > 0.06)
    assert ((mesh.normals * mesh.vertices)[skull].sum(-1) > 0).mean() > 0.999
    back = skull & (mesh.vertices[:, 2] < -0.05) & (np.abs(mesh.vertices[:, 0]) < 1e-4)
    assert np.abs(mesh.normals[back, 0]).max() < 0.02
    coarse, fine = head(ict_model, subdivisions=0), head(ict_model, subdivisions=1)
    counts = [
        [(mesh.part[mesh.triangles[:, 0]] == part).sum() for part in range(4)] for mesh in (coarse, fine)
    ]
    assert [after / before for before, after in zip(*counts, strict=True)] == [4, 4, 1, 1]
    mesh = head(ict_model)
    skin = mesh.part == 0
    landmarks = ict_model.landmarks(ict_model.mean[None])[0].numpy()
    off_m = np.linalg.norm(mesh.vertices[skin][None] - landmarks[:, None], axis=-1)
    off_uv = np.abs(mesh.uv[skin][off_m.argmin(1)] - LANDMARK_UV)
    assert off_uv.max() < 0.02 and np.median(off_uv) < 0.004  # a vertex's spacing is 0.007


@pytest.mark.parametrize("alpha", [(0.0, 0.0), (1.5, 1.0), (-1.5, -1.0)])
def test_lids_shut_over_the_ball(ict_model, alpha):
    views = [seen_parts(head(ict_model, alpha, eyeBlink_L=b), LEFT_EYE, 0.04)["eye"] for b in (0, 0.5, 1)]
    assert views[0] > 5000 and 0.15 < views[1] / views[0] < 0.75
    assert views[2] < 0.01 * views[0]


def test_lids_follow_the_gaze_and_lower_teeth_the_jaw(ict_model):
    mesh = head(ict_model, eyeBlink_L=0.5, gaze_deg=(0.0, 15.0))
    surface = trimesh.Trimesh(mesh.vertices, mesh.triangles[mesh.part[mesh.triangles[:, 0]] == 1])
    ball = max(surface.split(), key=lambda piece: piece.centroid[0])
    skin = mesh.vertices[mesh.part == 0]
    near = skin[np.linalg.norm(skin - ball.centroid, axis=-1) < 0.025]
    closest, faces = nearest_on_mesh(ball, near)
    assert ((near - closest) * ball.face_normals[faces]).sum(-1).min() > -0.0001
    lid = head(ict_model).vertices
    down = head(ict_model, gaze_deg=(0.0, -20.0)).vertices
    moved = (down - lid)[head(ict_model).part == 0]
    assert moved[:, 1].min() < -0.003
    shut = [head(ict_model, gaze_deg=(0.0, g), eyeBlink_L=1.0) for g in (0.0, -20.0)]
    assert seen_parts(shut[1], LEFT_EYE, 0.04)["eye"] < 60
    left_skin = (shut[0].part == 0) & (shut[0].vertices[:, 0] > 0.005)
    assert np.abs(shut[0].vertices - shut[1].vertices)[left_skin].max() < 0.002
    closed, opened = head(ict_model), head(ict_model, jawOpen=0.5)
    drop = (closed.vertices - opened.vertices)[closed.part == PARTS.index("teeth"), 1]
    assert 0.01 < drop.max() < 0.03
    assert 0.3 < (drop > 0.005).mean() < 0.7 and (np.abs(drop) < 1e-5).mean() > 0.3


def test_eyes_look_along_the_gaze(ict_model):
    def apexes(gaze_deg):
        mesh = head(ict_model, gaze_deg=gaze_deg)
        eye = mesh.part == 1
        middle = eye & (np.linalg.norm(mesh.uv - 0.5, axis=-1) < 0.01)
        left = mesh.vertices[:, 0] > 0
        balls = [(mesh.vertices[eye & s], mesh.vertices[middle & s].mean(0)) for s in (left, ~left)]
        return [apex - (ball.min(0) + ball.max(0)) / 2 for ball, apex in balls]

    for ahead, turned in zip(apexes((0, 0)), apexes((20, 0)), strict=True):
        by = np.degrees(np.arctan2(turned[0], turned[2]) - np.arctan2(ahead[0], ahead[2]))
        assert abs(by - 20) < 1.5  # to the right of the image
    for ahead, turned in zip(apexes((0, 0)), apexes((0, 12)), strict=True):
        by = np.degrees(np.arctan2(turned[1], turned[2]) - np.arctan2(ahead[1], ahead[2]))
        assert abs(by - 12) < 1.5  # up


@pytest.mark.parametrize("alpha", [(0.0, 0.0), (2.0, 1.0), (-2.0, 1.0)])
def test_lips_rest_on_each_other_until_the_jaw_opens(ict_model, alpha):
    closed = seen_parts(head(ict_model, alpha), MOUTH, 0.08)
    assert closed["teeth"] + closed["mouth"] < 20
    opened = seen_parts(head(ict_model, alpha, jawOpen=0.5), MOUTH, 0.08)
    assert opened["teeth"] + opened["mouth"] > 1000


def test_a_model_without_a_head_gets_a_shell(monkeypatch):
    asked = []

    def shell_head(*arguments):
        asked.append(arguments)
        return "a shell"

    monkeypatch.setattr(heads, "shell_head", shell_head)
    model = load_face_model()
    alpha, expression = torch.zeros(len(model.identity)), torch.zeros(len(model.expression))
    assert build_head(model, alpha, expression, (3.0, 4.0), 2) == "a shell"
    (vertices, gaze_deg, subdivisions), *_ = asked
    assert torch.equal(vertices, model.mean) and gaze_deg == (3.0, 4.0) and subdivisions == 2


def test_loop_subdivision_keeps_what_it_must_and_sheets_flat():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    step, triangles = loop_step(np.asarray(mesh.faces), len(mesh.vertices))
    assert np.allclose(step @ np.ones(len(mesh.vertices)), 1)
    fine = trimesh.Trimesh(step @ mesh.vertices, triangles, process=False)
    assert fine.is_watertight and fine.volume > 0 and fine.euler_number == 2
    known = trimesh.remesh.subdivide_loop(mesh.vertices, mesh.faces, iterations=1)[0]
    assert np.allclose(np.sort(np.linalg.norm(known, axis=1)), np.sort(np.linalg.norm(fine.vertices, axis=1)))
    y, x = np.mgrid[:5, :5]
    points = np.stack([x, y, x + 2 * y], -1).reshape(-1, 3).astype(float)
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1)
    triangles = np.concatenate(
        [np.stack([corner, corner + 1, corner + 6], -1), np.stack([corner, corner + 6, corner + 5], -1)]
    )
    fine = loop_step(triangles, 25)[0] @ points
    assert np.allclose(fine[:, 2], fine[:, 0] + 2 * fine[:, 1])
    assert fine[:, 0].min() > -1e-9 and (np.abs(fine[:, 0]) < 1e-9).sum() == 9 - 2  # corners are rounded
