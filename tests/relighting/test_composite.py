"""Composites on synthetic full frames: a Lambertian face of the built-in model before a noisy background."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles, grid_uv, region_mask
from facerf_cli.face.view import FaceView, photo_camera, view_face
from facerf_cli.image.strips import Window
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import azel_to_direction, latlong_directions, rig_directions
from facerf_cli.raster.camera import Camera, pose_to_rotation, project
from facerf_cli.raster.texture import inpaint, normal_map, unwrap
from facerf_cli.relighting.detail import FaceDetail
from facerf_cli.relighting.face_alone import FaceAlone, FaceInPhoto
from facerf_cli.relighting.people_in_photo import Background, PeopleInPhoto
from facerf_cli.relighting.relightable import Relit, RenderRequest
from tests.textured import render_texture

HEIGHT_PX, WIDTH_PX, TEXTURE = 330, 420, 256
CROP = Crop(105.3, 60.7, 219.0, 160)
RIG = rig_directions()
ROTATION, TRANSLATION_M = pose_to_rotation(14, 4, -3), torch.tensor([0.0, 0.01, -1.25])


@dataclass(frozen=True, eq=False)
class Scene:
    """A face's mesh and true OLAT textures, and the background behind it."""

    vertices: Tensor
    olats: Tensor  # [L, 3, T, T]
    background: np.ndarray

    def image(self, envmap: Tensor) -> np.ndarray:
        camera = photo_camera(CROP, HEIGHT_PX, WIDTH_PX)
        face, alpha = render_texture(self.lit(envmap), self.vertices, grid_triangles(), grid_uv(), camera)
        return np.where(alpha.numpy()[..., None] > 0, face.numpy(), self.background)

    def lit(self, envmap: Tensor) -> Tensor:
        return torch.einsum("lc,lcij->cij", envmap_weights(envmap, RIG), self.olats)


@cache
def scene() -> Scene:
    noise = torch.Generator().manual_seed(0)
    model = load_face_model("builtin")
    vertices = model.mean @ ROTATION.T + TRANSLATION_M
    coarse = 0.5 + 0.15 * torch.randn(1, 3, 48, 48, generator=noise)
    pores = 1 + 0.06 * torch.randn(1, 1, TEXTURE, TEXTURE, generator=noise)
    albedo = torch.nn.functional.interpolate(coarse, (TEXTURE, TEXTURE), mode="bilinear") * pores
    cosine = torch.einsum("lc,cij->lij", RIG, normal_map(vertices, grid_triangles(), TEXTURE)).clamp(min=0)
    background = torch.rand(HEIGHT_PX, WIDTH_PX, 3, generator=noise).numpy()
    return Scene(vertices, cosine[:, None] * albedo[0].clamp(0.05, 1), background)


def sky(azimuth_deg: float, sharpness: float, rgb: tuple[float, float, float]) -> Tensor:
    """A map whose light comes mostly from one side."""
    toward = latlong_directions(32, 64) @ azel_to_direction(azimuth_deg, 25.0)
    return (0.15 + 2 * toward.clamp(min=0) ** sharpness)[..., None] * torch.tensor(rgb)


OWN = sky(-30, 2, (1.0, 0.9, 0.8))
OTHER = sky(60, 4, (0.7, 0.9, 1.3))


@cache
def unwrapped() -> tuple[np.ndarray, Tensor, Tensor]:
    """The photo, its source texture and what of it was seen."""
    photo = scene().image(OWN)
    crop = torch.from_numpy(CROP.apply(photo)).permute(2, 0, 1).contiguous()
    texture, seen = unwrap(crop, scene().vertices, grid_triangles(), CROP.camera, TEXTURE)
    return photo, inpaint(texture, seen), seen


def view() -> FaceView:
    return view_face(scene().vertices, photo_camera(CROP, HEIGHT_PX, WIDTH_PX), CROP.side_px)


def in_photo(
    photo: np.ndarray, source: Tensor, seen: Tensor, matte: np.ndarray | None = None, crop: Crop = CROP
) -> FaceInPhoto:
    """The scene's face in a photo, whose textures are given."""
    model, size_px = load_face_model("builtin"), (photo.shape[0], photo.shape[1])
    shape = 0 * model.identity[:, 0, 0], 0 * model.expression[:, 0, 0]
    fit = FaceFit(model.name, crop, ROTATION, TRANSLATION_M, *shape, torch.zeros(1), 0.0)
    head = Head(photo, fit, FaceTexture(source, seen, source))
    whole = np.ones(size_px, np.float32) if matte is None else matte
    return FaceInPhoto(FaceAlone(model, head, photo_px=size_px), photo, whole)


def compose(
    photo: np.ndarray,
    source: Tensor,
    relit: Tensor,
    seen: Tensor,
    matte: np.ndarray | None = None,
    crop: Crop = CROP,
) -> np.ndarray:
    """The photo with the scene's face relit."""
    return PeopleInPhoto([in_photo(photo, source, seen, matte, crop)]).image([Relit(relit)])


def detailed(face: FaceTexture, screen: FaceView, photo: np.ndarray, texture: Tensor) -> np.ndarray:
    """The pixels of a photo of a whole screen under a relit texture."""
    detail = FaceDetail(face, screen)
    return detail.over(screen.window, photo)(detail.precompute(texture))


def psnr_db(result: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Over the pixels inside, with the truth's maximum there as the peak."""
    error = ((result - truth)[mask] ** 2).mean()
    return float(10 * np.log10(truth[mask].max() ** 2 / error))


def share() -> np.ndarray:
    """The face's mask [H, W] in the photo."""
    return view().full(view().mask)


def inside_face() -> np.ndarray:
    return share() > 0.99


def test_own_light_gives_the_photo_back_and_eyes_keep_their_detail() -> None:
    photo, source, seen = unwrapped()
    result = compose(photo, source, scene().lit(OWN), seen)
    assert psnr_db(result, photo, inside_face()) > 30
    result = compose(photo, source, source, seen)
    assert psnr_db(result, photo, inside_face()) > 30  # bright noise counts as glare
    result = compose(photo, source, scene().lit(OTHER), seen)
    truth = scene().image(OTHER)
    drawn = view().full(view().render(scene().lit(OTHER)))
    assert psnr_db(result, truth, inside_face()) > 28
    assert psnr_db(photo, truth, inside_face()) < 15  # or the test says nothing
    assert np.isfinite(drawn).all()
    source = torch.full((3, 128, 128), 0.4)
    eyes = region_mask("eyes", 128) > 0.99
    source[:, eyes] = torch.rand(int(eyes.sum()), generator=torch.Generator().manual_seed(1))
    face, screen, photo = flat_face(source)
    relit = detailed(face, screen, photo, torch.full((3, 128, 128), 0.2))
    np.testing.assert_allclose(relit[eyes], 0.5 * photo[eyes], rtol=0.02, atol=1e-3)


HALF = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)  # whose right part is the person
HALF[:, 200:] = 1


def in_half(
    background: Background, ev: float, behind: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The image with its right half cut out as the person, and its alpha."""
    people = PeopleInPhoto([in_photo(*unwrapped(), HALF)], background)
    request = RenderRequest([Relit(scene().lit(OTHER))], ev=ev, background=behind)
    return people.rendered(request)["rgb"], people.alpha(behind)


def test_what_is_not_the_face_stays_the_photo_and_a_matte_says_what_may_change() -> None:
    """The face over black is in all images; the photo, or another image, shows by the rest of its share."""
    photo, _, _ = unwrapped()
    face = share() * HALF
    of_face, rest = face[..., None], 1 - face[..., None]
    people = PeopleInPhoto([in_photo(*unwrapped(), HALF)])
    lit = people.light_layer([Relit(scene().lit(OTHER))])
    assert (face > 0.99).any() and abs(lit - of_face * photo)[face > 0.99].mean() > 0.1
    for ev in (0.0, 2.0):
        image, alpha = in_half("photo", ev)
        assert alpha is None
        np.testing.assert_allclose(image, lit + rest * photo * 2**-ev, atol=1e-5)
        np.testing.assert_allclose((image * 2**ev)[face == 0], photo[face == 0], rtol=1e-6)
    nothing, alpha = in_half("none", 0.0)
    assert alpha is not None
    np.testing.assert_array_equal(alpha, face)
    np.testing.assert_allclose(nothing * of_face, lit, atol=1e-5)
    behind = np.full((HEIGHT_PX, WIDTH_PX, 3), 0.3, np.float32)
    given, alpha = in_half("given", 3.0, behind)
    assert alpha is None
    np.testing.assert_allclose(given, lit + rest * behind, atol=1e-5)


def flat_face(source: Tensor) -> tuple[FaceTexture, FaceView, np.ndarray]:
    """A texture [3, T, T], seen whole, the view of a screen that shows it, and what it shows."""
    side = source.shape[-1]
    centres = (torch.arange(side) + 0.5) / side
    uv = torch.stack(torch.meshgrid(centres, centres, indexing="xy"), -1)
    whole = torch.ones(side, side)
    camera = Camera(1.0, side, side, side / 2, side / 2)
    window = Window(slice(0, side), slice(0, side))
    screen = FaceView((side, side), window, uv, whole, whole, torch.zeros(1, 3), camera)
    return FaceTexture(source, whole, source), screen, screen.render(source).numpy()


def test_a_dark_source_is_rendered_and_not_multiplied() -> None:
    source = torch.full((3, 32, 32), 0.4)
    source[:, 16:19, 22:25] = 1e-6  # a cheek's
    face, screen, shown = flat_face(source)
    photo = shown + np.float32(1e-3)  # noise of the photo over the texture
    relit = detailed(face, screen, photo, torch.full((3, 32, 32), 0.3))
    np.testing.assert_allclose(relit, 0.3, rtol=0.3)  # the quotient would be 300; factors are limited
    source = torch.full((3, 32, 32), 0.4)
    source[:, 16:19, 22:25] = torch.tensor([0.02, 0.016, 0.012])[:, None, None]  # hair on a cheek
    face, screen, shown = flat_face(source)
    photo = shown.copy()
    photo[17, 23] = 0.02, 0.013, 0.0  # a camera's black in one channel
    relit = detailed(face, screen, photo, torch.full((3, 32, 32), 0.4))[17, 23]
    assert relit[2] > 0.4 * relit[0]  # the quotient would be yellow: 0


def test_own_light_returns_the_photo_and_light_is_never_negative() -> None:
    """Fine contrast of 5 % around skin of one colour."""
    noise = torch.Generator().manual_seed(2)
    skin = torch.tensor([0.6, 0.4, 0.3])[:, None, None]
    face, screen, shown = flat_face(skin * (0.6 + 0.4 * torch.rand(1, 48, 48, generator=noise)))
    photo = (shown * np.random.default_rng(0).normal(1, 0.05, shown.shape)).astype(np.float32)
    np.testing.assert_allclose(detailed(face, screen, photo, face.texture), photo, rtol=0.04)
    one_sided = face.texture * (torch.arange(48) > 24)
    assert detailed(face, screen, photo, one_sided).min() >= 0


def test_the_mask_lies_on_the_face_that_both_cameras_see() -> None:
    mask = share()
    covered = view().full(view().coverage) > 0
    assert (mask[~covered] == 0).all()
    steps = np.hypot(*np.gradient(mask))
    assert np.percentile(steps[mask > 0], 99.9) < 0.3 and steps.max() < 0.5
    camera = photo_camera(CROP, HEIGHT_PX, WIDTH_PX)
    in_crop = project(scene().vertices, CROP.camera).numpy()
    np.testing.assert_allclose(project(scene().vertices, camera).numpy(), CROP.to_photo(in_crop), atol=1e-2)
    crop = Crop(-100.0, -60.0, 219.0, 160)
    photo = np.full((120, 90, 3), 0.5, np.float32)
    _, source, seen = unwrapped()
    assert np.isfinite(compose(photo, source, scene().lit(OTHER), seen, crop=crop)).all()
