"""A synthetic head that talks and turns under a fixed light, its truth under another, and its motion."""

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.camera import pose_to_rotation, project
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.person import SyntheticPerson, draw_person
from facerf_cli.synth.renderer import bake_light, images_under, view_of
from facerf_cli.synth.views import StageCamera, stage_cameras, surface_samples

_NEAR = 4  # vertices of the face that carry a vertex of the mesh
_REACH_M = 0.012  # from the face, at which the mesh follows it by 1 / e


@dataclass(frozen=True, eq=False)
class Actor:
    """A subject and the face model that moves it; expressions are added to the subject's own."""

    subject: SyntheticPerson
    model: MorphableModel

    def with_expression(self, strengths: dict[str, float]) -> SyntheticPerson:
        """Move the face by expression shapes, by name, in standard deviations; hair and clothes stay."""
        beta = torch.tensor([strengths.get(name, 0.0) for name in self.model.expression_names])
        moved_m = torch.einsum("k,kvc->vc", beta, self.model.expression)
        near, weights = self._carriers
        offset = (weights[..., None] * moved_m.numpy()[near]).sum(1) @ self.subject.head_to_world.numpy().T
        mesh = self.subject.mesh
        vertices = (mesh.vertices + offset).astype(np.float32)
        before, after = (
            vertex_normals(torch.from_numpy(v), torch.from_numpy(mesh.triangles)).numpy()
            for v in (mesh.vertices, vertices)
        )
        normals = mesh.normals + after - before  # those of the mesh are smooth across its seams
        normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(min=1e-6)
        moved = replace(mesh, vertices=vertices, normals=normals.astype(np.float32))
        return replace(self.subject, mesh=moved, face_vertices=self.subject.face_vertices + moved_m)

    @cached_property
    def _carriers(self) -> tuple[np.ndarray, np.ndarray]:
        """Ids [N, 4] of vertices of the face, and weights [N, 4] by which the mesh's vertices follow them."""
        head = self.subject.mesh.vertices @ self.subject.head_to_world.numpy()
        distances, near = cKDTree(self.subject.face_vertices.numpy()).query(head, _NEAR)
        weights = 1 / (distances + 1e-4)
        weights /= weights.sum(1, keepdims=True)
        return near, weights * np.exp(-((distances.min(1) / _REACH_M) ** 2))[:, None]


def turned(camera: StageCamera, yaw_deg: float, pitch_deg: float) -> StageCamera:
    """The camera that sees a person turn by so much; its lights turn with it (`seen_from`)."""
    turn = pose_to_rotation(yaw_deg, pitch_deg, 0.0).to(camera.head_to_camera.dtype)
    return replace(camera, head_to_camera=turn @ camera.head_to_camera)


def seen_from(directions_camera: Tensor, camera: StageCamera) -> np.ndarray:
    """World-space directions [L, 3], float64, of lights that are fixed to a camera."""
    return (directions_camera.double() @ camera.head_to_camera.double()).numpy()


SEED, RATE, LIGHTS = 101, 24, 48
BAKE = BakeSettings(light_samples=6, bounce_samples=8)  # with fewer, the truth itself flickers
NOISE = 0.006  # standard deviation of the source's noise, display values: 1.5 of 255
MEAN = 0.18  # radiance of the source's person
NEAR_M = 0.004  # between places on the person that are taken as one: about a pixel


@dataclass(frozen=True)
class Clip:
    """Frames [N, H, W, 3] of the source, display values without noise, and of the truth; alpha [N, H, W].

    place [N, H, W, 3]: the place on the person at rest that a pixel shows, m; to_previous, to_middle and
    from_middle [N, H, W, 2]: how far it is, in pixels x and y, to the same place in the frame before, in the
    frame of the middle, and from there. NaN off the person.
    """

    source: np.ndarray
    truth: np.ndarray
    alpha: np.ndarray
    place: np.ndarray
    to_previous: np.ndarray
    to_middle: np.ndarray
    from_middle: np.ndarray

    @property
    def middle(self) -> int:
        """The frame to which the motion refers."""
        return len(self.alpha) // 2

    def to_frame_before(self, values: np.ndarray) -> np.ndarray:
        """Values [N, H, W, C] of the frame before each, where it shows the same place; else NaN."""
        before = [max(0, frame - 1) for frame in range(len(values))]
        return np.stack(
            [self._carried(values, before[n], n, self.to_previous[n]) for n in range(len(values))]
        )

    def in_middle(self, values: np.ndarray) -> np.ndarray:
        """Values [N, H, W, C] of all frames, at the places that the middle frame shows; else NaN."""
        return np.stack(
            [self._carried(values, n, self.middle, self.from_middle[n]) for n in range(len(values))]
        )

    def from_the_middle(self, values: np.ndarray) -> np.ndarray:
        """Values [H, W, C] of the middle frame, at the places that each frame shows; else NaN."""
        repeated = np.broadcast_to(values, (len(self.alpha), *values.shape))
        return np.stack(
            [self._carried(repeated, self.middle, n, self.to_middle[n]) for n in range(len(self.alpha))]
        )

    def _carried(self, values: np.ndarray, source: int, target: int, flow_px: np.ndarray) -> np.ndarray:
        """Values of frame `source` at the pixels of `target`, which lie there by a flow [H, W, 2]."""
        place = sampled(self.place[source], flow_px)
        with np.errstate(invalid="ignore"):
            same = np.linalg.norm(place - self.place[target], axis=-1) < NEAR_M
        return np.where(same[..., None], sampled(values[source], flow_px), np.nan)


def sampled(values: np.ndarray, flow_px: np.ndarray) -> np.ndarray:
    """Values [H, W, C] at each pixel's place by a flow [H, W, 2] in pixels x and y, bilinearly."""
    height, width = flow_px.shape[:2]
    at = np.mgrid[:height, :width] + np.nan_to_num(flow_px[..., ::-1], nan=1e6).transpose(2, 0, 1)
    layers = [map_coordinates(values[..., c], at, order=1, cval=np.nan) for c in range(values.shape[-1])]
    return np.stack(layers, -1)


def lamps(*lit: tuple[float, float, float, tuple[float, float, float]], fill: float) -> torch.Tensor:
    """Weights [L, 3] of soft lamps (azimuth, elevation, sharpness, rgb) over an even light."""
    weights = torch.full((LIGHTS, 3), fill / LIGHTS)
    for azimuth_deg, elevation_deg, sharpness, rgb in lit:
        toward = azel_to_direction(azimuth_deg, elevation_deg)
        share = (sharpness * (rig_directions(LIGHTS) @ toward)).softmax(0)
        weights = weights + share[:, None] * torch.tensor(rgb)
    return weights


SOURCE = lamps((-50, 25, 8, (1.0, 0.95, 0.88)), fill=0.8)
TARGET = lamps((70, 20, 12, (1.0, 0.8, 0.6)), (-110, 30, 12, (0.2, 0.35, 0.6)), fill=0.25)


def expression(time_s: float) -> dict[str, float]:
    """A talking face: jaw, lips, smile and brows."""

    def wave(hertz: float, phase: float = 0.0) -> float:
        return math.sin(2 * math.pi * hertz * time_s + phase)

    smile, brows = wave(0.5) ** 2, 1.2 * wave(0.7) ** 2
    return {
        "jaw_open": 0.8 * max(0.0, wave(2.0)),
        "pucker": max(0.0, wave(1.3, 1.0)),
        **dict.fromkeys(("smile_left", "smile_right"), smile),
        **dict.fromkeys(("brow_up_left", "brow_up_right"), brows),
    }


@dataclass(frozen=True, eq=False)
class Posed:
    """A person in one frame, as its camera sees them."""

    subject: SyntheticPerson
    camera: StageCamera

    def shows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels [P] that show the mesh, and for each the corners [P, 3] and weights of one point of it."""
        samples = surface_samples(self.subject.mesh, self.camera, 1)
        return samples.pixel, samples.corners, samples.weights

    def places_px(self, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Pixels [P, 2] of points of the mesh."""
        points = torch.from_numpy(_points(self.subject, corners, weights)).float()
        in_camera = points @ self.camera.head_to_camera.T.float() + self.camera.translation_m
        return project(in_camera, self.camera.camera).numpy()


def _points(subject: SyntheticPerson, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("pk,pkc->pc", weights, subject.mesh.vertices[corners]))


def posed(actor: Actor, frame: int, size_px: int) -> Posed:
    """The person of a frame."""
    turn = 2 * math.pi * frame / RATE
    camera = turned(stage_cameras(size_px, "bust")[0], 8 * math.sin(0.35 * turn), 3 * math.sin(0.45 * turn))
    return Posed(actor.with_expression(expression(frame / RATE)), camera)


def motion_of(frames: list[Posed], rest: SyntheticPerson) -> dict[str, np.ndarray]:
    """Place and flows of a clip, by their names in `Clip`."""
    size = frames[0].camera.camera.width_px
    middle, found = frames[len(frames) // 2], {}
    seen = [frame.shows() for frame in frames]
    names = ("place", "to_previous", "to_middle", "from_middle")
    found = {name: np.full((len(frames), size, size, 3 if name == "place" else 2), np.nan) for name in names}

    def flow(name: str, frame: int, own: int, source: Posed, target: Posed) -> None:
        pixel, *surface = seen[own]
        moved = target.places_px(*surface) - source.places_px(*surface)
        found[name][frame].reshape(-1, 2)[pixel] = moved

    for n, frame in enumerate(frames):
        pixel, *surface = seen[n]
        found["place"][n].reshape(-1, 3)[pixel] = _points(rest, *surface)
        flow("to_previous", n, n, frame, frames[max(0, n - 1)])
        flow("to_middle", n, n, frame, middle)
        flow("from_middle", n, len(frames) // 2, middle, frame)
    return found


def draw_clip(person: int, frames: int, size_px: int) -> Clip:
    """Photograph a person who talks and turns; lights are fixed to the camera."""
    model = cached_face_model("builtin")
    actor = Actor(draw_person(model, person, SEED, size_px), model)
    people = [posed(actor, frame, size_px) for frame in range(frames)]
    images, alphas = [], []
    for one in people:
        seen = seen_from(rig_directions(LIGHTS), one.camera)
        baked, surface = view_of(
            one.subject, bake_light(one.subject, [one.camera], seen, BAKE, 0), one.camera
        )
        images.append(images_under(baked, surface, torch.stack([SOURCE, TARGET])).permute(0, 2, 3, 1).numpy())
        alphas.append(baked.alpha.numpy())
    alpha = np.stack(alphas)
    linear = np.array(images)
    linear *= MEAN / ((linear[:, 0].mean(-1) * alpha).sum() / alpha.sum())
    wall = np.linspace(0.05, 0.15, size_px)[:, None, None] * np.ones(3)
    behind = (1 - alpha[..., None]) * wall
    source = np.asarray(linear_to_srgb((linear[:, 0] + behind).clip(0, 1)))
    truth = np.asarray(linear_to_srgb(linear[:, 1].clip(0, 1)))
    return Clip(source, truth, alpha, **motion_of(people, actor.subject))


def still(clip: Clip, frames: int) -> Clip:
    """One frame of a clip, for as long."""
    kept = {field.name: np.repeat(getattr(clip, field.name)[:1], frames, 0) for field in fields(Clip)}
    for name in ("to_previous", "to_middle", "from_middle"):
        kept[name] = np.where(np.isnan(kept["place"][..., :2]), np.nan, 0.0)
    return Clip(**kept)


def recorded(clip: Clip) -> list[np.ndarray]:
    """Scene-linear frames [H, W, 3] with noise, in 8 bits, as a camera writes them."""
    random = np.random.default_rng(SEED)
    noisy = clip.source + random.normal(0, NOISE, clip.source.shape)
    return [np.asarray(srgb_to_linear(x), np.float32) for x in np.round(noisy.clip(0, 1) * 255) / 255]


def kept_clip(path: Path | None, person: int, frames: int, size_px: int) -> Clip:
    """Read a clip from a file; draw it, and write the file, where there is none."""
    if path is not None and path.exists():
        with np.load(path) as file:
            return Clip(**{field.name: file[field.name] for field in fields(Clip)})
    clip = draw_clip(person, frames, size_px)
    if path is not None:
        np.savez(path, **{field.name: getattr(clip, field.name) for field in fields(Clip)})
    return clip
