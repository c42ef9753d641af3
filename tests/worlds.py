"""Toy captures of a light stage: flat images, an egg, and built-in heads under Lambert's law.

`write_stage` writes all of them; `write_faceolat` rewrites one in FaceOLAT's layout.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from facerf_cli.capture.layouts import read_capture
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.files.write import write_exr
from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture, vertex_normals
from facerf_cli.synth.appearance.skin import draw_skin

FRAMES = "{subject}/{camera}/{light}.exr"
# From world to camera, upright: OpenCV's y is down and its z looks toward the origin (world -z).
UPRIGHT = np.diag([1.0, -1.0, -1.0])


def write_stage(
    folder: Path,
    stage: dict[str, Any],
    subjects: Iterable[str],
    image_of: Callable[[str, str, str], np.ndarray],
) -> None:
    """Write stage.json and the frames [H, W, 3] that image_of(subject, camera, light) gives."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "stage.json").write_text(json.dumps(stage))
    for subject in subjects:
        for camera in stage["cameras"]:
            for light in stage["lights"]:
                path = folder / subject / camera["id"] / f"{light['id']}.exr"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_exr(path, image_of(subject, camera["id"], light["id"]).astype(np.float32))


def stage_of(
    lights: list[dict[str, Any]], cameras: list[dict[str, Any]], black_level: float
) -> dict[str, Any]:
    """The content of stage.json."""
    return {
        "format": "facerf-stage-1",
        "colour_space": "lin_rec709",
        "black_level": black_level,
        "axes": "opencv",
        "unit": "m",
        "pattern": FRAMES,
        "lights": lights,
        "cameras": cameras,
    }


def light_of(name: str, direction: Any, intensity: Any = (1, 1, 1)) -> dict[str, Any]:
    return {"id": name, "direction": list(direction), "intensity": list(intensity)}


def camera_of(
    name: str,
    width: int,
    height: int,
    focal_px: float,
    centre_px: tuple[float, float] | None = None,
    pose: Any = None,
) -> dict[str, Any]:
    """A camera whose principal point is the image's middle, upright and 1.2 m in front of the origin."""
    x, y = centre_px or (width / 2, height / 2)
    return {
        "id": name,
        "width": width,
        "height": height,
        "K": [[focal_px, 0, x], [0, focal_px, y], [0, 0, 1]],
        "world_to_camera": (np.c_[UPRIGHT, [0, 0, 1.2]] if pose is None else np.asarray(pose)).tolist(),
    }


# Flat images: one subject, 0000, one camera and two lights.
FLAT = stage_of(
    [light_of("L0", (0, 0, 1), (1, 2, 4)), light_of("L1", (0.6, 0, 0.8))],
    [camera_of("C0", 64, 60, 500.0, (33, 30), np.c_[UPRIGHT, [0, 0, 2]])],
    black_level=0.25,
)


def write_flat_stage(folder: Path, pixels: np.ndarray | None = None, **changes: Any) -> Path:
    """Write the flat stage with `changes` of its description, whose frames are in the folder 0000/C0."""
    write_stage(folder, FLAT, ["0000"], lambda *_: np.full((60, 64, 3), 2.25) if pixels is None else pixels)
    (folder / "stage.json").write_text(json.dumps(FLAT | changes))
    return folder


# An egg, matt and mottled, with lights in front of it.
EGG_HEIGHT, EGG_WIDTH = 120, 96
EGG, EGG_CAMERA = "egg", "C0"
EGG_LIGHTS = [f"L{index:03d}" for index in range(40)]


def egg_directions() -> np.ndarray:
    """Unit [L, 3], z toward the camera: a spiral over the front half and a little behind."""
    z = np.linspace(0.98, -0.25, len(EGG_LIGHTS))
    angle = np.arange(len(EGG_LIGHTS)) * 2.399963
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)


def egg_normals() -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [H, W, 3] of a bumpy egg, and where it is [H, W]."""
    y, x = np.mgrid[:EGG_HEIGHT, :EGG_WIDTH]
    x, y = (x + 0.5 - EGG_WIDTH / 2) / (0.45 * EGG_WIDTH), -(y + 0.5 - EGG_HEIGHT / 2) / (0.45 * EGG_HEIGHT)
    inside = x**2 + y**2 < 0.9
    bumps = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(EGG_HEIGHT, EGG_WIDTH)), 5) * 6
    down, right = np.gradient(bumps)
    field = np.stack([x - right, y + down, np.sqrt(np.clip(1 - x**2 - y**2, 0.05, 1))], -1)
    return field / np.linalg.norm(field, axis=-1, keepdims=True), inside


def egg_images(directions: np.ndarray) -> np.ndarray:
    """The egg [L, H, W] under lights from directions [L, 3], with a little noise of its own in each."""
    generator = np.random.default_rng(6)
    field, inside = egg_normals()
    albedo = 0.5 + ndimage.gaussian_filter(generator.normal(size=(EGG_HEIGHT, EGG_WIDTH)), 2) * 0.8
    lit = np.maximum(np.einsum("hwc,lc->lhw", field, directions), 0) * albedo * inside
    return (lit + generator.normal(size=lit.shape) * 5e-4).astype(np.float32)


def egg_lights(directions: np.ndarray) -> list[dict[str, Any]]:
    return [light_of(name, direction) for name, direction in zip(EGG_LIGHTS, directions, strict=True)]


def egg_camera(name: str, width: int = EGG_WIDTH) -> dict[str, Any]:
    return camera_of(name, width, EGG_HEIGHT, 400)


def write_egg_stage(folder: Path, frames: np.ndarray | None = None, **changes: Any) -> Path:
    """Write the egg's frames [L, H, W] by one camera, and a stage.json with `changes`."""
    directions = egg_directions()
    frames = egg_images(directions) if frames is None else frames
    by_light = dict(zip(EGG_LIGHTS, frames, strict=True))
    stage = stage_of(egg_lights(directions), [egg_camera(EGG_CAMERA)], 0.0) | {"subjects": {EGG: {}}}
    write_stage(folder, stage, [EGG], lambda *names: grey(by_light[names[-1]]))
    (folder / "stage.json").write_text(json.dumps(stage | changes))
    return folder


def grey(frame: np.ndarray) -> np.ndarray:
    """An image [H, W] with three equal channels."""
    return np.repeat(frame[..., None], 3, -1).astype(np.float32)


# Built-in heads with painted skins, by Lambert's law, three cameras.
SIDE_PX, SUPER = 160, 2
YAWS_DEG = (-24.0, 4.0, 40.0)  # the last is too far round for the detector
FOCAL_PX, DISTANCE_M = 3.6 * SIDE_PX * 1.1, 1.1
WORLD_FROM_HEAD = pose_to_rotation(20.0, 3.0, -2.0).double()  # how the subjects sit in the stage
HEAD_WORLD = torch.tensor([0.01, 1.3, 0.02], dtype=torch.float64)
BLACK_LEVEL = 0.01


@dataclass(frozen=True, eq=False)
class Truth:
    """Who was photographed: the vertices in the world [V, 3] float64, and the skin's albedo."""

    vertices_world: Tensor
    albedo: Tensor  # [3, T, T]


def write_capture(
    folder: Path, subjects: int = 2, lights: int = 12, seed: int = 3, **changes: Any
) -> dict[str, Truth]:
    """Write a capture whose stage.json has `changes`; give the truth by subject."""
    directions = rig_directions(lights).double()
    intensities = 1 + 0.5 * torch.rand(lights, 3, generator=torch.Generator().manual_seed(seed))
    turns = {
        f"C{at}": pose_to_rotation(yaw, 0, 0).double() @ WORLD_FROM_HEAD.mT for at, yaw in enumerate(YAWS_DEG)
    }
    rows = zip(directions.tolist(), intensities.tolist(), strict=True)
    stage = stage_of(
        [light_of(f"L{number:03d}", *row) for number, row in enumerate(rows)],
        [_camera_of_head(name, turn) for name, turn in turns.items()],
        BLACK_LEVEL,
    )
    truths = {f"{index:04d}": _someone(index, seed) for index in range(subjects)}
    olats = {
        (subject, camera): photograph(truth, turn, directions) * intensities[:, None, None].numpy()
        + BLACK_LEVEL
        for subject, truth in truths.items()
        for camera, turn in turns.items()
    }
    write_stage(folder, stage, truths, lambda subject, camera, light: olats[subject, camera][int(light[1:])])
    (folder / "stage.json").write_text(json.dumps(stage | {"provenance": {"made_by": "a test"}} | changes))
    return truths


def photograph(truth: Truth, turn: Tensor, directions: Tensor) -> np.ndarray:
    """Images [L, H, W, 3] by the camera that sees the world turned by [3, 3]."""
    vertices = (truth.vertices_world @ turn.mT + _shift(turn)).float()
    middle = (SUPER * (SIDE_PX / 2 + 2), SUPER * (SIDE_PX / 2 - 1))
    camera = Camera(FOCAL_PX * SUPER, SIDE_PX * SUPER, SIDE_PX * SUPER, *middle)
    triangles = grid_triangles()
    fragments = rasterize(vertices, triangles, camera)
    attributes = torch.cat([grid_uv(), vertex_normals(vertices, triangles)], 1)
    uv, normals = interpolate(attributes, triangles, fragments).split([2, 3], -1)
    skin = sample_texture(truth.albedo, uv).permute(2, 0, 1) * fragments.covered
    in_camera = (directions @ turn.mT).float()
    cosine = torch.einsum("lc,hwc->lhw", in_camera, torch.nn.functional.normalize(normals, dim=-1))
    images = skin * cosine.clamp(min=0)[:, None]
    return torch.nn.functional.avg_pool2d(images, SUPER).permute(0, 2, 3, 1).numpy()


def _camera_of_head(name: str, turn: Tensor) -> dict[str, Any]:
    pose = UPRIGHT @ torch.cat([turn, _shift(turn)[:, None]], 1).numpy()
    return camera_of(name, SIDE_PX, SIDE_PX, FOCAL_PX, (SIDE_PX / 2 + 2, SIDE_PX / 2 - 1), pose)


def _shift(turn: Tensor) -> Tensor:
    return torch.tensor([0.0, -0.01, -DISTANCE_M], dtype=torch.float64) - turn @ HEAD_WORLD


def _someone(index: int, seed: int) -> Truth:
    model = load_face_model()
    generator = torch.Generator().manual_seed(100 * seed + index)
    alpha = 0.6 * torch.randn(1, len(model.identity), generator=generator)
    head = model.vertices(alpha, torch.zeros(1, len(model.expression)))[0].double()
    albedo = draw_skin(1, 256, generator).albedo[0]
    return Truth(head @ WORLD_FROM_HEAD.mT + HEAD_WORLD, albedo)


# FaceOLAT's layout.
SHIFT_MM = np.array([640.0, 400.0, 500.0])  # of the stage's axes, in which the head is where FaceOLAT's is
COLOURS = np.array([[1.2, -0.1, 0.0], [0.1, 0.8, -0.05], [0.0, 0.2, 1.5]])
BLACK = np.array([0.01, 0.02, 0.03])
# A calibration of one camera, by Metashape.
LENS = """<document><chunk><sensors><sensor id="0"><calibration class="adjusted">
<resolution width="200" height="100"/><f>180</f><cx>3</cx><cy>-2</cy><b1>0.5</b1><k1>-0.1</k1><k2>0.02</k2>
<k3>0.003</k3><p1>0.004</p1><p2>-0.005</p2></calibration></sensor></sensors><cameras>
<camera sensor_id="0" label="A"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras>
</chunk></document>"""
_TURN = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])  # of Metashape's chunk
_SCALE, _TRACKING_EVERY = 250.0, 5


def write_faceolat(stage: Path, folder: Path, radius_m: float, dark: str = "") -> dict[str, str]:
    """Rewrite a stage as EXR files of FaceOLAT, its lights at a distance from the head; takes by subject."""
    capture = read_capture(stage)
    takes = {name: f"ID10{number:03d}" for number, name in enumerate(capture.subjects, 1)}
    takes |= {dark: "ID20090"} if dark else {}
    middle_mm = 1000 * HEAD_WORLD.numpy() + SHIFT_MM
    places = middle_mm + 1000 * radius_m * capture.directions_world
    order, pairs = np.random.default_rng(1).permutation(len(places)), []
    for light in order:
        if len(pairs) % _TRACKING_EVERY == 0:
            pairs.append([len(pairs), 0])
        pairs.append([len(pairs), int(light) + 1])
    _write_json(folder / "lights/light_pattern_per_frame.json", pairs)
    _write_json(
        folder / "lights/light_pattern_metadata.json", {"light_positions": places.tolist(), "fps": 60}
    )
    (folder / "colorcalib.mat").write_text(
        "\n".join(" ".join(map(str, row)) for row in np.c_[COLOURS, BLACK])
    )
    (folder / "calibration/cameras").mkdir(parents=True)
    sensors, cameras = "", ""
    for number, (name, posed) in enumerate(capture.cameras.items()):
        label = f"Cam{number:02d}"
        flip = np.diag([1.0, -1.0, -1.0])
        rotation, shift_mm = flip @ posed.rotation.numpy(), 1000 * flip @ posed.translation_m.numpy()
        centre = _TURN.T @ (-rotation.T @ shift_mm + SHIFT_MM) / _SCALE
        to_chunk = np.eye(4)
        to_chunk[:3] = np.c_[_TURN.T @ rotation.T, centre]
        width, height = posed.width_px, posed.height_px
        size = f'<resolution width="{width}" height="{height}"/>'
        sensors += (
            f'<sensor id="{number}" label="{label}" type="frame">{size}'
            f'<calibration type="frame" class="adjusted">{size}'
            f"<f>{posed.focal_px[1]}</f><cx>{posed.centre_px[0] - width / 2}</cx>"
            f"<cy>{posed.centre_px[1] - height / 2}</cy></calibration></sensor>"
        )
        values = " ".join(map(str, to_chunk.ravel()))
        cameras += f'<camera id="{number}" sensor_id="{number}" label="{label}">'
        cameras += f"<transform>{values}</transform></camera>"
        for subject, take in takes.items():
            place = folder / label / take
            place.mkdir(parents=True)
            for frame, light in pairs:
                image = capture.frame(subject, name, light - 1) if light else np.ones((height, width, 3))
                stored = image @ np.linalg.inv(COLOURS).T * (0.5 if subject == dark else 1) + BLACK
                write_exr(place / f"{take}.{frame + 1:06d}.exr", stored.astype(np.float32))
    cameras += '<camera id="99" sensor_id="0" label="not aligned"/>'
    rotation = " ".join(map(str, _TURN.ravel()))
    transform = f"<rotation>{rotation}</rotation><scale>{_SCALE}</scale>"
    (folder / "calibration/cameras/001.xml").write_text(
        f'<?xml version="1.0"?><document version="1.2.0"><chunk label="one"><sensors>{sensors}</sensors>'
        f"<cameras>{cameras}</cameras><transform>{transform}</transform></chunk></document>"
    )
    return takes


def _write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
