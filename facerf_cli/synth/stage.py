"""A light stage in software: subjects, lights and cameras, photographed into a capture (DESIGN, 'Files')."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import save_file
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli import __version__
from facerf_cli.capture.stage_json import STAGE_FILE, STAGE_FORMAT
from facerf_cli.errors import UsageError
from facerf_cli.face.importers.source import EXPRESSION_STD
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import write_document
from facerf_cli.files.images import write_exr
from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sphere import RIG_LIGHTS, rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.logs import COMPUTER_GRAPHICS_SOURCE_TYPE, Provenance
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.texture import bake_attributes
from facerf_cli.synth import bake_renderer, path_tracer
from facerf_cli.synth.appearance.materials import Appearance, canvas_uv, draw_appearance, with_scalp
from facerf_cli.synth.head.clothes import draw_clothes
from facerf_cli.synth.head.glasses import draw_glasses
from facerf_cli.synth.head.hair import draw_hair
from facerf_cli.synth.head.hair_styles import scalp_cover
from facerf_cli.synth.head.heads import build_head
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, joined
from facerf_cli.synth.heads_bank import GeometrySettings, draw_coefficients
from facerf_cli.synth.views import StageCamera

Renderer = Literal["bake", "mitsuba"]
# Azimuth and elevation of the cameras as seen from the head, all in front (paper, 'Dataset').
_CAMERAS_DEG = ((0, 0), (-18, 6), (18, -6), (-36, -4), (36, 4), (-54, 3), (54, -3), (0, 24))
_DISTANCE_M, _FRAME_M = 1.2, 0.36  # of a camera from the head, and the height that its picture shows there
_POSE_STD_DEG = (6.0, 4.0, 2.0)  # yaw, pitch and roll of people who were asked to look ahead
_GAZE_STD_DEG = 6.0
_CLOSED_SHARE, _GLASSES_SHARE = 0.08, 0.15
_TRANSPORT_SIDE = 128
_BAKE = BakeSettings()


@dataclass(frozen=True)
class StageSettings:
    """What a capture is made of; `size_px` is the side of a picture."""

    size_px: int = 256
    face_model: str = "builtin"
    renderer: Renderer = "bake"
    lights: int = RIG_LIGHTS
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Subject:
    """A person who has sat down: the mesh in world space, m, and what it is made of."""

    mesh: HeadMesh
    appearance: Appearance
    head_to_world: Tensor  # [3, 3]
    chart_vertices: Tensor  # [GRID * GRID, 3] of the canonical mesh, head frame
    landmarks_world: np.ndarray  # [68, 3], m
    traits: dict[str, Any]


@lru_cache(maxsize=1)
def subject_model(name_or_path: str) -> MorphableModel:
    """The face model, loaded once a process, as what is derived from it is."""
    return load_face_model(name_or_path)


def light_directions(settings: StageSettings) -> np.ndarray:
    """World-space unit directions [L, 3] toward the lights."""
    return rig_directions(settings.lights).numpy().astype(np.float64)


@lru_cache(maxsize=4)
def stage_cameras(size_px: int) -> tuple[StageCamera, ...]:
    """The eight cameras; the world's axes are those of a head that looks into the first."""
    camera = Camera(size_px * _DISTANCE_M / _FRAME_M, size_px, size_px, size_px / 2, size_px / 2)
    return tuple(
        StageCamera(camera, pose_to_rotation(-azimuth, elevation, 0), torch.tensor([0, 0, -_DISTANCE_M]))
        for azimuth, elevation in _CAMERAS_DEG
    )


def describe_stage(settings: StageSettings) -> dict[str, Any]:
    """The content of stage.json, without the subjects."""
    flip = np.diag([1.0, -1.0, -1.0])  # to OpenCV's axes
    cameras = []
    for index, shot in enumerate(stage_cameras(settings.size_px)):
        pose = np.column_stack([shot.head_to_camera.double().numpy(), shot.translation_m.double().numpy()])
        focal, centre = shot.camera.focal_px, shot.camera.cx_px
        cameras.append(
            {
                "id": f"C{index}",
                "width": settings.size_px,
                "height": settings.size_px,
                "K": [[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]],
                "world_to_camera": (flip @ pose).tolist(),
            }
        )
    model = subject_model(settings.face_model)
    return {
        "format": STAGE_FORMAT,
        "colour_space": "lin_rec709",
        "black_level": 0.0,
        "axes": "opencv",
        "unit": "m",
        "pattern": "{subject}/{camera}/{light}.exr",
        "lights": [
            {"id": f"L{index:03d}", "direction": direction, "intensity": [1.0, 1.0, 1.0]}
            for index, direction in enumerate(light_directions(settings).tolist())
        ],
        "cameras": cameras,
        "provenance": {
            "software": f"facerf {__version__}",
            "synthetic": True,
            **model.stamp,
            "skin": "procedural (facerf)",
            "settings": asdict(replace(settings, face_model=model.name)),
        },
    }


def open_capture(folder: Path, settings: StageSettings) -> None:
    """Write stage.json, or hold the one that is there to the same settings (UsageError)."""
    path, described = folder / STAGE_FILE, describe_stage(settings)
    if path.exists():
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            found = {}
        if not isinstance(found, dict) or {**found, "subjects": None} != {**described, "subjects": None}:
            raise UsageError(f"{path}: a capture of other settings; give another -o, or remove this one")
        return
    write_document(path, described)


def close_capture(folder: Path, settings: StageSettings) -> None:
    """Put the traits of all finished subjects into stage.json."""
    records = {path.parent.name: path for path in sorted(folder.glob("*/subject.json"))}
    subjects = {
        name: json.loads(path.read_text(encoding="utf-8"))["traits"] for name, path in records.items()
    }
    write_document(folder / STAGE_FILE, describe_stage(settings) | {"subjects": subjects})


def draw_subject(model: MorphableModel, index: int, seed: int, size_px: int) -> Subject:
    """Person number `index`: a function of (model, seed, index); `size_px` only sets how fine the mesh is."""
    random = np.random.default_rng([seed, index])
    generator = torch.Generator().manual_seed(int(random.integers(1 << 62)))
    alpha, beta = draw_coefficients(model, random, GeometrySettings())
    closed = random.random() < _CLOSED_SHARE
    if closed:
        beta = _eyes_closed(model, beta)
    gaze = random.normal(0, _GAZE_STD_DEG, 2)
    pose_deg = random.normal(0, _POSE_STD_DEG)
    side = _canvas_side(size_px)
    appearance = draw_appearance(side, generator)
    bare = build_head(model, alpha, beta, (float(gaze[0]), float(gaze[1])), _subdivisions(size_px))
    chart_vertices = model.vertices(alpha[None], beta[None])[0]
    landmarks_m = model.landmarks(chart_vertices[None])[0].numpy()
    dressed = joined(bare, draw_clothes(bare, random))
    hair, style = draw_hair(dressed, random)
    cover = torch.from_numpy(scalp_cover(canvas_uv(side).numpy(), style))
    appearance = with_scalp(appearance, cover, generator)
    glasses = random.random() < _GLASSES_SHARE
    worn = [draw_glasses(bare, landmarks_m, random)] if glasses else []
    head_to_world = pose_to_rotation(*(float(angle) for angle in pose_deg))
    mesh = _turned(joined(dressed, *([hair] if hair else []), *worn), head_to_world.numpy())
    landmarks_world = landmarks_m @ head_to_world.numpy().T
    traits = appearance.traits | {
        "hair": style.name,
        "glasses": glasses,
        "eyes_closed": closed,
        "pose_deg": pose_deg.round(3).tolist(),
        "gaze_deg": gaze.round(3).tolist(),
    }
    return Subject(mesh, appearance, head_to_world, chart_vertices, landmarks_world, traits)


def _canvas_side(size_px: int) -> int:
    return 512 if size_px <= 256 else 1024


def _subdivisions(size_px: int) -> int:
    """How often the head's mesh is halved, for vertices about as fine as pixels."""
    return 0 if size_px <= 96 else 1 if size_px <= 384 else 2


def _eyes_closed(model: MorphableModel, beta: Tensor) -> Tensor:
    lids = torch.tensor([name.startswith(("eyeBlink", "eye_close")) for name in model.expression_names])
    others = torch.tensor([name.startswith(("eye", "cheekSquint")) for name in model.expression_names])
    return torch.where(lids, 1 / EXPRESSION_STD, beta * ~others)


def _turned(mesh: HeadMesh, rotation: np.ndarray) -> HeadMesh:
    fields = {name: getattr(mesh, name) @ rotation.T for name in ("vertices", "normals", "tangents")}
    return replace(mesh, **fields)


def photograph_subject(
    subject: Subject, settings: StageSettings
) -> tuple[Iterator[Tensor], MeshTransport | None]:
    """Every camera's pictures [L, 3, H, W], linear, one camera at a time; and the bake, if there is one."""
    directions, cameras = light_directions(settings), stage_cameras(settings.size_px)
    mesh, appearance = subject.mesh, subject.appearance
    if settings.renderer == "mitsuba":
        shots = (path_tracer.photograph(mesh, appearance, directions, camera)[0] for camera in cameras)
        return shots, None
    transport = bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        directions,
        _BAKE,
        settings.seed,
        wanted=_seen(mesh, cameras),
        all_round=mesh.part == PARTS.index("hair"),
    )
    irradiance = bake_renderer.scattered_irradiance(mesh, appearance, transport)
    shots = (
        bake_renderer.photograph(mesh, appearance, transport, camera, irradiance=irradiance)[0]
        for camera in cameras
    )
    return shots, transport


def _seen(mesh: HeadMesh, cameras: tuple[StageCamera, ...]) -> np.ndarray:
    """Vertices [V] that turn toward some camera, or nearly."""
    seen = np.zeros(len(mesh.vertices), bool)
    for camera in cameras:
        rotation, translation = camera.head_to_camera.numpy(), camera.translation_m.numpy()
        seen |= (mesh.normals * (-translation @ rotation - mesh.vertices)).sum(-1) > -0.2 * _DISTANCE_M
    return seen


def write_subject(
    folder: Path, subject: Subject, settings: StageSettings, transport_path: Path | None
) -> None:
    """Write `folder`/CAMERA/LIGHT.exr and subject.json, whole or not at all; the bake to `transport_path`."""
    model = subject_model(settings.face_model)
    metadata = Provenance(**model.stamp, source_type=COMPUTER_GRAPHICS_SOURCE_TYPE).attributes()
    shots, transport = photograph_subject(subject, settings)
    with atomic_path(folder) as unfinished:
        for camera, images in enumerate(shots):
            for light, image in enumerate(images.permute(0, 2, 3, 1).numpy()):
                write_exr(unfinished / f"C{camera}" / f"L{light:03d}.exr", image, metadata=metadata)
        if transport_path and transport:
            _save_transport(transport_path, subject, transport, settings)
        record = {"traits": subject.traits, "landmarks_world": subject.landmarks_world.tolist()}
        write_document(unfinished / "subject.json", record)


def _save_transport(path: Path, subject: Subject, transport: MeshTransport, settings: StageSettings) -> None:
    """The bake in the chart, head frame, in the form of `stage.geometries.bake_head`."""
    skin = np.flatnonzero(subject.mesh.part == PARTS.index("skin"))
    texels = bake_attributes(subject.chart_vertices, GRID, _TRANSPORT_SIDE).permute(1, 2, 0).reshape(-1, 3)
    rotation = subject.head_to_world.numpy()
    distances, near = cKDTree(subject.mesh.vertices[skin]).query(texels.numpy() @ rotation.T, 3)
    weights = 1 / (distances + 1e-5)
    weights /= weights.sum(-1, keepdims=True)
    cosines = np.clip(transport.directions @ subject.mesh.normals.T, 0, None)
    direct = (transport.visibility * cosines)[:, transport.sites].T
    bounce = transport.gathered(direct)[transport.site_of].T * transport.baked

    def in_chart(baked: np.ndarray) -> Tensor:
        field = np.einsum("lnk,nk->ln", baked[:, skin[near]], weights)
        shape = (len(field), _TRANSPORT_SIDE, _TRANSPORT_SIDE)
        values = (np.clip(field, 0, 1) * 255).round().astype(np.uint8)
        return torch.from_numpy(np.ascontiguousarray(values.reshape(shape)))

    tensors = {
        "vertices": subject.chart_vertices.contiguous(),
        "directions": torch.from_numpy(transport.directions @ rotation).float(),
        "visibility": in_chart(transport.visibility),
        "bounce": in_chart(np.sqrt(bounce)),
    }
    with atomic_path(path) as temporary:
        # One entry: safetensors writes several in an order that changes from run to run.
        save_file(tensors, temporary, metadata={"face_model": subject_model(settings.face_model).credit})
