"""Halos and drawn lines at edges of relit people: contrast that neither the photo nor smooth shading has.

    python benchmarks/edges.py [PHOTO|DIR ...] [--light AZ,EL ...]

At each strong edge that the photo shows (of cloth and skin, of a lapel) both images are read along the
normal, in three bands of a thirtieth of the face on each side: near, middle and far. Printed in EV:

    halo     change of the image from the middle band to the near one, beyond that of the photo there, less
             that from the far band to the middle one, summed over both sides: light of the other side
    line     how far the image at the edge lies outside of both near bands, less that of the photo
    outline  as halo, of the inner side of the matte's outline

Each is the mean over the edges; `strongest` is the mean of halo and line over the tenth with most of them.
Hair, eyes, mouth and the middle of the face are left out: there edges are strands, features and form.
"""

from pathlib import Path

import numpy as np
import torch
from _common import arguments, photos, print_header, print_row
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter, minimum_filter

import facerf_cli as facerf
from facerf_cli.api import Person
from facerf_cli.image.colour import luminance
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.segment import Segmentation

LIGHTS = ((45.0, 20.0), (-75.0, 10.0), (160.0, 10.0))
ROOM = 0.06  # as `facerf relight` before a bright background
BANDS = 30  # of a face
FLOOR = 0.03  # of the mean of the person: what is darker shows no line
STEP = 1.0  # log2 of the photo across an edge, from which on it counts
LEFT_OUT = ("hair", "beard", "eyes", "mouth", "brows")


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__)
    parser.add_argument("photos", type=Path, nargs="*", help="photos, or folders of them")
    parser.add_argument("--light", action="append", help="azimuth,elevation in degrees; may be repeated")
    given = parser.parse_args()
    torch.set_num_threads(1)
    models = facerf.load_models()
    lights = [tuple(map(float, one.split(","))) for one in given.light or ()] or LIGHTS
    print_header("photo", "face", "light", "edges", "halo", "line", "strongest", "outline")
    for path in photos(given.photos):
        photo = facerf.read_image(path)
        for number, face in enumerate(find_faces(models.networks.people, photo, str(path), "all")):
            person = facerf.fit(models, photo, face.landmarks_px)
            for at in lights:
                relit = person.relight(facerf.Light.single(*at), background="none", room=ROOM)
                print_row(path.stem, number, "{:g},{:g}".format(*at), *figures(person, photo, relit[..., :3]))


def figures(person: Person, photo: np.ndarray, relit: np.ndarray) -> list[object]:
    """Number of edges, and halo, line, strongest and outline in EV of a relit image [H, W, 3]."""
    landmarks = person.landmarks
    face_px = float(np.ptp(landmarks, 0).max())
    found = contrast(photo, relit, person.share, left_out_of(person.segmentation, face_px), face_px)
    return [found[0].size, *(f"{value:.3f}" for value in summary(*found))]


def left_out_of(segmentation: Segmentation, face_px: float) -> np.ndarray:
    """Share [H, W] of what is left out of a person."""
    skin = minimum_filter(segmentation.layer("skin"), round(2 * face_px / BANDS))
    return np.asarray(sum(segmentation.layer(name) for name in LEFT_OUT) + skin)


def summary(halo: np.ndarray, line: np.ndarray, outline: np.ndarray) -> tuple[float, ...]:
    """Halo, line, strongest and outline of all edges."""
    both = np.sort(halo + line)
    return halo.mean(), line.mean(), both[-max(1, len(both) // 10) :].mean(), outline.mean()


def contrast(
    photo: np.ndarray, relit: np.ndarray, matte: np.ndarray, left_out: np.ndarray, face_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Halo [N] and line [N] of the edges inside a person, and halo [M] of the matte's outline, in EV."""
    inside = (matte > 0.98) & (left_out < 0.2)
    shown, lit = luminance(photo), luminance(relit)
    shown, lit = (np.log2(image.clip(min=0) + FLOOR * image[inside].mean()) for image in (shown, lit))
    band = max(2.0, face_px / BANDS)

    def bands(edges: np.ndarray, normals: np.ndarray, image: np.ndarray) -> np.ndarray:
        """Means [6, N] of an image from `far` on the darker side to `far` on the brighter one."""
        offsets = 1.5 + np.linspace(0, 3 * band, 3 * max(2, round(band)))
        at = edges[:, None] + np.concatenate([-offsets[::-1], offsets])[:, None] * normals[:, None]
        values = map_coordinates(image, at, order=1, mode="constant", cval=0)
        return values.reshape(6, -1, edges.shape[1]).mean(1)

    def sides(edges: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return bands(edges, normals, inside.astype(np.float32)) > 0.9

    edges, normals = edge_pixels(gaussian_filter(shown, 1.0), inside)
    whole = sides(edges, normals).all(0)
    edges, normals = edges[:, whole], normals[:, whole]
    photo_bands, relit_bands = bands(edges, normals, shown), bands(edges, normals, lit)
    steep = photo_bands[3] - photo_bands[2] > STEP
    edges, photo_bands, relit_bands = (values[:, steep] for values in (edges, photo_bands, relit_bands))
    halos = sum(halo(photo_bands[side], relit_bands[side]) for side in (slice(0, 3), slice(None, 2, -1)))
    at = tuple(edges.astype(int))
    below, above = (
        outside(values[2:4], image[at]) for values, image in ((photo_bands, shown), (relit_bands, lit))
    )
    lines = (np.abs(above) - np.abs(below)).clip(0)

    rim, inward = edge_pixels(gaussian_filter(matte, 1.0), (matte > 0.3) & (matte < 0.7) & (left_out < 0.2))
    rim = rim + 2 * inward  # where the matte is whole
    whole = sides(rim, inward)[3:].all(0)
    outline = [bands(rim[:, whole], inward[:, whole], image)[:2:-1] for image in (shown, lit)]
    return halos, lines, halo(*outline)


def halo(photo: np.ndarray, relit: np.ndarray) -> np.ndarray:
    """Halo [N] on a side, from the means of its bands [3, N]: far, middle, near."""
    (step, change), smooth = (values[2] - values[1] for values in (photo, relit)), relit[1] - relit[0]
    beyond = np.maximum(change - step.clip(min=0), step.clip(max=0) - change)
    return (beyond - np.abs(smooth)).clip(0)


def outside(between: np.ndarray, values: np.ndarray) -> np.ndarray:
    """How far values [N] lie outside of two [2, N]."""
    return np.maximum(values - between.max(0), between.min(0) - values).clip(0)


def edge_pixels(image: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [2, N] of edges of an image, and their normals toward its brighter side."""
    slope = np.stack(np.gradient(image))
    size = np.linalg.norm(slope, axis=0)
    ridge = (size >= 0.98 * maximum_filter(size, 3)) & (size > 1e-3) & within
    return np.stack(np.nonzero(ridge)).astype(np.float64), slope[:, ridge] / size[ridge]


if __name__ == "__main__":
    main()
