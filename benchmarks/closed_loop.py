"""Light estimated from a relit photo, next to the known light by which it was relit.

    python benchmarks/closed_loop.py [PHOTO|DIR ...] [--maps ../shared/data/hdri] [--refine]

Lights are envmaps, each at two rotations, and single lights drawn from a seed: a coloured key light and a dim
light in front. The light is estimated from the relit texture, and from an 8-bit PNG of the whole relit photo,
in which the face is detected and fitted again; where another face is found, the case is left out.

- angle: between the brightest directions, in degrees.
- weights: |estimate - truth| / |truth| over the rgb weights of the 150 lights. Brightness of light and of
  skin cannot be told apart, so there is a second figure after the best single scale (scaled).
- SH: the same for the coefficients of spherical harmonics up to order 2, about what a diffuse face shows.

Twin, on the same evidence in the same run: the paper's least squares, whose weights may be negative.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from _common import MAPS, arguments, photos, print_header, print_row
from torch import Tensor

from facerf_cli.evaluation.metrics import light_error_deg
from facerf_cli.face.head import Head
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.light.envmap import rotated_weights
from facerf_cli.light.light import Light
from facerf_cli.light.sh import rig_coefficients
from facerf_cli.light.sphere import RigLight, azel_to_direction, brightest_direction, rig_directions
from facerf_cli.network.features import FeatureNetwork
from facerf_cli.network.files import SHIPPED
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.face_alone import FaceAlone, FaceInPhoto
from facerf_cli.relighting.fitting import fit_photo, reflectance_of
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.photo_light import Estimator, estimate_light
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.training.losses import load_features

TURNS_DEG = (0, 120)  # of each map
SINGLE_LIGHTS, FILL = 6, 0.15  # FILL is the light in front, of a key light of about 1
MEASURES = ("angle", "weights", "weights scaled", "SH", "SH scaled")
RIG = rig_directions()
LIGHT_FEATURES = SHIPPED["light_features"]
_MOVED_PX = 30.0  # from its place in the photo; further off, it is another face
_Estimate = tuple[str, str, Tensor]  # what it was estimated from, by which method, weights [150, 3]


@dataclass(frozen=True, eq=False)
class KnownLight:
    """A named light, weights [150, 3] over the rig."""

    name: str
    weights: Tensor


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--maps", type=Path, default=MAPS, help="folder of envmaps")
    parser.add_argument("--refine", action="store_true", help="refine by the features of S_f")
    parser.add_argument("--seed", type=int, default=0, help="of the single lights")
    parser.add_argument("--lights", type=int, help="use only the first ones")
    given = parser.parse_args()
    torch.set_num_threads(1)
    lights = [*single_lights(given.seed), *map_lights(given.maps)][: given.lights]
    models = load_models()
    features = load_features(LIGHT_FEATURES, "light_features") if given.refine else None
    rows: dict[tuple[str, str], list[dict[str, float]]] = {}
    for photo in photos(given.photos):
        for light, (source, method, weights) in estimates(models, photo, lights, features):
            row = compare(weights, light)
            rows.setdefault((source, method), []).append(row)
            if method != "least squares":
                print(source, photo.stem, light.name, *(f"{row[name]:.3g}" for name in MEASURES), flush=True)
    print("\nmedian / mean / 90th percentile")
    print_header("estimated from", "by", "n", *MEASURES)
    for (source, method), found in sorted(rows.items()):
        print_row(source, method, len(found), *(_spread([row[name] for row in found]) for name in MEASURES))


def map_lights(folder: Path) -> Iterator[KnownLight]:
    """Yield the envmaps of a folder at each rotation."""
    for path in sorted((*folder.glob("*.hdr"), *folder.glob("*.exr"))):
        envmap = torch.from_numpy(read_image(path).pixels)
        for turn_deg, weights in zip(TURNS_DEG, rotated_weights(envmap, RIG, TURNS_DEG), strict=True):
            yield KnownLight(f"{path.stem} {turn_deg} deg", weights)


def single_lights(seed: int) -> Iterator[KnownLight]:
    """Yield key lights of the rig, most of them in front of the face, each with the dim light in front."""
    random = np.random.default_rng(seed)
    front = int((RIG @ azel_to_direction(0.0, 10.0)).argmax())
    for _ in range(SINGLE_LIGHTS):
        azimuth_deg, elevation_deg = random.uniform(-120, 120), random.uniform(-20, 60)
        key = int((RIG @ azel_to_direction(azimuth_deg, elevation_deg)).argmax())
        colour = [round(float(part), 2) for part in (1.0, random.uniform(0.6, 1), random.uniform(0.4, 1))]
        weights = torch.zeros(len(RIG), 3)
        weights[key] += torch.tensor(colour)
        weights[front] += FILL
        yield KnownLight(f"light {azimuth_deg:.0f},{elevation_deg:.0f}", weights)


def estimates(
    models: Models, path: Path, lights: list[KnownLight], features: FeatureNetwork | None
) -> Iterator[tuple[KnownLight, _Estimate]]:
    """Relight a photo by each light and yield what is estimated back, from the texture and from a PNG."""
    photo = read_image(path).pixels
    landmarks_px = find_faces(SHIPPED_NETWORKS.people, photo, str(path))[0].landmarks_px
    head = fit_photo(models, photo, landmarks_px)
    size_px = photo.shape[0], photo.shape[1]
    face = FaceAlone(models.face, head, reflectance_of(models, head), photo_px=size_px)
    people = PeopleInPhoto([FaceInPhoto(face, photo, np.ones(size_px, np.float32))])
    weights = torch.stack([light.weights for light in lights])
    for light, (relit,) in zip(lights, people.relit(Light(RIG, weights)), strict=True):
        face = replace(head.face, texture=relit.texture)
        for method, found in by_both(models, replace(head, face=face), features):
            yield light, ("texture", method, found)
        ev = people.exposure_ev([relit], "auto")
        relit_photo = through_png(people.rendered(RenderRequest([relit], ev=ev))["rgb"] * np.float32(2.0**ev))
        seen_px = find_faces(SHIPPED_NETWORKS.people, relit_photo, light.name)[0].landmarks_px
        if np.linalg.norm(seen_px.mean(0) - landmarks_px.mean(0)) > _MOVED_PX:
            print(f"PNG {path.stem} {light.name}: left out, another face was detected")
            continue
        for method, found in by_both(models, fit_photo(models, relit_photo, seen_px), features):
            yield light, ("PNG", method, found / 2**ev)


def through_png(image: np.ndarray) -> np.ndarray:
    """Write an image [H, W, 3] as an 8-bit PNG and read it."""
    with tempfile.TemporaryDirectory() as folder:
        write_display(Path(folder, "relit.png"), image)
        return read_image(Path(folder, "relit.png")).pixels


def by_both(models: Models, head: Head, features: FeatureNetwork | None) -> Iterator[tuple[str, Tensor]]:
    """Estimate weights [150, 3] by the method of `facerf estimate-light` and by the paper's least squares."""
    found = estimate_light(models, head, estimator=Estimator(features=features))
    yield "facerf", found.light.weights
    yield "least squares", found.evidence.least_squares(non_negative=False)


def compare(found: Tensor, light: KnownLight) -> dict[str, float]:
    """Compare estimated weights [150, 3] with the truth by each of MEASURES."""
    truth, estimate = RigLight(RIG, light.weights), RigLight(RIG, found)
    toward = brightest_direction(truth)
    coefficients = rig_coefficients(estimate, 2), rig_coefficients(truth, 2)
    return {
        "angle": light_error_deg(brightest_direction(estimate).numpy(), toward.numpy()),
        "weights": _error(found, light.weights),
        "weights scaled": _scaled_error(found, light.weights),
        "SH": _error(*coefficients),
        "SH scaled": _scaled_error(*coefficients),
    }


def _error(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).norm() / truth.norm())


def _scaled_error(found: Tensor, truth: Tensor) -> float:
    return _error(found * (found * truth).sum() / found.square().sum().clamp_min(1e-12), truth)


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.2f} / {np.mean(values):.2f} / {np.quantile(values, 0.9):.2f}"


if __name__ == "__main__":
    main()
