"""Training crops: landmarks and classes move with the pixels, whatever is drawn."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.portrait.parse import MORE_LANDMARKS, class_index
from facerf_cli.synth.bank import parsing_crops
from facerf_cli.synth.bank.parsing_crops import FeatureWarp, ParsingCrops, ParsingPhotos
from facerf_cli.synth.camera import SimulatedCamera
from tests.kinds import Folders, Patch
from tests.refusals import refused

SIDE, STORED = 64, 96
LANDMARKS = 68 + len(MORE_LANDMARKS)
EAR_BACKS = [68 + MORE_LANDMARKS.index(f"{side} ear back") for side in ("left", "right")]


@pytest.fixture(scope="module")
def portraits(tmp_path_factory: Folders) -> ParsingPhotos:
    """Two people: discs of skin on a garment, with landmarks in a ring around the disc's middle."""
    folder = tmp_path_factory.mktemp("portraits")
    at = torch.arange(STORED) + 0.5
    disc = (at[:, None] - 40).square() + (at - 50).square() < 18**2
    garment = (at[:, None] > 62).expand(STORED, STORED)
    angle = torch.arange(LANDMARKS) / 68 * 2 * torch.pi
    ring = torch.stack([50 + 14 * angle.cos(), 40 + 14 * angle.sin()], -1)
    ring[EAR_BACKS] = torch.nan
    for person in range(2):
        label = torch.where(disc, class_index("skin"), class_index("garment")).byte()
        picture = torch.where(disc, 200, 60)[None] * torch.ones(3, 1, 1) * (disc | garment)
        for camera in range(2):
            photo = {
                "images": picture.byte().expand(3, 3, STORED, STORED).contiguous(),
                "alpha": (255 * (disc | garment)).byte(),
                "label": label,
                "landmarks_px": ring,
            }
            save_file(photo, folder / f"photo_{person:05}_{camera}.safetensors")
    backgrounds = torch.randint(0, 60, (3, 3, 32, 32), generator=torch.Generator().manual_seed(0)).byte()
    return ParsingPhotos(folder, backgrounds, {"licence": "MIT"})


def drawn(portraits: ParsingPhotos, seed: int) -> ParsingCrops:
    return portraits.draw([0, 1], SIDE, torch.Generator().manual_seed(seed))


@pytest.fixture
def plain(monkeypatch: Patch) -> None:
    """Every sample shows a person, uncovered and whole."""
    for name in ("_EMPTY", "_HEADLESS", "_OCCLUDED", "_BORDERED", "_SECOND"):
        monkeypatch.setattr(parsing_crops, name, 0.0)


def test_a_draw_is_a_function_of_its_generator_and_an_empty_folder_none(
    portraits: ParsingPhotos, tmp_path: Path
) -> None:
    for seed in range(12):
        one, two = drawn(portraits, seed), drawn(portraits, seed)
        assert all(torch.equal(getattr(one, name), getattr(two, name)) for name in vars(one))
        assert one.crops.min() >= 0 and one.crops.max() <= 1 and one.crops.isfinite().all()
    refused(InputError, "no photos", ParsingPhotos, tmp_path, torch.zeros(1, 3, 8, 8).byte(), {})


@pytest.mark.usefixtures("plain")
def test_landmarks_and_classes_move_with_the_pixels(portraits: ParsingPhotos) -> None:
    seen = 0
    for seed in range(40):
        crop = drawn(portraits, seed)
        assert not crop.known[0, EAR_BACKS].any()  # they are missing in the stored photo
        ring = crop.landmarks[0, :68]
        middle = ring.mean(0)
        radius = (ring - middle).norm(dim=-1).mean() * SIDE
        at = (torch.arange(SIDE) + 0.5) / SIDE
        away = ((at[:, None] - middle[1]).square() + (at - middle[0]).square()).sqrt() * SIDE
        inside, around = away < radius - 2, (away > radius * 18 / 14 + 2) & (away < radius * 18 / 14 + 3)
        skin = (crop.label[0] == class_index("skin")) & (crop.alpha[0] > 0.5)
        if crop.known[0, :68].all() and inside.any():
            seen += 1
            assert skin[inside].float().mean() > 0.95 and not skin[around].any()
    assert seen > 20


@pytest.mark.usefixtures("plain")
def test_a_mirrored_photo_has_mirrored_landmarks(portraits: ParsingPhotos) -> None:
    photo = portraits._photo([0], torch.Generator().manual_seed(0))
    mirrored = photo.mirrored()
    assert torch.equal(mirrored.alpha, photo.alpha.flip(-1))
    ear, other = (68 + MORE_LANDMARKS.index(f"{side} ear top") for side in ("left", "right"))
    assert torch.allclose(
        mirrored.landmarks_px[ear],
        photo.landmarks_px[other] * torch.tensor([-1.0, 1]) + torch.tensor([STORED, 0.0]),
    )
    again = mirrored.mirrored()
    assert torch.allclose(again.landmarks_px.nan_to_num(-1), photo.landmarks_px.nan_to_num(-1), atol=1e-4)


def test_crops_bodies_and_borders_without_a_person(portraits: ParsingPhotos, monkeypatch: Patch) -> None:
    monkeypatch.setattr(parsing_crops, "_EMPTY", 1.0)
    crop = drawn(portraits, 3)
    assert crop.present.tolist() == [0] and not crop.known.any() and not crop.alpha.any()
    assert crop.crops.std() > 0.01
    for name, share in (("_EMPTY", 0.0), ("_HEADLESS", 1.0), ("_BORDERED", 0.0)):
        monkeypatch.setattr(parsing_crops, name, share)
    crops = [drawn(portraits, seed) for seed in range(12)]
    assert all(crop.present.tolist() == [0] and not crop.known.any() for crop in crops)
    assert not any(
        ((crop.label == class_index("skin")) & (crop.alpha > 0.5)).float().mean() > 0.2 for crop in crops
    )
    assert sum(bool((crop.label == class_index("garment")).any()) for crop in crops) > 6
    covered = 0
    for seed in range(20):
        monkeypatch.setattr(parsing_crops, "_OCCLUDED", 1.0)
        with_one = drawn(portraits, seed)
        monkeypatch.setattr(parsing_crops, "_OCCLUDED", 0.0)
        without = drawn(portraits, seed)
        assert (with_one.alpha <= without.alpha + 1e-6).all()
        covered += int(float(with_one.alpha.sum()) < float(without.alpha.sum()) - 5)
    assert covered > 5
    monkeypatch.setattr(parsing_crops, "_BORDERED", 1.0)
    crop = drawn(portraits, 5)
    outside = crop.weight[0, 0] == 0
    assert outside.all() and torch.equal(crop.crops[0, :, 0], crop.crops[0, :, 1])
    px = (crop.landmarks[0] * SIDE).long().clamp(0, SIDE - 1)
    assert not crop.known[0][crop.weight[0][px[:, 1], px[:, 0]] == 0].any()


@pytest.mark.usefixtures("plain")
def test_decoys_have_the_persons_colours_and_lie_behind(portraits: ParsingPhotos, monkeypatch: Patch) -> None:
    """Each image over black, with decoys and without: the person stays, and shapes appear around it."""
    monkeypatch.setattr(parsing_crops, "background", lambda stored, side, _: torch.zeros(3, side, side))
    monkeypatch.setattr(SimulatedCamera, "colours", lambda self, _: torch.eye(3))
    monkeypatch.setattr(SimulatedCamera, "take", lambda self, image, mean, _: image)
    found = {}
    for share in (0.0, 1.0):
        monkeypatch.setattr(parsing_crops, "_DECOYED", share)
        found[share] = [drawn(portraits, seed) for seed in range(8)]
    around = 0.0
    for plain, decoyed in zip(found[0.0], found[1.0], strict=True):
        assert torch.equal(plain.alpha, decoyed.alpha) and torch.equal(plain.label, decoyed.label)
        person, behind = plain.alpha[0] == 1, plain.alpha[0] == 0
        assert torch.equal(plain.crops[0][:, person], decoyed.crops[0][:, person])
        assert (plain.crops[0][:, behind] == 0).all()
        around += float(decoyed.crops[0][:, behind].mean()) if behind.any() else 0
    assert around > 0.01
    crop, colour = found[0.0][0], torch.tensor([0.4, 0.2, 0.1]).view(3, 1, 1)
    tinted = replace(crop, crops=crop.alpha[:, None] * colour)
    seen = parsing_crops._with_decoys(torch.zeros(3, SIDE, SIDE), tinted, torch.Generator().manual_seed(1))
    assert seen[0].max() > 0.05
    torch.testing.assert_close(seen / colour, (seen[:1] / colour[0]).expand_as(seen))


def test_outlines_landmarks_and_features_go_where_the_image_shows_them() -> None:
    """Around a rectangle of an image that is not mirrored by chance: places are (x, y), within two pixels."""
    alpha = torch.zeros(SIDE, SIDE)
    alpha[10:20, 30:50] = 1
    x, y = (parsing_crops._outline(alpha) * SIDE - 0.5).T
    assert x.min() == 28 and x.max() == 51 and y.min() == 8 and y.max() == 21
    assert not alpha[y.long(), x.long()].any()
    assert not len(parsing_crops._outline(torch.zeros(SIDE, SIDE)))
    # The image at p is taken from p + shift(p): from the landmark, where it is shown.
    for warp in warps():
        shown = warp.shown_at(FACE_PX)
        torch.testing.assert_close(shown + warp.shift(shown), FACE_PX, rtol=0, atol=0.1)  # pixels
    moved = torch.stack([(warp.shown_at(FACE_PX) - FACE_PX).norm(dim=-1) for warp in warps()])
    extent = float((FACE_PX.amax(0) - FACE_PX.amin(0)).max())
    assert 0.01 * extent < moved[:, 17:].mean() < 0.06 * extent
    far = FACE_PX.mean(0) + torch.tensor([[-3 * extent, 0.0], [2 * extent, 2 * extent]])
    assert max(float(warp.shift(far).abs().max()) for warp in warps()) < 1e-3


_MODEL = load_face_model("builtin")
_MEAN = _MODEL.vertices(torch.zeros(1, len(_MODEL.identity)), torch.zeros(1, len(_MODEL.expression)))
FACE_PX = _MODEL.landmarks(_MEAN)[0, :, :2] * torch.tensor([1500.0, -1500.0]) + 300  # pixels


def warps() -> list[FeatureWarp]:
    return [FeatureWarp.draw(FACE_PX, torch.Generator().manual_seed(seed)) for seed in range(20)]
