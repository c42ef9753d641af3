import pytest
import torch

from facerf_cli.synth.appearance.materials import (
    Appearance,
    canvas_uv,
    draw_appearance,
    sample,
    with_short_hair,
)
from facerf_cli.synth.head.mesh import PARTS

SIDE = 128


@pytest.fixture(scope="module")
def people() -> list[Appearance]:
    generator = torch.Generator().manual_seed(1)
    return [draw_appearance(SIDE, generator) for _ in range(12)]


def test_every_part_has_physical_textures(people: list[Appearance]) -> None:
    for person in people:
        assert set(person.materials) == set(PARTS)
        assert person.materials["skin"].albedo.shape == (3, SIDE, SIDE)
        for name, material in person.materials.items():
            size = material.albedo.shape[1:]
            assert material.albedo.shape == (3, *size) and material.specular.shape == (1, *size)
            assert material.roughness.shape == (1, *size) and material.relief.shape == (2, *size)
            for field in (material.albedo, material.specular, material.roughness, material.relief):
                assert torch.isfinite(field).all() and field.dtype == torch.float32
            assert material.albedo.min() > 0 and material.albedo.max() < 1
            assert material.specular.min() > 0 and material.specular.max() < (0.1 if name != "frame" else 1)
            assert material.roughness.min() >= 0.07 and material.roughness.max() <= 0.9


def test_people_are_drawn_by_seed_with_named_traits(people: list[Appearance]) -> None:
    generator = torch.Generator().manual_seed(1)
    again = draw_appearance(SIDE, generator)
    assert again.traits == people[0].traits
    assert torch.equal(again.materials["skin"].albedo, people[0].materials["skin"].albedo)
    assert people[1].traits != people[0].traits
    wanted = {"melanin", "haemoglobin", "oiliness", "ita_deg", "age", "hair_colour", "stubble_mm", "freckles"}
    for person in people:
        assert wanted < set(person.traits)
        assert all(isinstance(value, (float, str, bool)) for value in person.traits.values())
    by_melanin = sorted(people, key=lambda person: float(person.traits["melanin"]))
    assert float(by_melanin[0].traits["ita_deg"]) > float(by_melanin[-1].traits["ita_deg"])
    red, green, blue = people[0].scattering_mm
    assert red > green > blue > 0.1


def test_the_side_changes_the_resolution_and_not_the_person() -> None:
    for seed in range(3):
        coarse, fine = (draw_appearance(side, torch.Generator().manual_seed(seed)) for side in (96, 192))
        assert coarse.traits == fine.traits
        assert torch.equal(coarse.materials["eye"].albedo, fine.materials["eye"].albedo)
        if not coarse.traits["random_texture"]:
            means = [person.materials["skin"].albedo.mean((1, 2)) for person in (coarse, fine)]
            assert torch.allclose(*means, rtol=0.1)


def test_samples_are_bilinear_in_the_parts_own_textures(people: list[Appearance]) -> None:
    person = people[0]
    skin, eye = person.materials["skin"], person.materials["eye"]
    row, column = 70, 41
    uv = canvas_uv(SIDE)
    between = (uv[row, column] + uv[row, column + 1]) / 2
    points = torch.stack([uv[row, column], between, torch.tensor([-3.0, -3.0]), torch.tensor([0.5, 0.5])])
    part = torch.tensor([0, 0, 0, PARTS.index("eye")], dtype=torch.uint8)
    found = sample(person, part, points)
    assert torch.allclose(found.albedo[0], skin.albedo[:, row, column], atol=1e-4)
    assert torch.allclose(found.albedo[1], skin.albedo[:, row, column : column + 2].mean(-1), atol=1e-4)
    assert torch.allclose(found.albedo[2], skin.albedo[:, 0, 0], atol=1e-4)  # clamped at the border
    assert torch.allclose(found.relief[0], skin.relief[:, row, column], atol=1e-4)
    assert found.albedo[3].max() < 0.02  # the pupil
    assert found.specular[3] == pytest.approx(float(eye.specular[0, 0, 0]))
    assert found.roughness.shape == (4,) and found.relief.shape == (4, 2)


def test_eyes_and_hair_have_their_colours(people: list[Appearance]) -> None:
    for person in people:
        albedo = person.materials["eye"].albedo.mean(0)
        side = albedo.shape[-1]
        out = ((canvas_uv(side) + 0.5) / 2 - 0.5).norm(dim=-1) * 180  # degrees from the gaze axis
        pupil, iris = albedo[out < 6].mean(), albedo[(out > 14) & (out < 23)].mean()
        limbus, sclera = albedo[(out > 27) & (out < 28.5)].mean(), albedo[(out > 32) & (out < 50)].mean()
        assert pupil < iris < sclera and limbus < sclera
        assert pupil < 0.02 and 0.3 < sclera < 0.6
    generator = torch.Generator().manual_seed(2)
    tips, irises = [], []
    for _ in range(24):
        person = draw_appearance(16, generator)
        hair = person.materials["hair"].albedo.mean((0, 2))
        if float(person.traits["grey"]) < 0.3 and person.traits["hair_colour"] != "black":
            tips.append(float(hair[-4:].mean() / hair[:4].mean()))
        if float(person.traits["melanin"]) > 0.035:
            irises.append(person.traits["iris"])
    assert len(tips) > 3 and min(tips) > 1
    assert irises and set(irises) == {"brown"}


def test_scalps_are_stained_and_many_points_sampled_at_once(people: list[Appearance]) -> None:
    person = next(p for p in people if p.traits["hair_colour"] == "black")
    cover = (canvas_uv(SIDE)[..., 1] < 0).float()
    stained = with_short_hair(person, cover, torch.Generator().manual_seed(0)).materials["skin"]
    bare = person.materials["skin"]
    assert stained.albedo[:, : SIDE // 4].mean() < 0.5 * bare.albedo[:, : SIDE // 4].mean()
    assert torch.equal(stained.albedo[:, SIDE // 4 :], bare.albedo[:, SIDE // 4 :])
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(200_000, 2, generator=generator)
    part = torch.randint(len(PARTS), (200_000,), generator=generator, dtype=torch.uint8)
    together, first = sample(people[0], part, uv), sample(people[0], part[:100], uv[:100])
    torch.testing.assert_close(together.albedo[:100], first.albedo)
