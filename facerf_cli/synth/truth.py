"""True layers of a photo of a synthetic person: matte, classes, surface and material.

Further landmarks than the 68 of `face.topology` have names: centres and outlines of the irises, and ears.
"""

from dataclasses import dataclass

import numpy as np
import torch

from facerf_cli.portrait.classes import CLASSES, IRIS_POINTS, class_index
from facerf_cli.synth.appearance.eye_textures import IRIS_DEG
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.facets import Samples, surface_samples
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, unit
from facerf_cli.synth.stage_cameras import StageCamera

_SAMPLES = 3  # along each side of a pixel
_NEAR = 4  # vertices of the eyeball around a point of the iris


@dataclass(frozen=True, eq=False)
class Truth:
    """Layers [H, W] or [H, W, C] float32 of an image; surface and material are means over what is covered.

    classes [H, W, len(CLASSES)]: share of each class in a pixel, with the background their sum is 1; albedo:
    linear Rec.709; normals: unit, camera space; positions_m: camera space; specular: reflectance at normal
    incidence; roughness: of the highlight.
    """

    classes: np.ndarray
    albedo: np.ndarray
    normals: np.ndarray
    positions_m: np.ndarray
    specular: np.ndarray
    roughness: np.ndarray

    @property
    def alpha(self) -> np.ndarray:
        """Share [H, W] of each pixel that shows the person."""
        return np.asarray(1 - self.classes[..., class_index("background")])

    def layers(self) -> dict[str, np.ndarray]:
        """The layers by the names that they have in an EXR file."""
        classes = {f"class.{name}": self.classes[..., index] for index, name in enumerate(CLASSES)}
        return {
            "person.A": self.alpha,
            **classes,
            "albedo": self.albedo,
            "normal": self.normals,
            "position": self.positions_m,
            "depth.Z": -self.positions_m[..., 2],
            "specular.Y": self.specular,
            "roughness.Y": self.roughness,
        }


def truth_of(mesh: HeadMesh, appearance: Appearance, camera: StageCamera) -> Truth:
    """Compute the layers of the image that a camera takes of a person."""
    samples = surface_samples(mesh, camera, _SAMPLES)
    height, width = camera.camera.height_px, camera.camera.width_px
    part = torch.from_numpy(mesh.part[samples.corners[:, 0]])
    material = sample(appearance, part, samples.interpolate(mesh.uv))
    rotation, shift = camera.head_to_camera.numpy(), camera.translation_m.numpy()
    surface = np.concatenate(
        [
            material.albedo.numpy(),
            unit(samples.interpolate(mesh.normals).numpy()) @ rotation.T,
            samples.interpolate(mesh.vertices).numpy() @ rotation.T + shift,
            material.specular.numpy()[:, None],
            material.roughness.numpy()[:, None],
        ],
        1,
    )
    count = np.bincount(samples.pixel, minlength=height * width)
    totals = [np.bincount(samples.pixel, column, height * width) for column in surface.T]
    means = (np.stack(totals, -1) / np.maximum(count, 1)[:, None]).reshape(height, width, -1)
    albedo, normals, positions, gloss = np.split(means.astype(np.float32), [3, 6, 9], -1)
    classes = _class_shares(mesh, samples, height * width).reshape(height, width, -1)
    return Truth(classes, albedo, unit(normals), positions, gloss[..., 0], gloss[..., 1])


def _class_shares(mesh: HeadMesh, samples: Samples, pixels: int) -> np.ndarray:
    """Share [N, len(CLASSES)] of each class in each pixel, by the nearest vertex of every sample."""
    nearest = samples.corners[np.arange(len(samples.pixel)), samples.weights.argmax(1)]
    key = samples.pixel * len(CLASSES) + mesh.label[nearest]
    shares = np.bincount(key, minlength=pixels * len(CLASSES)).reshape(pixels, -1) / samples.per_pixel
    shares[:, class_index("background")] = 1 - shares.sum(1)
    return shares.astype(np.float32)


def more_landmarks(mesh: HeadMesh) -> dict[str, np.ndarray]:
    """Places [3] by name on irises and ears of a mesh in the head frame; left and right are the image's."""
    points: dict[str, np.ndarray] = {}
    sides = {"left": -1, "right": 1}
    for side, sign in sides.items():
        points |= {f"{side} {name}": place for name, place in _iris(mesh, sign).items()}
        ear = mesh.vertices[(mesh.label == class_index("ears")) & (mesh.vertices[:, 0] * sign > 0)]
        if len(ear):
            ends = {"top": ear[:, 1].argmax(), "lobe": ear[:, 1].argmin(), "back": ear[:, 2].argmin()}
            points |= {f"{side} ear {name}": ear[index] for name, index in ends.items()}
    return points


def _iris(mesh: HeadMesh, sign: int) -> dict[str, np.ndarray]:
    """Centre and outline of the iris on one side: means of the nearest vertices by the eyeball's texture."""
    ball = np.flatnonzero((mesh.part == PARTS.index("eye")) & (mesh.vertices[:, 0] * sign > 0))
    turn = np.arange(IRIS_POINTS) / IRIS_POINTS * 2 * np.pi
    ring = 0.5 + IRIS_DEG / 180 * np.stack([np.cos(turn), -np.sin(turn)], -1)
    found = {}
    for name, uv in {"iris": np.array([0.5, 0.5]), **{f"iris {k}": at for k, at in enumerate(ring)}}.items():
        distance = np.linalg.norm(mesh.uv[ball] - uv, axis=-1)
        near = distance.argsort()[:_NEAR]
        weights = 1 / (distance[near] + 1e-4)
        found[name] = (mesh.vertices[ball[near]] * (weights / weights.sum())[:, None]).sum(0)
    return found
