"""MediaPipe's networks give what the originals give.

mediapipe_recorded.npz holds outputs of the original files for a part of the example photo: detectors and body
by the reference kernels of ai-edge-litert 2.1, the person's share and the mesh by mediapipe 0.10.21 itself.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerf_cli.network.stored_graph import OPERATORS, StoredGraph
from facerf_cli.portrait.find import detect_faces, find_meshes
from facerf_cli.portrait.parse import whole_photo
from facerf_cli.relighting.models import SHIPPED_NETWORKS

PHOTO = Path(__file__).parents[2] / "examples/astronaut.jpg"


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    return dict(np.load(Path(__file__).with_name("mediapipe_recorded.npz")))


def image(side_px: int) -> Image.Image:
    part = Image.open(PHOTO).convert("RGB").crop((130, 0, 386, 256))
    return part.resize((side_px, side_px), Image.Resampling.BOX)


def as_input(side_px: int) -> torch.Tensor:
    return torch.from_numpy(np.asarray(image(side_px), np.float32) / 255).permute(2, 0, 1)[None]


@pytest.mark.parametrize(("name", "side_px"), [("near", 128), ("far", 192)])
def test_detectors(recorded: dict[str, np.ndarray], name: str, side_px: int) -> None:
    out = StoredGraph(f"{name}_faces")(as_input(side_px) * 2 - 1)
    anchors = recorded[f"{name}_anchors"]
    assert len(anchors) > 1
    # pixels of the input, and logits: 1e-3 of their range, since JPEG decoders differ by a level
    assert out["boxes"][0, anchors].numpy() == pytest.approx(recorded[f"{name}_boxes"], abs=0.2)
    assert out["scores"][0, anchors, 0].numpy() == pytest.approx(recorded[f"{name}_scores"], abs=0.2)


def test_bodies_and_persons_are_the_recorded_ones(recorded: dict[str, np.ndarray]) -> None:
    out = StoredGraph("body")(as_input(256))
    assert out["points"][0].numpy() == pytest.approx(recorded["body_points"], abs=1)
    assert out["mask"][0, 0, ::8, ::8].sigmoid().numpy() == pytest.approx(
        1 / (1 + np.exp(-recorded["body_mask"].astype(np.float64).clip(-50, 50))), abs=0.02
    )
    share = StoredGraph("person")(as_input(256))["share"][0, 0, ::8, ::8].numpy()
    assert share == pytest.approx(recorded["person_share"], abs=0.01)


def test_mesh_of_a_detected_face(recorded: dict[str, np.ndarray]) -> None:
    (mesh,) = find_meshes(
        SHIPPED_NETWORKS.people, np.asarray(image(256)), [whole_photo(np.zeros((256, 256)))]
    )
    off_px = np.linalg.norm(mesh.points_px[:, :2] - recorded["mesh_px"][:, :2], axis=1)
    size_px = np.ptp(recorded["mesh_px"][:, :2], axis=0).max()
    assert off_px.mean() < 0.01 * size_px  # squares around the face differ: MediaPipe looks once, we twice
    irises = off_px[468:]
    assert irises.max() < 0.02 * size_px


def test_networks_of_a_batch_do_not_mix_and_samples_lie_at_whole_steps() -> None:
    network, images = StoredGraph("person"), torch.rand(3, 3, 256, 256)
    together = network(images)["share"]
    assert torch.allclose(together[1], network(images[1:2])["share"][0], atol=1e-5)
    row = torch.tensor([0.0, 1.0, 2.0]).expand(1, 1, 3, 3)
    large = OPERATORS["resize"](row, size=[6, 6], align_corners=False, half_pixel=False)
    assert large[0, 0, 0].tolist() == [0, 0.5, 1, 1.5, 2, 2]
    assert len(detect_faces(SHIPPED_NETWORKS.people, np.asarray(Image.open(PHOTO).convert("RGB")))) == 1
