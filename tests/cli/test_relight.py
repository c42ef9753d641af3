"""`facerf relight` from the command line, with a network that is Lambert's law until it is trained."""

import re
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import read_olat_header, write_olat_stack
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.main import main
from facerf_cli.option import attributes_of
from facerf_cli.relighting.face_alone import FACE_LAYERS, FaceAlone
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.people_in_photo import PERSON_LAYERS, PeopleInPhoto
from facerf_cli.relighting.relightable import Relightable
from facerf_cli.synth.sky.skies import kind_of
from facerf_cli.work.relight_options import RelightOptions, parse_aov
from tests.astronaut import PATH as PHOTO
from tests.cli.lines import face_sides, relight
from tests.exr_layers import exr_layers
from tests.folders import only_row
from tests.kinds import Patch, Said
from tests.refusals import refused
from tests.stacks import header_of


def made(output: Path) -> list[str]:
    return sorted(path.name for path in output.rglob("*") if path.suffix in (".exr", ".png"))


@pytest.mark.slow
def test_maps_rotations_and_lamps_from_one_prediction(
    given: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    predicted = []
    olats = Field.olats
    monkeypatch.setattr(
        Field,
        "olats",
        lambda self, *given: predicted.append(self.quotient is not None) or olats(self, *given),
    )
    line = ["--envmap", str(given / "maps"), "--rotate", "0:360:2", "--light", "40,10;-40,0,0.5"]
    assert relight(given, tmp_path, *line) == 0
    assert predicted.count(True) == 1 and predicted[-1]  # for all setups, after the photo's own light
    names = [f"astronaut_{name}.{n}" for name in ("grey", "right.0007") for n in ("0000", "0001")]
    names.append("astronaut_light_40_10+-40_0_0.5")
    images = sorted(name + suffix for name in names for suffix in (".exr", ".png"))
    assert [name for name in made(tmp_path) if name.startswith("astronaut")] == images
    row = only_row(tmp_path)
    assert row["status"] == "done" and row["quality"] == "good" and len(row["exposure_ev"]) == 5
    assert row["exposure_ev"][names[0]] == row["exposure_ev"][names[1]]  # a turning sky does not pump
    written = capsys.readouterr().out.splitlines()
    assert len(written) == 10 and all(Path(path).is_file() for path in written)
    predicted.clear()
    assert relight(given, tmp_path, *line) == 0
    assert not predicted  # finished already


def test_frames_that_do_not_fit_the_memory_at_once_share_their_exposure(
    given: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr("facerf_cli.run.memory._RELIT_HELD", 1 << 30)  # so that one frame fits
    line = ["--envmap", str(given / "maps/right.0007.exr"), "--rotate", "0:360:3", "--composite", "face"]
    assert relight(given, tmp_path, *line) == 0
    row = only_row(tmp_path)
    assert len(row["exposure_ev"]) == 3 and len(set(row["exposure_ev"].values())) == 1


@pytest.mark.parametrize(
    ("composite", "lights", "kept"),
    [
        ("photo", ["--light", "40,10", "--light=-40,10"], 0),
        ("face", ["--light", "a=40,10", "--light", "b=0,40"], 1),
    ],
)  # of the second image its two lights, beside their sum
def test_lights_that_are_written_are_given_up_before_others_are_relit(
    composite: str, lights: list[str], kept: int, given: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    held: list[weakref.ref] = []
    subject: Any = PeopleInPhoto if composite == "photo" else FaceAlone

    def watched(self: Relightable, lights: Any) -> Iterator[Any]:
        assert sum(one() is not None for one in held) <= kept
        for one in relit(self, lights):
            held.append(weakref.ref((one if composite == "face" else one[0]).texture))
            yield one

    relit = subject.relit

    monkeypatch.setattr("facerf_cli.run.memory._RELIT_HELD", 1 << 30)  # so that one light fits
    monkeypatch.setattr(subject, "relit", watched)
    assert relight(given, tmp_path, *lights, "--composite", composite, "--reflectance", "field") == 0
    assert len(held) > 2


def test_layers_have_a_singular_and_a_plural_and_are_listed_as_in_the_help() -> None:
    assert parse_aov("normals,mattes, class,uvs") == ("normal", "classes", "uv")
    assert parse_aov("normal,normals,matte,shadow") == ("normal", "shadow")
    line = refused(UsageError, "--aov 'beauty': no such layer", parse_aov, "normal,beauty")
    listed = line.partition("use some of ")[2].split(", ")
    assert {*listed} == {"matte", *FACE_LAYERS, *PERSON_LAYERS}
    text = attributes_of(RelightOptions)["aov"]
    assert listed == [word for word in re.findall(r"\w+", text) if word in listed] and "albedo" in listed


def test_layers_provenance_and_the_look_of_the_photos_background(given: Path, tmp_path: Path) -> None:
    aov = "matte,face,normal,position,depth,uv,albedo,shadow,specular,classes"
    assert relight(given, tmp_path, "--light", "40,10", "--aov", aov, "--exposure", "1") == 0
    path = tmp_path / "astronaut_light_40_10.exr"
    assert read_image(path).metadata["facerf:checkpoint"] == "lambert"
    names = "R face.A normal.Z position.Z depth.Z uv.U person.A class.hair class.skin"
    red, mask, normal_z, z, depth, _, matte, _, skin = layers_of(path, *names.split())
    assert red.shape == (512, 512) and 0.01 < (mask > 0.5).mean() < 0.1
    assert (z[mask > 0.5] < -0.3).all() and (normal_z[mask > 0.9] > -0.2).all()
    np.testing.assert_allclose(depth, -z, atol=1e-6)
    assert (matte[mask > 0.5] > 0.9).mean() > 0.99 and (skin[mask > 0.9] > 0.5).mean() > 0.8
    albedo, shadow, specular = layers_of(path, "albedo.G", "shadow.G", "specular.G")
    assert ((shadow >= 0) & (shadow <= 1.001)).all() and (albedo[matte == 0] == 0).all()
    assert (specular >= 0).all() and albedo[mask > 0.5].mean() > 0.02
    behind = matte == 0
    assert 0.2 < behind.mean() < 0.7
    shown = read_image(path.with_suffix(".png")).pixels
    np.testing.assert_allclose(shown[behind], read_image(PHOTO).pixels[behind], atol=2e-3)
    np.testing.assert_allclose(2 * read_image(path).pixels[behind], shown[behind].clip(0, 1), atol=4e-3)


def test_lights_with_names_are_layers_that_add_up(given: Path, tmp_path: Path) -> None:
    lights = ["--light", "key=40,20", "--light", "rim=160,10;rgb=0.2,0.4,0.9", "--light", "5,6"]
    assert relight(given, tmp_path, *lights, "--background", "0,0,0", "--reflectance", "field") == 0
    assert made(tmp_path) == [
        f"astronaut_{name}{suffix}" for name in ("light_5_6", "light_key+rim") for suffix in (".exr", ".png")
    ]
    assert list(exr_layers(tmp_path / "astronaut_light_5_6.exr")) == ["R", "G", "B", "person.A"]
    path = tmp_path / "astronaut_light_key+rim.exr"
    names = [f"{layer}{letter}" for letter in "RGB" for layer in ("", "key.", "rim.", "ambient.")]
    layers = np.stack(layers_of(path, *names)).reshape(3, 4, 512, 512)
    np.testing.assert_allclose(layers[:, 1:].sum(1), layers[:, 0], rtol=5e-3, atol=2e-3)  # half floats
    assert layers[:, 3].max() > 0.01  # of the ambient fill
    assert layers[:, 1].max() > 0.1 and layers[2, 2].mean() > 1.5 * layers[0, 2].mean()


def layers_of(path: Path, *names: str) -> list[np.ndarray]:
    found = exr_layers(path)
    return [found[name] for name in names]


def test_positive_azimuth_lights_the_images_right(given: Path, tmp_path: Path) -> None:
    line = ["--light", "70,0", "--light", "-70,0", "--envmap", str(given / "maps/right.0007.exr")]
    assert relight(given, tmp_path, *line, "--composite", "face") == 0
    left, right = face_sides(tmp_path / "astronaut_light_70_0.exr")
    assert right > 2 * left
    left, right = face_sides(tmp_path / "astronaut_light_-70_0.exr")
    assert left > 2 * right
    left, right = face_sides(tmp_path / "astronaut_right.0007.exr")
    assert right > 1.5 * left


@pytest.mark.slow
def test_backgrounds(given: Path, tmp_path: Path) -> None:
    """A colour and a file as they look, a map as bright as it is, nothing with alpha."""
    write_exr(tmp_path / "red.exr", np.full((20, 60, 3), (0.5, 0.1, 0.1), np.float32))
    grey = ["--envmap", str(given / "maps/grey.exr"), "--exposure", "0"]
    seen = {}
    for name, text in (("colour", "0.1,0.2,0.3"), ("file", str(tmp_path / "red.exr")), ("envmap", "envmap")):
        assert relight(given, tmp_path / name, *grey, "--background", text) == 0
        path = tmp_path / name / "astronaut_grey.exr"
        (matte,) = layers_of(path, "person.A")
        seen[name] = read_image(path).pixels[matte == 0]
    np.testing.assert_allclose(seen["colour"].mean(0), (0.1, 0.2, 0.3), rtol=2e-3)  # half floats
    np.testing.assert_allclose(seen["file"].mean(0), (0.5, 0.1, 0.1), rtol=2e-3)
    np.testing.assert_allclose(seen["envmap"], read_image(given / "maps/grey.exr").pixels.mean(), rtol=2e-3)
    assert relight(given, tmp_path / "none", *grey, "--background", "none") == 0
    alone = read_image(tmp_path / "none/astronaut_grey.exr")
    assert alone.alpha is not None and 0.3 < alone.alpha.mean() < 0.8


def test_a_stack_gives_what_its_photo_gives(given: Path, stack: Path, tmp_path: Path) -> None:
    envmap = ["--envmap", str(given / "maps")]
    field = ["--composite", "face", "--reflectance", "field"]
    assert relight(given, tmp_path / "a", *envmap, *field) == 0
    assert relight(given, tmp_path / "b", *envmap, photo=stack) == 0
    direct = face_sides(tmp_path / "a/astronaut_right.0007.exr")
    again = face_sides(next((tmp_path / "b").glob("*_right.0007.exr")))
    assert again == pytest.approx(direct, rel=0.1)  # the stack's coverage is 0 or 1
    assert again[0] / again[1] == pytest.approx(direct[0] / direct[1], rel=0.01)


def test_a_bad_map_harms_no_other(given: Path, tmp_path: Path, capsys: Said) -> None:
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    (tmp_path / "text.exr").write_text("no picture")
    missing = str(tmp_path / "missing.hdr")
    bad = [str(tmp_path / "square.exr"), str(tmp_path / "text.exr"), missing]
    good = str(given / "maps/grey.exr")
    assert relight(given, tmp_path / "out", "--reflectance", "field", "--envmap", good, *bad) == 1
    assert made(tmp_path / "out") == ["astronaut_grey.exr", "astronaut_grey.png"]
    errors = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(errors) == 3 and "twice as wide" in "".join(errors)
    assert relight(given, tmp_path / "none", "--envmap", missing) == 1
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_the_albedo_at_the_mattes_edge_is_the_persons(given: Path, tmp_path: Path) -> None:
    assert relight(given, tmp_path, "--light", "40,10") == 0
    (matte,) = layers_of(tmp_path / "astronaut_light_40_10.exr", "person.A")
    photo = read_image(PHOTO).pixels
    green = np.float32([0, 0.4, 0])
    write_display(tmp_path / "green.png", green + matte[..., None] * (photo - green))
    line = ["--light", "40,10", "--aov", "albedo"]
    assert relight(given, tmp_path / "out", *line, photo=tmp_path / "green.png") == 0
    path = tmp_path / "out/green_light_40_10.exr"
    *albedo, matte = layers_of(path, "albedo.R", "albedo.G", "albedo.B", "person.A")
    edge = (matte > 0.1) & (matte < 0.5)
    colour = np.array([channel[edge].mean() for channel in albedo])
    assert edge.sum() > 100 and colour[1] < 0.65 * colour.sum()  # of the mixture: 0.77


def test_pose_gives_the_face_alone_in_a_folder_of_any_name(given: Path, tmp_path: Path) -> None:
    (tmp_path / "me.png").mkdir()
    line = ["--light", "0,0", "--pose", "25,0,0", "--format", "png"]
    assert relight(given, tmp_path / "me.png", *line) == 0
    assert read_image(tmp_path / "me.png/astronaut_light_0_0.png").alpha is not None


def test_a_matte_of_another_size(given: Path, tmp_path: Path, capsys: Said) -> None:
    write_exr(tmp_path / "matte.exr", np.ones((20, 30, 3), np.float32))
    assert relight(given, tmp_path / "out", "--light", "0,0", "--matte", str(tmp_path / "matte.exr")) == 1
    assert "matte.exr: the matte has 30 x 20 pixels, the photo 512 x 512" in capsys.readouterr().err


def test_a_photos_own_alpha_cuts_its_person_out(given: Path, tmp_path: Path) -> None:
    photo = read_image(PHOTO).pixels
    alpha = np.ones(photo.shape[:2], np.float32)
    alpha[:, : photo.shape[1] // 2] = 0.25
    write_display(tmp_path / "astronaut.png", photo, 0.0, alpha)
    made = {}
    for name, path, behind in (
        ("opaque", PHOTO, "none"),
        ("cut", tmp_path / "astronaut.png", "none"),
        ("green", tmp_path / "astronaut.png", "0,1,0"),
    ):
        line = ["--light", "0,20", "--background", behind, "--format", "exr", "--reflectance", "field"]
        assert relight(given, tmp_path / name, *line, photo=path) == 0
        made[name] = read_image(tmp_path / name / "astronaut_light_0_20.exr")
    np.testing.assert_allclose(made["cut"].alpha, made["opaque"].alpha * alpha, atol=0.02)
    assert made["green"].alpha is None and made["green"].pixels[alpha < 1].mean(0).argmax() == 1


def test_procedural_maps_by_seed(given: Path, tmp_path: Path) -> None:
    names = [f"astronaut_{index:05d}_{kind_of(index, 4)}" for index in range(2)]
    assert relight(given, tmp_path, "--envmap", "procedural:2", "--seed", "4", "--composite", "face") == 0
    assert made(tmp_path) == [name + suffix for name in names for suffix in (".exr", ".png")]
    assert read_image(tmp_path / f"{names[0]}.exr").pixels.max() > 0


def test_the_network_alone(given: Path, tmp_path: Path, capsys: Said) -> None:
    """It is another image and another stack, which say so; a stack that was predicted keeps what it holds."""
    for folder, line in (("corrected", []), ("alone", ["--network-alone"])):
        assert relight(given, tmp_path / folder, "--light", "40,10", "--composite", "face", *line) == 0
    corrected, alone = (
        read_image(tmp_path / folder / "astronaut_light_40_10.exr") for folder in ("corrected", "alone")
    )
    assert np.abs(corrected.pixels - alone.pixels).max() > 0.01
    assert "facerf:network_alone" in alone.metadata and "facerf:network_alone" not in corrected.metadata
    checkpoint, landmarks = str(given / "lambert.safetensors"), str(given / "astronaut.json")
    olat = ["predict-olat", str(PHOTO), "--landmarks", landmarks, "-o", str(tmp_path / "olat")]
    olat += ["--lights", "4", "--frame", "face", "--network-alone"]
    assert main(["--checkpoint", checkpoint, *olat]) == 0
    stack_path = tmp_path / "olat/astronaut_olat.exr"
    assert "facerf:network_alone" in read_olat_header(stack_path).metadata
    assert relight(given, tmp_path / "c", "--light", "1,2", "--network-alone", photo=stack_path) == 1
    assert "--network-alone needs the photo" in capsys.readouterr().err


def test_a_dry_run_checks_what_a_run_would_load(given: Path, tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "bad.exr").write_text("no map")
    write_display(tmp_path / "picture.png", np.full((6, 9, 3), 0.2, np.float32))
    line = ["--light", "1,2", "--dry-run"]
    assert relight(given, tmp_path / "out", "--dry-run", "--envmap", str(tmp_path / "picture.png")) == 1
    what, last = capsys.readouterr().err.splitlines()
    assert "picture.png: the environment map has 9 x 6 pixels; use a lat-long map" in what
    assert last.endswith("pass other maps, or procedural:8 to draw some")
    assert relight(given, tmp_path / "out", *line, "--envmap", str(tmp_path / "bad.exr")) == 1
    said = capsys.readouterr()
    assert "bad.exr" in said.err and "bad" not in said.out
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_near_lights_sweeps_and_rigs_from_the_command_line(given: Path, tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "studio.toml").write_text(
        "[key]\nat = [0.5, 0.3, 0.8]\nkelvin = 3200\n[rim]\nfrom = [160, 10]\n"
    )
    entries = [str(tmp_path / "studio.toml"), "name=near;at=-0.4,0,0.6;size=0.2", "-60:60:2,0"]
    line = [word for entry in entries for word in ("--light", entry)]
    assert relight(given, tmp_path / "out", *line, "--background", "0,0,0", "--aov", "shadow") == 0
    names = ["light_-60_60_2_0.0000", "light_-60_60_2_0.0001", "light_near", "studio"]
    assert made(tmp_path / "out") == sorted(
        f"astronaut_{name}{suffix}" for name in names for suffix in (".exr", ".png")
    )
    ev = only_row(tmp_path / "out")["exposure_ev"]
    assert ev[f"astronaut_{names[0]}"] == ev[f"astronaut_{names[1]}"]
    layers = exr_layers(tmp_path / "out/astronaut_studio.exr")
    red, green, blue, rim, ambient, whole, shadow, matte = (
        layers[name]
        for name in ("key.R", "key.G", "key.B", "rim.R", "ambient.R", "R", "shadow.R", "person.A")
    )
    np.testing.assert_allclose(red + rim + ambient, whole, rtol=5e-3, atol=2e-3)  # half floats
    assert red.mean() > green.mean() > blue.mean() and 0.2 < shadow[matte > 0.9].mean() < 1
    left, right = (face_sides_of(tmp_path / f"out/astronaut_{name}.exr") for name in names[:2])
    assert left > 1.5 and right > 0  # lit from the image's left; the second frame from ahead
    (tmp_path / "bad.toml").write_text("[key]\nwatts = 3\n")
    assert relight(given, tmp_path / "bad", "--light", str(tmp_path / "bad.toml")) == 1
    assert "bad.toml: key: 'watts': no such key" in capsys.readouterr().err


def face_sides_of(path: Path) -> float:
    """Light on the left half of the person over that on the right."""
    image = read_image(path).pixels.mean(-1)
    middle = image.shape[1] * 215 // 512
    return float(image[60:200, :middle].sum() / image[60:200, middle:].sum())


def test_near_lights_may_turn_the_head(given: Path, tmp_path: Path) -> None:
    assert relight(given, tmp_path / "pose", "--light", "at=0.6,0,0.4", "--pose", "20,0,0") == 0
    left, right = face_sides(tmp_path / "pose/astronaut_light_at_0.6_0_0.4.exr")
    assert right > 1.5 * left


@pytest.mark.parametrize(
    ("lights", "line"),
    [
        ("0,0", "--pose 1,2,3"),
        ("0,0", "--background 0,0,0"),
        ("0,0", "--network-alone"),
        ("0,0", "--white-balance neutral"),
        ("original", "--light"),
        ("delight", "--light"),
        ("at=0.6,0,0.4", "--light"),
    ],
)
def test_what_only_a_photo_can_have_is_refused_of_a_stack(
    given: Path, stack: Path, tmp_path: Path, capsys: Said, lights: str, line: str
) -> None:
    more = [] if line == "--light" else line.split()
    assert relight(given, tmp_path / "a", "--light", lights, *more, photo=stack) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"{stack}: {line.split()[0]}" in said and "pass the photo" in said


def test_a_stack_of_textures_is_refused_and_far_lights_are_not(
    given: Path, stack: Path, tmp_path: Path, capsys: Said
) -> None:
    assert relight(given, tmp_path / "b", "--light", "from=30,0;size_deg=20", photo=stack) == 0
    write_olat_stack(
        tmp_path / "uv.exr",
        header_of(np.eye(3), np.ones((8, 8), np.float32), kind="texture"),
        [torch.ones(3, 3, 8, 8)],
    )
    assert relight(given, tmp_path / "c", "--light", "0,0", photo=tmp_path / "uv.exr") == 1
    assert "uv.exr: a stack of UV textures cannot be relit; pass the photo" in capsys.readouterr().err


def test_a_light_from_behind_leaves_the_face_dark(given: Path, tmp_path: Path) -> None:
    lights = ["--light", "180,20", "--light", "180,20,4", "--ambient", "none"]
    assert relight(given, tmp_path, *lights, "--format", "png", "--reflectance", "field") == 0
    row = only_row(tmp_path)
    assert list(row["exposure_ev"].values()) == [3.0, 1.0]  # four times the light, the same image
