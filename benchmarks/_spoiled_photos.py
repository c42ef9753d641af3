"""Photos of people whose outlines are known, and spoiled variants of them, for `confidence.py`."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
from _common import PHOTOS, SHARED
from PIL import Image, ImageDraw, ImageFilter
from scipy.ndimage import gaussian_filter

from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear, to_display
from facerf_cli.image.strips import resized
from facerf_cli.portrait.find import Face, detect_faces
from facerf_cli.portrait.segment import segment
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth.bank.backgrounds import heaps_of, views_of_map
from facerf_cli.synth.bank.people import BRIGHTEST, PeopleBankSettings, bake_person

LONGEST_PX = 640  # of a photo
SYNTHETIC = 10  # people
SEED = 61


@dataclass(frozen=True, eq=False)
class Scene:
    """A photo [H, W, 3] uint8, its person [H, W] and what is nobody's [H, W], and landmarks [68, 2]."""

    image: np.ndarray
    person: np.ndarray
    ignored: np.ndarray
    landmarks_px: np.ndarray

    @property
    def linear(self) -> np.ndarray:
        """The photo, scene-linear."""
        return srgb_to_linear(self.image / np.float32(255))

    @property
    def eyes_px(self) -> float:
        """Distance of the outer corners of the eyes."""
        left, right = self.landmarks_px[list(OUTER_EYE_CORNERS)]
        return float(np.linalg.norm(right - left))

    def lit(self, gain: float, noise: float = 0.0) -> "Scene":
        """The scene at another exposure, with noise of a standard deviation in levels."""
        levels = 255 * linear_to_srgb((gain * self.linear).clip(0, 1))
        levels += noise * np.random.default_rng(SEED).standard_normal(levels.shape)
        return replace(self, image=levels.round().clip(0, 255).astype(np.uint8))

    def blurred(self, share: float) -> "Scene":
        """The scene blurred by a share of the face's extent."""
        sigma = share * np.ptp(self.landmarks_px, axis=0).max()
        return replace(self, image=gaussian_filter(self.image, (sigma, sigma, 0)))

    def cropped(self, left: float, top: float, right: float, bottom: float) -> "Scene":
        """The part of the scene between places in its pixels."""
        height, width = self.person.shape
        x0, y0 = max(0, round(left)), max(0, round(top))
        part = np.s_[y0 : min(height, round(bottom)), x0 : min(width, round(right))]
        return Scene(self.image[part], self.person[part], self.ignored[part], self.landmarks_px - (x0, y0))

    def of_face(self, extent_px: float) -> "Scene":
        """The scene with a face of another extent."""
        scale = extent_px / np.ptp(self.landmarks_px, axis=0).max()
        size = [round(scale * side) for side in self.person.shape]
        image = resized(self.image.astype(np.float32), *size).round().clip(0, 255).astype(np.uint8)
        person, ignored = (resized(mask.astype(np.float32), *size) for mask in (self.person, self.ignored))
        return Scene(
            image, person > 0.5, (ignored > 0) | (abs(person - 0.5) < 0.45), scale * self.landmarks_px
        )

    def covered(self, x: float, y: float, width: float, height: float) -> "Scene":
        """The scene behind a thing, whose middle and sides are in eyes' distances from the eyes' middle."""
        middle = self.landmarks_px[list(OUTER_EYE_CORNERS)].mean(0)
        low = (middle + self.eyes_px * np.array([x - width / 2, y - height / 2])).round().astype(int)
        high = (low + self.eyes_px * np.array([width, height])).round().astype(int)
        columns, rows = (slice(max(0, a), max(0, b)) for a, b in zip(low, high, strict=True))
        image, ignored = self.image.copy(), self.ignored.copy()
        part = image[rows, columns]
        if part.size:  # the photo shows the place
            heap = heaps_of(1, SEED)[0].permute(1, 2, 0).numpy().astype(np.float32)
            part[:] = resized(heap, *part.shape[:2])
        ignored[rows, columns] = True
        return replace(self, image=image, ignored=ignored)

    def with_other(self, other: "Scene", x: float, y: float, before: bool) -> "Scene":
        """The scene with another's person, whose face is as large and x, y eyes' distances away."""
        scale = self.eyes_px / other.eyes_px
        size = [max(1, round(scale * side)) for side in other.person.shape]
        shift = (
            self.landmarks_px.mean(0) + self.eyes_px * np.array([x, y]) - scale * other.landmarks_px.mean(0)
        )
        alpha, colours = np.zeros(self.person.shape, np.float32), self.image.astype(np.float32)
        low = shift.round().astype(int)
        at = [np.maximum(0, low), np.minimum(low + size[::-1], self.person.shape[::-1])]
        here = np.s_[at[0][1] : at[1][1], at[0][0] : at[1][0]]
        there = np.s_[at[0][1] - low[1] : at[1][1] - low[1], at[0][0] - low[0] : at[1][0] - low[0]]
        alpha[here] = resized(other.person.astype(np.float32)[..., None], *size)[there][..., 0]
        colours[here] = resized(other.image.astype(np.float32), *size)[there]
        if not before:
            alpha *= 1 - gaussian_filter(self.person.astype(np.float32), 0.7)
        image = self.image + alpha[..., None] * (colours - self.image)
        person = self.person & ~(alpha > 0.5) if before else self.person
        return replace(self, image=image.round().clip(0, 255).astype(np.uint8), person=person)


def spoiled(scene: Scene, other: Scene) -> Iterator[tuple[str, Scene]]:
    """The scene, and spoiled variants of it."""
    yield "as it is", scene
    for gain in (2, 4, 10):
        yield f"exposed {gain} times", scene.lit(gain)
    for gain, noise in ((1 / 8, 1), (1 / 40, 4), (1 / 200, 2)):
        yield f"exposed 1/{1 / gain:.0f}, noise {noise}", scene.lit(gain, noise)
    for share in (0.005, 0.015, 0.04):
        yield f"blurred by {100 * share:.1f} %", scene.blurred(share)
    yield "small: 48 pixels", scene.of_face(48)
    height, width = scene.person.shape
    (x, y), eyes = scene.landmarks_px[list(OUTER_EYE_CORNERS)].mean(0), scene.eyes_px
    chin = float(scene.landmarks_px[8, 1])
    yield "cropped at the chest", scene.cropped(0, 0, width, chin + 0.5 * eyes)
    yield "cropped at the brows", scene.cropped(0, y - 0.4 * eyes, width, height)
    yield "cropped at an eye", scene.cropped(x - 0.35 * eyes, 0, width, height)
    yield "cropped at the nose", scene.cropped(0, 0, x, height)
    yield "eyes covered", scene.covered(0, 0, 1.3, 0.45)
    yield "mouth covered", scene.covered(0, 0.85, 1, 0.7)
    yield "half covered", scene.covered(0.5, 0.4, 1, 2.2)
    yield "chest covered", scene.covered(-0.6, 2.2, 1.6, 1)
    yield "another before", scene.with_other(other, 1.9, 0.6, True)
    yield "another behind", scene.with_other(other, -1.7, -0.3, False)
    yield "another close behind", scene.with_other(other, 1.1, -0.5, False)


def face_near(image: np.ndarray, place_px: np.ndarray) -> Face | None:
    """The face of an image that is nearest to a place [2]."""
    faces = detect_faces(SHIPPED_NETWORKS.people, image)
    return min(faces, key=lambda one: np.linalg.norm(one.landmarks_px.mean(0) - place_px), default=None)


def drawn(entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The person [H, W] of an outline drawn by hand, and what is nobody's."""
    person, ignored = (Image.new("L", tuple(entry["size"])) for _ in range(2))
    for fill, polygons in ((255, entry["person"]), (0, entry["holes"])):
        for polygon in polygons:
            ImageDraw.Draw(person).polygon([tuple(point) for point in polygon], fill=fill)
    for band in entry["ignore"]:
        draw, points = ImageDraw.Draw(ignored), [tuple(point) for point in band.get("line", ())]
        if "polygon" in band:
            draw.polygon([tuple(point) for point in band["polygon"]], fill=255)
            continue
        reach = band["radius"]
        draw.line(points, fill=255, width=int(2 * reach))
        for x, y in points:
            draw.ellipse((x - reach, y - reach, x + reach, y + reach), fill=255)
    size = 2 * max(2, round(max(entry["size"]) / 400)) + 1
    grown, kept = (
        np.asarray(person.filter(of(size))) > 0 for of in (ImageFilter.MaxFilter, ImageFilter.MinFilter)
    )
    return np.asarray(person) > 0, (np.asarray(ignored) > 0) | (grown & ~kept)


def photo_scene(image: np.ndarray, entry: dict[str, Any] | None) -> Scene:
    """The scene of a photo with its outline; without one the person is the photo's matte."""
    scale = min(1.0, LONGEST_PX / max(image.shape[:2]))
    size = round(scale * image.shape[0]), round(scale * image.shape[1])
    small = resized(image.astype(np.float32), *size).round().clip(0, 255).astype(np.uint8)
    if entry is None:
        face = face_near(small, np.array(size[::-1]) / 2)
        assert face is not None
        matte = segment(SHIPPED_NETWORKS.people, small, face.landmarks_px).matte
        return Scene(small, matte > 0.5, abs(matte - 0.5) < 0.45, face.landmarks_px)
    person, ignored = (resized(mask.astype(np.float32), *size) > 0.5 for mask in drawn(entry))
    top = np.argwhere(person)[:, 0].min()
    faces = detect_faces(SHIPPED_NETWORKS.people, small, everyone=True)
    mine = [face for face in faces if person[tuple(face.landmarks_px[30].astype(int)[::-1])]]
    face = min(mine, key=lambda one: one.landmarks_px[30, 1] - top)
    return Scene(small, person, ignored, face.landmarks_px)


def synthetic_scene(number: int) -> Scene | None:
    """A synthetic person before a view of a sky or shapes; None where the head is not found."""
    settings = PeopleBankSettings(cameras=1, images=1, looks=1, with_squares=False)
    (photo,) = bake_person(["builtin"], SEED, settings, number).values()
    alpha = photo["alpha"].numpy() / np.float32(255)
    radiance = np.square(photo["images"][0].permute(1, 2, 0).numpy() / 255) * BRIGHTEST * 0.25
    drawn_behind = views_of_map(number, SEED) if number % 3 else heaps_of(1, SEED + number)
    behind = resized(drawn_behind[0].permute(1, 2, 0).numpy().astype(np.float32), *alpha.shape)
    image = to_display(radiance + (1 - alpha[..., None]) * srgb_to_linear(behind / 255))
    face = face_near(image, photo["landmarks_px"][:68].numpy().mean(0))
    edge = abs(alpha - 0.5) < 0.45
    return face and Scene(image, alpha > 0.5, edge, face.landmarks_px)


def all_scenes(matte: Path, photos: list[Path]) -> dict[str, Scene]:
    """The scenes by name: photos with outlines, other photos, synthetic people."""
    found: dict[str, Scene | None] = {}
    for name, entry in json.loads((matte / "polygons.json").read_text()).items():
        paths = [folder / name for folder in (PHOTOS, SHARED / "data" / "photos_look")]
        path = next((path for path in paths if path.is_file()), None)
        image = np.asarray(Image.open(path).convert("RGB")) if path else skimage.data.astronaut()
        found[Path(name).stem] = photo_scene(image, entry)
    found |= {path.stem: photo_scene(np.asarray(Image.open(path).convert("RGB")), None) for path in photos}
    found |= {f"synthetic {number}": synthetic_scene(number) for number in range(SYNTHETIC)}
    return {name: scene for name, scene in found.items() if scene is not None}
