import warnings

import numpy as np
import pytest
import torch

from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.image.colour import ita_deg, lab_d65
from facerf_cli.image.skin import WAVELENGTHS_NM, observer_weights, skin_albedo, skin_reflectance
from facerf_cli.raster.texture import sample_texture
from facerf_cli.synth.appearance.people import RANDOM_TEXTURES, People, draw_people, hair_albedo
from facerf_cli.synth.appearance.skin import bare_skin, draw_skin, paint_skin
from facerf_cli.synth.random_fields import CANVAS_SPAN, Window, blurred, inside, mask, noise, slopes, splat

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # colour-science warns about missing optional packages
    import colour as oracle

CLASSES_DEG = (-90, -30, 10, 28, 41, 55, 90)  # Chardon: dark, brown, tan, intermediate, light, very light


def generator(seed: int = 3) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def grid_of_pigments() -> tuple[np.ndarray, np.ndarray]:
    melanin, blood = np.meshgrid(np.geomspace(0.005, 0.4, 12), np.geomspace(0.003, 0.1, 8), indexing="ij")
    return melanin, blood


def colours(melanin: np.ndarray, blood: np.ndarray) -> np.ndarray:
    fields = [torch.from_numpy(x).float()[None, None] for x in (melanin, blood)]
    return skin_albedo(*fields)[0].permute(1, 2, 0).double().numpy()


def test_colours_are_those_that_colour_science_integrates() -> None:
    shape = oracle.SpectralShape(400, 720, 10)
    table = oracle.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    weights = table.values * oracle.SDS_ILLUMINANTS["D65"].copy().align(shape).values[:, None]
    white = np.array([0.95046, 1.0, 1.08906])
    assert np.allclose(observer_weights(), weights / weights.sum(0) * white, atol=1e-5)
    melanin, blood = grid_of_pigments()
    for index in np.ndindex(3, 2):
        m, b = melanin[::4][index[0], ::5][index[1]], blood[::4][index[0], ::5][index[1]]
        spectrum = oracle.SpectralDistribution(skin_reflectance(m, b), WAVELENGTHS_NM)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it interpolates the spectrum
            xyz = oracle.sd_to_XYZ(spectrum, illuminant=oracle.SDS_ILLUMINANTS["D65"]) / 100
        rgb = oracle.XYZ_to_RGB(xyz, oracle.RGB_COLOURSPACES["sRGB"])
        ours = colours(np.array([[m]]), np.array([[b]]))[0, 0]
        assert np.abs(ours - rgb).max() < 0.004
        lab = oracle.XYZ_to_Lab(xyz, oracle.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"])
        assert np.abs(lab_d65(rgb) - lab).max() < 0.15


def test_melanin_darkens_and_blood_reddens_with_its_two_bands() -> None:
    melanin, blood = grid_of_pigments()
    found = colours(melanin, blood)
    assert (np.diff(found, axis=0) < 0).all()
    assert (np.diff(found[:9], axis=1) < 0).all()  # in the darkest skins blood is hardly visible
    red_over_green = found[..., 0] / found[..., 1]
    assert (np.diff(red_over_green[:9], axis=1) > 0).all()
    reflectance = skin_reflectance(melanin, blood)
    assert reflectance.min() > 0 and reflectance.max() < 1
    pale = skin_reflectance(np.array(0.01), np.array(0.02))
    at = {int(nm): value for nm, value in zip(WAVELENGTHS_NM, pale, strict=True)}
    assert at[540] < at[560] > at[580] and at[580] < at[600] < at[650]


def test_drawn_skins_are_of_all_classes_and_hair_from_black_to_grey() -> None:
    found = bare_skin(draw_people(400, generator())).double().numpy()
    angles = ita_deg(found)
    assert angles.max() > 55 and angles.min() < -30
    shares = np.histogram(angles, CLASSES_DEG)[0] / len(angles)
    assert (shares > 0.04).all() and shares.max() < 0.4
    lab = lab_d65(found)
    assert np.percentile(lab[:, 1], 2) > 4 and np.percentile(lab[:, 1], 98) < 20
    assert np.percentile(lab[:, 2], 2) > 8 and np.percentile(lab[:, 2], 98) < 25
    black, brown, blond = hair_albedo(torch.tensor([8.0, 1.3, 0.3]), torch.zeros(3), torch.zeros(3)).mean(-1)
    assert black < brown < blond and black < 0.02 and blond > 0.05
    red = hair_albedo(torch.tensor([0.3]), torch.tensor([1.5]), torch.zeros(1))[0]
    assert red[0] > 2 * red[2]
    grey = hair_albedo(torch.tensor([8.0]), torch.zeros(1), torch.ones(1))[0]
    assert grey.min() > 0.3


def test_canvas_noise_and_splats_keep_their_measures() -> None:
    uv_map, canvas = Window(64), Window(128, CANVAS_SPAN)
    for name in ("eyes", "lips", "nostrils", "neck"):
        inner = inside(canvas, name)[..., 32:96, 32:96]
        assert (inner - inside(uv_map, name)).abs().max() < 2.5
        assert torch.allclose(mask(canvas, name, 3.0), mask(canvas, name, 3.0).flip(-1), atol=1e-5)
    for span, side in (((0.0, 1.0), 128), (CANVAS_SPAN, 512)):
        field = noise(4, Window(side, span), 20.0, generator(), octaves=1)
        assert 0.7 < field.std() < 1.3
        step = slopes(field, Window(side, span)).std()
        assert 0.05 < step < 0.15  # per millimetre: one bump in twenty
    window = Window(64)
    places = torch.rand(100, 2, generator=generator()) * torch.tensor([100.0, 80.0]) + torch.tensor([-50, 40])
    layers = splat(window, places, torch.full((100,), 2.0))
    texel = window.texel_mm[0] * window.texel_mm[1]
    assert float(layers.sum()) * texel == pytest.approx(200, rel=1e-5)
    assert float(blurred(layers, window, 3.0).sum()) == pytest.approx(float(layers.sum()), rel=1e-3)
    two = splat(window, places, torch.ones(100), torch.arange(100) // 50, 2)
    assert torch.allclose(two[0], splat(window, places[:50], torch.ones(50))[0])


def picked(people: People, index: int, count: int = 1) -> People:
    return People(*(value[index : index + count] for value in vars(people).values()))


def altered(people: People, **values: float) -> People:
    return People(**(vars(people) | {k: torch.full_like(people.age, v) for k, v in values.items()}))


def at_landmark(texture: torch.Tensor, index: int, shift: tuple[float, float] = (0, 0)) -> torch.Tensor:
    uv = torch.tensor(LANDMARK_UV[index], dtype=torch.float32) + torch.tensor(shift)
    return sample_texture(texture, uv.view(1, 1, 2))[0, 0]


PLAIN = {"stubble_mm": 0, "freckles": 0, "moles": 0, "lipstick": 0, "eye_shadow": 0, "eyeliner": 0, "age": 25}
PLAIN |= {"random_texture": 0, "foundation": 0, "melanin": 0.015, "haemoglobin": 0.012, "hair_eumelanin": 6}


def painted(**values: float) -> torch.Tensor:
    person = altered(picked(draw_people(1, generator()), 0), **(PLAIN | values))
    return paint_skin(person, Window(192), generator(8), painted_eyes=False).albedo[0]


def test_features_lie_where_the_face_has_them() -> None:
    bare = painted()
    cheek = at_landmark(bare, 30, (-0.2, 0.02))
    brow = sample_texture(bare, torch.tensor([[[0.36, 0.18]]])).mean()
    assert brow < 0.6 * cheek.mean()
    lip = at_landmark(bare, 57, (0, -0.02))
    assert lip[0] / lip[1] > 1.15 * cheek[0] / cheek[1]
    nose = at_landmark(bare, 30)
    forehead = at_landmark(bare, 27, (0, -0.2))
    assert nose[0] / nose[1] > forehead[0] / forehead[1]
    chin = slice(165, 178), slice(85, 107)
    shadowed = painted(stubble_mm=1.0)[:, *chin].mean()
    bearded = painted(stubble_mm=1.0, beard=1.0, goatee=0)[:, *chin].mean()
    assert bearded < 0.5 * shadowed < 0.5 * 0.95 * bare[:, *chin].mean()
    worn = painted(lipstick=1.0, lipstick_red=0.3, lipstick_green=0.02, lipstick_blue=0.03)
    assert at_landmark(worn, 57, (0, -0.02))[1] < 0.6 * lip[1]


def test_freckles_appear_with_their_parameters_and_dark_skin_shines_alike() -> None:
    assert painted(freckles=1.0).std((1, 2)).mean() > 1.05 * painted().std((1, 2)).mean()
    person = picked(draw_people(1, generator()), 0)
    young, old = (
        paint_skin(altered(person, **(PLAIN | {"age": years})), Window(192), generator(8), False).relief
        for years in (25, 72)
    )
    assert old[..., 20:60, 40:150].std() > 1.3 * young[..., 20:60, 40:150].std()  # the forehead
    pale, dark = (
        paint_skin(altered(person, **(PLAIN | {"melanin": melanin})), Window(64), generator(8), True)
        for melanin in (0.01, 0.2)
    )
    assert torch.equal(pale.specular, dark.specular) and torch.equal(pale.roughness, dark.roughness)
    assert dark.albedo.mean() < 0.3 * pale.albedo.mean()


def test_maps_are_physical_and_repeat_with_their_seed() -> None:
    first, second = (draw_skin(24, 64, generator(5)) for _ in "ab")
    for name in ("albedo", "specular", "roughness", "relief", "scattering_texels"):
        field = getattr(first, name)
        assert torch.equal(field, getattr(second, name)) and torch.isfinite(field).all()
    assert first.albedo.min() > 0 and first.albedo.max() < 1
    assert first.specular.min() > 0 and first.specular.max() < 0.1
    assert first.roughness.min() > 0.1 and first.roughness.max() < 0.9
    assert first.relief.abs().max() <= 0.8
    red, green, blue = first.scattering_texels.T
    assert (red > green).all() and (green > blue).all()


def test_people_are_drawn_by_seed_and_a_share_wears_random_colours() -> None:
    assert 0.05 <= RANDOM_TEXTURES <= 0.07
    people = draw_people(4000, generator())
    assert 0.045 < people.random_texture.mean() < 0.075
    odd = painted(random_texture=1)
    usual = painted()
    spread = [np.ptp(np.arctan2(*lab_d65(x.permute(1, 2, 0).numpy())[..., 1:].reshape(-1, 2).T)) for x in
              (odd[:, 20:60, 40:150], usual[:, 60:80, 40:60])]  # fmt: skip
    assert spread[0] > 2 * spread[1]
    # A change here means that every shipped network is to be trained again.
    people, skin = draw_people(4, generator()), draw_skin(2, 32, generator())
    assert people.melanin.tolist() == pytest.approx([0.00761, 0.010765, 0.019953, 0.008225], rel=1e-4)
    assert people.hair_eumelanin.tolist() == pytest.approx([0.362061, 2.488394, 0.554631, 2.675644], rel=1e-4)
    colours = [[0.3284, 0.2460, 0.2854], [0.4218, 0.3191, 0.2125]]
    assert np.allclose(skin.albedo.mean((2, 3)).numpy(), colours, atol=1e-4)
