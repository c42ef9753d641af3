"""A small stage with an egg in it, matt and mottled, lamps in front of it; faults are planted in it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from facerf_cli.files.write import write_exr

HEIGHT, WIDTH, LIGHTS = 120, 96, 40
SUBJECT, CAMERA = "egg", "C0"
IDS = [f"L{index:03d}" for index in range(LIGHTS)]


def directions() -> np.ndarray:
    """Unit [L, 3], z toward the camera: a spiral over the front half and a little behind."""
    z = np.linspace(0.98, -0.25, LIGHTS)
    angle = np.arange(LIGHTS) * 2.399963
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)


def normals() -> tuple[np.ndarray, np.ndarray]:
    """Unit normals [H, W, 3] of a bumpy egg, and where it is [H, W]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (x + 0.5 - WIDTH / 2) / (0.45 * WIDTH), -(y + 0.5 - HEIGHT / 2) / (0.45 * HEIGHT)
    inside = x**2 + y**2 < 0.9
    bumps = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(HEIGHT, WIDTH)), 5) * 6
    down, right = np.gradient(bumps)
    field = np.stack([x - right, y + down, np.sqrt(np.clip(1 - x**2 - y**2, 0.05, 1))], -1)
    return field / np.linalg.norm(field, axis=-1, keepdims=True), inside


def images(lamps: np.ndarray) -> np.ndarray:
    """The egg [L, H, W] under lamps [L, 3], with a little noise of its own in each."""
    generator = np.random.default_rng(6)
    field, inside = normals()
    albedo = 0.5 + ndimage.gaussian_filter(generator.normal(size=(HEIGHT, WIDTH)), 2) * 0.8
    lit = np.maximum(np.einsum("hwc,lc->lhw", field, lamps), 0) * albedo * inside
    return (lit + generator.normal(size=lit.shape) * 5e-4).astype(np.float32)


def write_stage(folder: Path, frames: np.ndarray | None = None, **changes: Any) -> Path:
    """Write the egg's frames [L, H, W] and a stage.json with `changes`."""
    lamps = directions()
    frames = images(lamps) if frames is None else frames
    description = {
        "format": "facerf-stage-1",
        "axes": "opencv",
        "unit": "m",
        "colour_space": "lin_rec709",
        "black_level": 0.0,
        "pattern": "{subject}/{camera}/{light}.exr",
        "lights": lights_of(lamps),
        "cameras": [camera_of(CAMERA)],
        "subjects": {SUBJECT: {}},
    }
    place = folder / SUBJECT / CAMERA
    place.mkdir(parents=True)
    (folder / "stage.json").write_text(json.dumps(description | changes))
    for light, frame in zip(IDS, frames, strict=True):
        write_frame(place / f"{light}.exr", frame)
    return folder


def write_frame(path: Path, frame: np.ndarray) -> None:
    write_exr(path, np.repeat(frame[..., None], 3, -1).astype(np.float32))


def lights_of(lamps: np.ndarray) -> list[dict[str, Any]]:
    return [
        {"id": light, "direction": direction.tolist(), "intensity": [1, 1, 1]}
        for light, direction in zip(IDS, lamps, strict=True)
    ]


def camera_of(name: str, width: int = WIDTH) -> dict[str, Any]:
    return {
        "id": name,
        "width": width,
        "height": HEIGHT,
        "K": [[400, 0, width / 2], [0, 400, HEIGHT / 2], [0, 0, 1]],
        "world_to_camera": [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.2]],
    }
