"""The proxy follows its fit and its hair, and casts the shadows of a head."""

from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import load_face_model
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.network.portrait import SKIN
from facerf_cli.portrait import proxy as module
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.portrait.proxy import Proxy, Shadows, own_shading, proxy_maps, proxy_of, square_camera
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import front_facing, rasterize

SIDE = 96
CROP = Crop(200.0, 200.0, 200.0, 256)
SQUARE = Crop(100.0, 100.0, 400.0, SIDE)


@cache
def fit(wider: float = 0.0) -> FaceFit:
    """A frontal face; `wider` is the size of a random departure from the mean, in standard deviations."""
    model = load_face_model("builtin")
    alpha = wider * torch.randn(len(model.identity), generator=torch.Generator().manual_seed(1))
    place = torch.tensor([0.0, 0.0, -1.0])
    rest = torch.zeros(len(model.expression)), torch.zeros(68, 2), 0.0
    return FaceFit(model.name, CROP, pose_to_rotation(0, 0, 0), place, alpha, *rest)


def classes(hair_px: float = 0.0) -> Tensor:
    """A square without hair, or with hair in a disc of a radius around the head's middle, in its pixels."""
    at = torch.arange(SIDE) + 0.5
    y, x = torch.meshgrid(at, at, indexing="ij")
    label = torch.where((x - 48) ** 2 + (y - 40) ** 2 < hair_px**2, class_index("hair"), 0)
    return F.one_hot(label, len(CLASSES)).permute(2, 0, 1).float()


def proxy(wider: float = 0.0, hair_px: float = 0.0) -> Proxy:
    return proxy_of(load_face_model("builtin"), fit(wider), classes(hair_px), SQUARE)


def test_its_maps_are_a_head_that_follows_the_fitted_face() -> None:
    maps = proxy_maps(proxy(), square_camera(fit(), SQUARE))
    torch.testing.assert_close(maps.normals.norm(dim=0), torch.ones(SIDE, SIDE))
    assert 0.1 < maps.covered.mean() < 0.9 and maps.covered[48, 48] == 1
    assert maps.normals[2, 40, 48] > 0.7  # forehead
    z = maps.positions_m[2]
    assert z[44:54, 46:51].max() > z[40, 48]  # the nose stands out
    assert maps.normals[0, 46, 56:62].min() > 0 > maps.normals[0, 46, 34:40].max()
    # Vertices on the face move as the face does, those of the body by its scale alone.
    model = load_face_model("builtin")
    plain, other = proxy(), proxy(2.0)
    faces = [f.vertices_camera(model) for f in (fit(), fit(2.0))]
    tip = int(faces[0][:, 2].argmax())
    near = int((plain.vertices - faces[0][tip]).norm(dim=1).argmin())
    moved, wanted = other.vertices[near] - plain.vertices[near], faces[1][tip] - faces[0][tip]
    assert float(wanted.norm()) > 0.002 and float((moved - wanted).norm()) < 0.3 * float(wanted.norm())


def test_hair_pushes_the_scalp_and_grows_without_a_wall() -> None:
    camera = square_camera(fit(), SQUARE)
    bald, hairy = (proxy_maps(proxy(hair_px=px), camera).covered for px in (0.0, 40.0))
    top_of = [int(np.flatnonzero(covered[:, 48].numpy()).min()) for covered in (bald, hairy)]
    assert top_of[1] < top_of[0] - 3 and top_of[1] >= 40 - 40 - 1
    assert torch.equal(bald[80:, 48], hairy[80:, 48])
    # Between neighbouring vertices its share grows by a third at most.
    person = module._mean_person()
    ends = person.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert (person.hair[ends[:, 0]] - person.hair[ends[:, 1]]).abs().max() < 0.34
    assert person.hair.max() > 0.99


@pytest.mark.parametrize("hair_px", [0.0, 36.0])
def test_no_step_in_depth_stands_between_a_face_and_its_ears_and_temples(hair_px: float) -> None:
    """Seen from the front at 1 m, a millimetre a pixel; an ear stands some 20 mm off the head."""
    head, camera = proxy(hair_px=hair_px), Camera(1000.0, 300, 200, 150.0, 100.0)
    outside = head.triangles[front_facing(head.vertices, head.triangles)]
    depth_m = rasterize(head.vertices, outside, camera).depth_m.numpy()
    for row in depth_m[100 - np.arange(-10, 70, 5)]:  # from the ears' lobes to the temples
        assert 1000 * np.abs(np.diff(row[np.isfinite(row)])).max() < 25


def test_heads_cast_shadows() -> None:
    camera = square_camera(fit(), SQUARE)
    lights = torch.stack([azel_to_direction(*at) for at in ((80.0, 0.0), (0.0, 0.0), (0.0, 75.0))])
    maps = proxy_maps(proxy(), camera)
    visible = Shadows(proxy(), maps).along(lights)
    assert visible.shape == (3, SIDE, SIDE) and visible.min() >= 0 and visible.max() <= 1
    face = (maps.covered > 0) & (torch.arange(SIDE)[:, None] > 36) & (torch.arange(SIDE)[:, None] < 60)
    left = face & (torch.arange(SIDE) < 44) & (torch.arange(SIDE) > 34)
    right = face & (torch.arange(SIDE) > 52) & (torch.arange(SIDE) < 62)
    assert visible[0][right].mean() > 0.8 and visible[0][left].mean() < 0.3
    assert visible[1][face].mean() > 0.9
    neck = slice(66, 72), slice(44, 52)
    assert visible[2][neck].mean() < 0.3 < visible[1][neck].mean()


def test_shadows_of_points_are_cast_toward_their_places() -> None:
    """A point far away is a far light; what stands behind a point casts no shadow."""
    maps = proxy_maps(proxy(), square_camera(fit(), SQUARE))
    shadows = Shadows(proxy(), maps)
    lights = torch.stack([azel_to_direction(*at) for at in ((80.0, 0.0), (0.0, 75.0))])
    far, along = shadows.toward(3000 * lights), shadows.along(lights)
    torch.testing.assert_close(far, along, atol=0.5, rtol=0)
    assert (far - along).abs().mean() < 2e-3  # grazing rays
    before, behind = shadows.toward(torch.tensor([[0.0, 0.0, -0.6], [0.0, 0.0, -1.6]]))
    face = slice(40, 56), slice(42, 54)
    assert before[face].mean() > 0.9 and behind[face].mean() < 0.01
    neck, above = maps.positions_m[:, 72, 48], azel_to_direction(0.0, 60.0)
    below_chin, over_head = shadows.toward(torch.stack([neck + 0.02 * above, neck + 0.5 * above]))[:, 72, 48]
    assert below_chin > 0.9 and over_head < 0.1  # the chin is behind the first


def test_rays_of_a_pixel_are_those_of_the_frame_before() -> None:
    """Hair that grows covers more pixels; the numbers of the others stay, or their shadows would flicker."""
    camera = square_camera(fit(), SQUARE)
    numbers = []
    for hair_px in (20.0, 34.0):
        maps = proxy_maps(proxy(hair_px=hair_px), camera)
        shadows = Shadows(proxy(hair_px=hair_px), maps)
        placed = np.full((*shadows.numbers.shape[:2], SIDE, SIDE), np.nan)
        placed[:, :, maps.covered.numpy() > 0] = shadows.numbers[..., 0]
        numbers.append(placed)
    both = np.isfinite(numbers[0]) & np.isfinite(numbers[1])
    assert np.isfinite(numbers[1]).sum() > np.isfinite(numbers[0]).sum()
    np.testing.assert_array_equal(numbers[0][both], numbers[1][both])


BALL_PX = 64
RIG = rig_directions(48)


def ball() -> tuple[Tensor, Tensor, Tensor]:
    """Normals [3, S, S] and classes [C, S, S] of a ball of skin, and the visibility [L, s, s] of the rig."""
    at = (torch.arange(BALL_PX) + 0.5) * 2 / BALL_PX - 1
    y, x = torch.meshgrid(-at, at, indexing="ij")
    inside = x**2 + y**2 < 0.9
    normals = F.normalize(torch.stack([x, y, (1 - x**2 - y**2).clamp_min(0.02).sqrt()]), dim=0)
    classes = torch.zeros(14, BALL_PX, BALL_PX)
    classes[SKIN] = inside.float()
    return normals, classes, torch.ones(len(RIG), BALL_PX // 2, BALL_PX // 2)


@pytest.mark.parametrize("light", [8, 18, 29])
def test_a_key_light_is_found(light: int) -> None:
    normals, classes, visible = ball()
    cosine = torch.einsum("c,cij->ij", RIG[light], normals).clamp_min(0)
    image = 0.4 * cosine.expand(3, -1, -1) * torch.tensor([1.0, 0.7, 0.5]).view(3, 1, 1)
    shading = own_shading(image, classes, normals, RIG, visible, 3.0)
    skin = classes[SKIN] > 0
    wanted = cosine / cosine[skin].mean()
    assert shading.shape == (1, BALL_PX, BALL_PX)
    assert float(shading[0][skin].mean()) == pytest.approx(1, rel=1e-4)
    assert float((shading[0] - wanted)[skin].abs().mean()) < 0.12
    brighter = own_shading(7 * image, classes, normals, RIG, visible, 3.0)
    torch.testing.assert_close(brighter, shading, rtol=1e-3, atol=1e-3)


def test_shadows_of_the_proxy_are_in_it() -> None:
    normals, classes, visible = ball()
    light = int((RIG @ torch.tensor([0.0, 0.3, 0.95])).argmax())
    band = slice(BALL_PX * 3 // 8, BALL_PX * 5 // 8)  # no unshadowed lights shade a ball so
    visible[light, BALL_PX * 3 // 16 : BALL_PX * 5 // 16] = 0
    cosine = torch.einsum("c,cij->ij", RIG[light], normals).clamp_min(0)
    cosine[band] *= 0.02
    shading = own_shading(cosine.expand(3, -1, -1), classes, normals, RIG, visible, 3.0)[0]
    middle = shading[:, BALL_PX * 3 // 8 : BALL_PX * 5 // 8]
    assert middle[band].mean() < 0.4 * middle[BALL_PX // 4 : BALL_PX * 3 // 8].mean()


def test_in_a_wide_square_a_small_face_is_enough_and_without_skin_nothing_is_guessed() -> None:
    normals, classes, visible = ball()
    classes[SKIN] *= normals[2] > 0.993
    image = torch.einsum("c,cij->ij", RIG[8], normals).clamp_min(0).expand(3, -1, -1)
    near, wide = (own_shading(image, classes, normals, RIG, visible, sides) for sides in (3.0, 6.0))
    assert near.std() == 0 and wide.std() > 0.1
    normals, classes, visible = ball()
    shading = own_shading(torch.rand(3, BALL_PX, BALL_PX), 0 * classes, normals, RIG, visible, 3.0)
    torch.testing.assert_close(shading, torch.ones(1, BALL_PX, BALL_PX))
