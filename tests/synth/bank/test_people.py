"""People of a bank: baked once, photographed, seen as users' photos are, and lit by any light."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.sphere import direction_to_azel, rig_directions
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.network.portrait import SKIN
from facerf_cli.portrait.parse import MORE_LANDMARKS, class_index
from facerf_cli.portrait.person import SIDES
from facerf_cli.raster.camera import project
from facerf_cli.relighting.white import BARE, without_colour_of_shade
from facerf_cli.synth import bank
from facerf_cli.synth.bank import Files, people, portrait_samples
from facerf_cli.synth.bank.people import PeopleBankSettings, add_people, photos_in, read_photo
from facerf_cli.synth.bank.portrait_samples import (
    PortraitSample,
    PortraitSquares,
    StoredView,
    draw_targets,
    load_view,
)
from facerf_cli.synth.bank.proxies import seen_path
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.renderer import albedo_of, images_under
from tests.refusals import refused
from tests.synth.conftest import SMALL, backgrounds

SIDE_PX = SMALL.side_px


@pytest.fixture(scope="module")
def folder(people_folder: Path) -> Path:
    return people_folder


@pytest.fixture(scope="module")
def view(folder: Path) -> StoredView:
    return load_view(folder / "00001_0.safetensors")


def drawn(folder: Path, seed: int) -> PortraitSample:
    stored = PortraitSquares(folder, backgrounds(), {"licence": "MIT"})
    return stored.draw([0], 3, torch.Generator().manual_seed(seed))


@pytest.mark.slow
def test_images_are_linear_in_light_and_looks_differ_in_albedo(view: StoredView) -> None:
    """But for the highlights of weak lights, of which only the brightest twelve are kept."""
    single = torch.eye(14)[:, :, None].expand(-1, -1, 3)
    weights = torch.zeros(1, 14, 3)
    weights[0, [2, 7]] = torch.tensor([[1.0, 0.5, 0.2], [0.3, 0.3, 2.0]])
    images = images_under(view.baked, view.looks[0], torch.cat([single, weights]))
    summed = torch.einsum("lc,lcij->cij", weights[0], images[:14])
    torch.testing.assert_close(images[14], summed, rtol=1e-3, atol=1e-4)
    (first, normals), (second, again) = (albedo_of(view.baked, look) for look in view.looks)
    assert (first - second).abs().mean() > 0.01 and torch.equal(normals, again)
    assert first.min() >= 0 and first.max() < 1
    assert first[:, view.baked.alpha == 0].max() < 0.05  # alpha is in 256 steps
    landmarks = view.baked.landmarks_px[:68]
    extent = float((landmarks.amax(0) - landmarks.amin(0)).max())
    assert extent == pytest.approx(SIDE_PX / SIDES, rel=0.25)  # four deviations
    assert 0.15 < view.baked.alpha.mean() < 0.9


def test_squares_are_parts_of_the_photo_and_many_targets_are_lit_from_behind() -> None:
    """Landmarks in a square lie where its crop of the photo has them."""
    landmarks = np.random.default_rng(0).uniform(-0.07, 0.07, (68, 3))
    subject = cast(SyntheticPerson, SimpleNamespace(landmarks_world=landmarks))
    scales = np.array([1.6, 3.0, 6.5])
    drawn = people._draw_views(subject, scales, np.random.default_rng(1), PeopleBankSettings())
    points = torch.from_numpy(landmarks).float()
    in_photo = project(drawn.photo.to_camera(points), drawn.photo.camera).numpy()
    for sides, camera, (x0, y0, side, size) in zip(scales, drawn.squares, drawn.crops.tolist(), strict=True):
        seen = project(camera.to_camera(points), camera.camera).numpy()
        np.testing.assert_allclose(Crop(x0, y0, side, int(size)).to_crop(in_photo), seen, atol=0.02)
        assert np.ptp(seen, 0).max() == pytest.approx(size / sides, rel=1e-4)
        assert min(x0, y0) > -1e-6 and max(x0, y0) + side < drawn.photo.camera.width_px + 1e-6
    # Rims: a tenth of all directions, and of targets; most of these are in front.
    rig = rig_directions(150)
    generator = torch.Generator().manual_seed(0)
    chosen = torch.cat([draw_targets(rig, 4, generator) for _ in range(500)])
    azimuth, elevation = direction_to_azel(rig[chosen])
    rims = (azimuth.abs() > 120) & (elevation > 0) & (elevation < 40)
    assert 0.07 < rims.float().mean() < 0.13 and (rig[chosen, 2] > -0.2).float().mean() > 0.8


def test_what_is_seen_fits_the_truth(folder: Path, view: StoredView) -> None:
    seen = load_file(seen_path(folder / "00001_0.safetensors"))
    person, alpha = (x[: int(seen["rows"])] for x in (1 - seen["classes"][0].float() / 255, view.baked.alpha))
    both = torch.minimum(person, alpha).sum() / torch.maximum(person, alpha).sum()
    assert both > 0.7
    assert seen["visible"].shape == (14, len(view.baked.alpha) // 2, len(view.baked.alpha) // 2)
    _, normals = albedo_of(view.baked, view.looks[0])
    skin = seen["classes"][SKIN] > 230
    alike = (F.normalize(normals, dim=0) * seen["normals"].float()).sum(0)[skin]
    assert alike.mean() > 0.8


@pytest.mark.parametrize("view", ["00001_0", "00001_1"])
def test_what_is_seen_lies_where_the_truth_does(folder: Path, view: str) -> None:
    """In the view's own square, not in one of its own: moved by 3 pixels the classes fit worse."""
    path = folder / f"{view}.safetensors"
    layers, truth = load_file(seen_path(path)), load_view(path).baked.classes[..., SKIN]
    truth[int(layers["rows"]) :] = 0
    seen = layers["classes"][SKIN].float() / 255
    moves = [(x, y) for x in (-3, 0, 3) for y in (-3, 0, 3)]
    errors = [float((seen.roll(move, (0, 1)) - truth).abs().mean()) for move in moves]
    assert moves[errors.index(min(errors))] == (0, 0)


def test_samples_are_exposed_by_the_skin(folder: Path) -> None:
    sample = drawn(folder, 1)
    side_px = sample.inputs.image.shape[-1]
    assert side_px % 32 == 0 and sample.targets.shape == (1, 3, 3, side_px, side_px)
    for image in (sample.inputs.image, sample.albedo):
        skin = sample.inputs.classes[:, SKIN]
        mean = (image.mean(1) * skin).sum() / skin.sum()
        assert float(mean) == pytest.approx(MEAN_RADIANCE, rel=1e-3)
    small = F.avg_pool2d(sample.original, 8), F.avg_pool2d(sample.inputs.image, 8)
    covered = F.avg_pool2d(1 - sample.shares[:, :1], 8)[0, 0] > 0.99
    dark, light = (x.mean(1)[0][covered] for x in small)
    assert float(torch.corrcoef(torch.stack([dark, light]))[0, 1]) > 0.8


def test_a_photo_that_ends_shows_its_last_row_beyond(folder: Path) -> None:
    """The person below counts nothing; nothing of it is seen, but for the proxy."""
    rows, side = 163, 192  # of the first square
    assert int(load_file(seen_path(folder / "00001_0.safetensors"))["rows"]) == rows
    stored = PortraitSquares(folder, backgrounds(), {"licence": "MIT"})
    sample = stored.draw([0], 3, torch.Generator().manual_seed(1), side)
    image = sample.inputs.image
    beyond, last = image[..., rows:, :], image[..., rows - 1 : rows, :]
    assert (beyond - last).abs().max() < 0.01  # the colour of shade is evened over some pixels
    assert sample.shares[:, 0, rows:].min() == 1 and sample.shares[:, 0, :rows].min() == 0
    assert sample.inputs.classes[:, 0, rows + 1 :].min() > 0.99
    assert sample.inputs.covered[..., rows:, :].max() == 1


def test_shadows_of_what_is_not_seen_fall_on_a_quarter_of_photos() -> None:
    generator = torch.Generator().manual_seed(0)
    shares = [portrait_samples._foreign_shadow(32, generator) for _ in range(200)]
    shadowed = [share for share in shares if share.min() < 0.99]
    assert 0.18 < len(shadowed) / 200 < 0.32
    assert all(share.min() > 0.1 and share.max() <= 1 for share in shares)
    assert sum(float(share.max() - share.min()) > 0.15 for share in shadowed) > 0.7 * len(shadowed)


def test_the_network_sees_shaded_skin_in_the_colour_of_lit_skin(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = range(6)
    evened = [drawn(folder, seed) for seed in seeds]
    monkeypatch.setattr(portrait_samples, "even_shade_of", lambda image, classes: torch.ones(3, 1, 1))
    least = []
    for seed, even in zip(seeds, evened, strict=True):
        plain = drawn(folder, seed).inputs.image[0]
        factors = without_colour_of_shade(plain, even.inputs.classes[0, BARE].sum(0))
        torch.testing.assert_close(even.inputs.image[0], plain * factors, rtol=1e-4, atol=1e-5)
        least.append(float(factors.min()))
    assert min(least) < 0.95


def test_squares_show_what_those_of_photos_do() -> None:
    landmarks = np.random.default_rng(0).uniform(-0.07, 0.07, (68, 3))
    subject = cast(SyntheticPerson, SimpleNamespace(landmarks_world=landmarks))
    settings, random = PeopleBankSettings(), np.random.default_rng(1)
    views = [view for _ in range(60) for view in people._draw_cameras(subject, random, settings)]
    assert 0.2 < np.mean([view.rows < settings.photo_px for view in views]) < 0.45
    squares = [square for view in views for square in view.squares]
    points = torch.from_numpy(landmarks).float()
    faces_px = [np.ptp(project(one.to_camera(points), one.camera).numpy(), 0).max() for one in squares]
    sizes = np.array([one.camera.width_px for one in squares])
    sides = sizes / faces_px
    assert (np.abs(sides / SIDES - 1) < 0.13).mean() > 0.9 and np.abs(sides / SIDES - 1).max() < 0.3
    assert set(sizes) <= set(range(96, 257, 32)) and 55 < np.median(faces_px) < 75


def test_a_mirrored_sample_is_lit_from_the_other_side(folder: Path) -> None:
    """Normals, lights, shadows and their summary are mirrored alike."""
    from facerf_cli.synth.bank.portrait_samples import mirrored

    sample = drawn(folder, 2)
    other = mirrored(sample)
    cosine, flipped = (torch.einsum("btc,bcij->btij", s.lights, s.inputs.normals) for s in (sample, other))
    torch.testing.assert_close(flipped, cosine.flip(-1))
    assert torch.equal(other.targets, sample.targets.flip(-1))
    assert torch.equal(other.visible, sample.visible.flip(-1))

    def towards(one: PortraitSample) -> Tensor:
        """Visibility toward the image's upper right, or in the mirror its upper left."""
        sign = 1.0 if one is sample else -1.0
        at = F.normalize(torch.tensor([sign * 0.6, 0.5, 0.6]), dim=0)
        return torch.einsum("k,bkij->bij", sh_basis(at, 3), one.inputs.reached)

    torch.testing.assert_close(towards(other), towards(sample).flip(-1), rtol=1e-4, atol=1e-5)
    assert torch.equal(mirrored(other).inputs.image, sample.inputs.image)


def test_finished_people_are_kept_and_squares_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def draw(models: list[str], seed: int, settings: PeopleBankSettings, index: int) -> Files:
        made.append(index)
        names = [f"photo_{index:05d}_0"]
        names += [f"{index:05d}_{k}" for k in range(settings.squares)] if settings.with_squares else []
        return {name: {"of": torch.tensor([index])} for name in names}

    monkeypatch.setattr(people, "bake_person", draw)
    monkeypatch.setattr(bank, "in_shards", lambda work, items, jobs: work(items))
    for count, squares in ((2, False), (3, False), (3, True), (3, True)):
        add_people(tmp_path, ["a", "b"], range(count), 1, 0, replace(SMALL, with_squares=squares))
    assert made == [0, 1, 2, 0, 1, 2] and len(list(tmp_path.iterdir())) == 9
    refused(InputError, "no squares", PortraitSquares, tmp_path, backgrounds(), {})
    refused(InputError, "no photos", photos_in, tmp_path / "empty")


def test_photos_differ_by_light_and_share_their_truth(folder: Path) -> None:
    photo = load_file(folder / "photo_00001_0.safetensors")
    images, covered = photo["images"].float(), photo["alpha"] > 250
    assert images.shape == (3, 3, 448, 448) and photo["landmarks_px"].shape == (68 + len(MORE_LANDMARKS), 2)
    assert (images[0] - images[1]).abs()[:, covered].mean() > 3
    assert (images[..., photo["alpha"] == 0] == 0).all() and images[..., covered].mean() > 10
    face = [
        class_index(name) for name in ("skin", "brows", "eyes", "lips", "mouth", "beard", "hand", "glasses")
    ]
    points = photo["landmarks_px"][27:68].long()
    inside = points[((points >= 0) & (points < 448)).all(1)]
    labels = photo["label"][inside[:, 1], inside[:, 0]].tolist()
    assert len(inside) > 20 and sum(label in face for label in labels) > 0.8 * len(labels)
    assert (photo["points_px"][17:] - photo["landmarks_px"][17:68]).abs().max() < 1e-3
    assert read_photo(photos_in(folder)[0][0], torch.Generator()).radiance.shape == (3, 448, 448)
