"""`facerf fit-geometry` from the command line: its files agree with each other and with the photo."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from skimage.metrics import peak_signal_noise_ratio

from facerf_cli.face.crop import from_box
from facerf_cli.face.fit import FaceFit, load_fit
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.main import main
from facerf_cli.network.checkpoint import load_checkpoint, save_checkpoint
from facerf_cli.network.files import SHIPPED
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import project
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Sides, load_models
from tests import astronaut
from tests.astronaut import PATH as PHOTO
from tests.exr_layers import exr_layers
from tests.folders import only_row
from tests.textured import render_texture

NAMES = ("texture.exr", "texture.png", "normals.exr", "normals.png", "mesh.glb", "mesh.obj", "mesh.mtl")
ENDINGS = {f"_{name}" for name in (*NAMES, "fit.jpg", "fit.npz")}
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def landmarks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the photo's landmarks."""
    folder = tmp_path_factory.mktemp("landmarks")
    (folder / "astronaut.json").write_text(json.dumps(astronaut.face().landmarks_px.tolist()))
    return folder


@pytest.fixture(scope="module")
def fitted(landmarks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("fitted")
    assert main(["fit-geometry", str(PHOTO), "-o", str(output), "--landmarks", str(landmarks)]) == 0
    return output


def test_every_file_is_there_and_says_whose_model_it_is_of(fitted: Path) -> None:
    row = only_row(fitted)
    assert set(row["outputs"]) == {f"astronaut{ending}" for ending in ENDINGS}
    assert all((fitted / name).is_file() for name in row["outputs"])
    assert row["error_iod"] < 0.045 and row["quality"] == "good" and len(row["pose_deg"]) == 3
    with np.load(fitted / "astronaut_fit.npz", allow_pickle=False) as file:
        assert str(file["facerf:face_model"]) == str(file["model"]) == "builtin"
        assert str(file["facerf:face_model_licence"]) == load_face_model().licence


def fit_of(fitted: Path) -> FaceFit:
    return load_fit(fitted / "astronaut_fit.npz")


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_the_mesh_seen_by_the_fit_is_the_photo(fitted: Path, kind: str) -> None:
    fit = fit_of(fitted)
    mesh = trimesh.load(fitted / f"astronaut_mesh.{kind}", force="mesh", process=False)
    vertices = torch.from_numpy(np.array(mesh.vertices)).float() @ fit.rotation.mT + fit.translation_m
    uv = torch.from_numpy(np.array(mesh.visual.uv) * [1, -1] + [0, 1]).float()
    texture = torch.from_numpy(read_image(fitted / "astronaut_texture.exr").pixels).permute(2, 0, 1)
    faces = torch.from_numpy(np.array(mesh.faces)).long()
    image, seen = render_texture(texture, vertices, faces, uv, fit.camera)
    cropped = fit.crop.apply(read_image(PHOTO).pixels)
    inside = seen.numpy() > 0
    assert inside.mean() > 0.2
    assert peak_signal_noise_ratio(cropped[inside], image.numpy()[inside], data_range=1) > 25
    material_image = getattr(mesh.visual.material, "baseColorTexture", None) or mesh.visual.material.image
    assert material_image.size == (256, 256)


def test_the_camera_of_the_glb_sees_what_the_crop_shows(fitted: Path) -> None:
    """As glTF has it: the camera's node holds its pose, and it looks along its -z."""
    content = (fitted / "astronaut_mesh.glb").read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    (node,) = (node for node in document["nodes"] if "camera" in node)
    lens = document["cameras"][node["camera"]]["perspective"]
    assert lens["aspectRatio"] == 1
    fit = fit_of(fitted)
    vertices = fit.vertices_camera(load_face_model())
    camera_to_head = np.array(node["matrix"]).reshape(4, 4).T  # by columns
    in_head = (vertices.numpy() - fit.translation_m.numpy()) @ fit.rotation.numpy()
    x, y, z = ((in_head - camera_to_head[:3, 3]) @ camera_to_head[:3, :3]).T
    half = fit.crop.size_px / 2
    scale = half / np.tan(lens["yfov"] / 2)
    seen = np.stack([half - scale * x / z, half + scale * y / z], -1)
    np.testing.assert_allclose(seen, project(vertices, fit.camera).numpy(), atol=0.05)


def test_texture_says_what_was_seen_and_normals_are_of_unit_length(fitted: Path) -> None:
    visible = exr_layers(fitted / "astronaut_texture.exr")["visible"]
    assert visible.min() == 0 and visible.max() == 1
    normals = read_image(fitted / "astronaut_normals.exr").pixels
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1, atol=2e-3)
    assert normals[100:150, 20:60, 0].mean() < -0.3 < 0.3 < normals[100:150, 196:236, 0].mean()


def test_the_overlay_is_the_photo_but_for_the_face(fitted: Path) -> None:
    photo, overlay = (read_image(path).pixels for path in (PHOTO, fitted / "astronaut_fit.jpg"))
    assert overlay.shape == photo.shape
    fit = fit_of(fitted)
    x, y = fit.crop.to_photo(fit.landmarks_px[30].numpy()).round().astype(int)
    nose = np.s_[y - 20 : y + 20, x - 20 : x + 20]
    assert np.abs(overlay[nose] - photo[nose]).mean() > 0.05
    corner = overlay[:60, -60:] / photo[:60, -60:]
    assert np.percentile(corner, 90) < 1.1 * np.percentile(corner, 10)  # the same but for its exposure


def test_two_faces_each_get_their_files_and_are_named_by_number_and_place(
    tmp_path: Path, capsys: Capture
) -> None:
    photo = read_image(PHOTO).pixels
    write_display(tmp_path / "two.png", np.concatenate([photo[:300, 60:400]] * 2, 1))
    assert main(["fit-geometry", str(tmp_path / "two.png"), "-o", str(tmp_path / "o"), "--face", "all"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "face 0 from the left, at x 1" in said and "face 1 from the left, at x 5" in said
    row = only_row(tmp_path / "o")
    assert set(row["outputs"]) == {f"two_face{n}{ending}" for n in (0, 1) for ending in ENDINGS}
    left, right = (load_fit(tmp_path / "o" / f"two_face{n}_fit.npz").crop.x0_px for n in (0, 1))
    assert abs(right - left - 340) < 10 and len(row["faces"]) == 2
    assert all({"turned", "disputed"} <= set(face["factors"]) for face in row["faces"])


def test_bad_landmarks_name_the_photo(tmp_path: Path, capsys: Capture) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    line = ["fit-geometry", str(PHOTO), "-o", str(tmp_path / "o"), "--landmarks"]
    outside = [[40 * number - 9000, 37 * (number % 9) - 9000] for number in range(68)]
    for content, message in (
        (None, "--landmarks has no "),
        ("[]", "landmarks"),
        ("{", "landmarks"),
        (json.dumps([[5, 5]] * 68), "on one point or line"),
        (json.dumps(outside), "outside the image"),
    ):
        if content is not None:
            (marks / "astronaut.json").write_text(content)
        assert main([*line, str(marks)]) == 1
        err = capsys.readouterr().err
        assert "astronaut" in err and message in err and "Traceback" not in err and "unexpected" not in err
    assert not list((tmp_path / "o").glob("[!.]*"))


def fit(output: Path, *words: str) -> int:
    return main(["--device", "cpu", "fit-geometry", str(PHOTO), "-o", str(output), *words])


def is_regressed(output: Path) -> bool:
    """Tell whether the head was not fitted to landmarks, whose error would be known."""
    row = only_row(output)
    return row["quality"] == "unknown" and "error_iod" not in row


def networks_of(output: Path) -> set[str]:
    """The networks that served a run, by its report."""
    return set(only_row(output)["networks"])


def test_the_network_regresses_the_head_of_a_photo(tmp_path: Path) -> None:
    assert fit(tmp_path, "--geometry", "network") == 0
    found = load_fit(tmp_path / "astronaut_fit.npz")
    photo = read_image(PHOTO).pixels
    assert found.crop == from_box(find_faces(SHIPPED_NETWORKS.people, photo, "astronaut")[0].box_px, 512)
    models = load_models()
    crop = torch.from_numpy(found.crop.apply(photo)).permute(2, 0, 1)[None]
    with torch.no_grad():
        estimate = models.networks.geometry(crop)
    torch.testing.assert_close(found.rotation, estimate.rotation[0])
    torch.testing.assert_close(found.translation_m, estimate.translation_m[0])
    torch.testing.assert_close(found.alpha[: estimate.alpha.shape[1]], estimate.alpha[0])
    assert is_regressed(tmp_path) and "geometry" in networks_of(tmp_path)


def test_no_other_run_loads_that_network_and_it_serves_no_other_face_model(
    tmp_path: Path, fitted: Path, capsys: Capture
) -> None:
    assert "geometry" not in networks_of(fitted)
    save_face_model(tmp_path / "mine.npz", replace(load_face_model(), name="mine"))
    assert fit(tmp_path / "out", "--geometry", "network", "--face-model", str(tmp_path / "mine.npz")) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "mine.npz" in said and "use --geometry landmarks" in said


def test_a_checkpoint_of_both_networks_regresses_by_default(tmp_path: Path) -> None:
    tensors, metadata = load_checkpoint(SHIPPED["reflectance"])
    joint = tmp_path / "joint.safetensors"
    save_checkpoint(joint, tensors, metadata | {"geometry": "network", "texture_side": 128, "crop_px": 192})
    assert fit(tmp_path / "out", "--checkpoint", str(joint)) == 0
    assert is_regressed(tmp_path / "out")
    assert load_fit(tmp_path / "out/astronaut_fit.npz").crop.size_px == 192
    texture = read_image(tmp_path / "out/astronaut_texture.exr").pixels
    assert texture.shape == (128, 128, 3)


@pytest.mark.parametrize("wrong", [{"texture_side": "128"}, {"crop_px": 10**9}, {"source_colours": 7}])
def test_a_checkpoint_that_expects_nonsense_is_refused(
    tmp_path: Path, wrong: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    tensors, metadata = load_checkpoint(SHIPPED["reflectance"])
    save_checkpoint(tmp_path / "wrong.safetensors", tensors, metadata | wrong)
    wrong_file = str(tmp_path / "wrong.safetensors")
    assert fit(tmp_path / "out", "--geometry", "network", "--checkpoint", wrong_file) == 1
    (line,) = [x for x in capsys.readouterr().err.splitlines() if "invalid" in x]
    assert next(iter(wrong)) in line and "train it again" in line


def test_sides_keep_the_proportion_of_training() -> None:
    models = replace(load_models(), trained_sides=Sides(128, 192))
    assert models.sides() == Sides(128, 192) and models.sides(256) == Sides(256, 384)
