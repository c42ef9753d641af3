import pytest
import torch
from torch import Tensor

from facerf_cli.raster.camera import Camera, project
from facerf_cli.raster.rasterize import front_facing, interpolate, rasterize
from tests.fake_device import OnDevice, in_use
from tests.kinds import Patch
from tests.oracles.rasterize import rasterize_slowly

WIDE = Camera(focal_px=40.0, width_px=37, height_px=22, cx_px=17.3, cy_px=11.9)  # neither square nor centred


def triangle_soup(count: int, seed: int, spread_m: float = 0.8) -> tuple[Tensor, Tensor]:
    """Triangles of all sizes that pierce each other and leave the image, float64."""
    generator = torch.Generator().manual_seed(seed)
    centre = torch.randn(count, 1, 3, generator=generator).double() * torch.tensor([0.4, 0.3, 0.2])
    size = spread_m * 10 ** (-1.5 * torch.rand(count, 1, 1, generator=generator, dtype=torch.float64))
    corners = centre + size * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return (corners - torch.tensor([0, 0, 2.5])).reshape(-1, 3), torch.arange(3 * count).reshape(-1, 3)


def bumpy_grid(side: int, seed: int) -> tuple[Tensor, Tensor]:
    """A jittered height field that overfills WIDE, and its triangles with random diagonals."""
    generator = torch.Generator().manual_seed(seed)
    step = torch.linspace(-1.5, 1.5, side, dtype=torch.float64)
    y, x = torch.meshgrid(step, step, indexing="ij")
    jitter = (torch.rand(3, side, side, generator=generator, dtype=torch.float64) - 0.5) * (3 / (side - 1))
    xyz = [x + 0.6 * jitter[0], y + 0.6 * jitter[1], -2 + 0.3 * jitter[2]]
    vertices = torch.stack(xyz, -1).reshape(-1, 3)
    a = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).reshape(-1, 1)
    b, c, d = a + 1, a + side, a + side + 1
    flip = torch.rand(len(a), 1, generator=generator) < 0.5
    first = torch.where(flip, torch.cat([a, c, b], 1), torch.cat([a, c, d], 1))
    second = torch.where(flip, torch.cat([b, c, d], 1), torch.cat([a, d, b], 1))
    return vertices, torch.cat([first, second])


@pytest.mark.parametrize("seed", [0, 1])
def test_values_and_gradients_are_the_oracles(seed: int) -> None:
    vertices, triangles = triangle_soup(40, seed)
    results = []
    for run in (rasterize, rasterize_slowly):
        leaf = vertices.clone().requires_grad_()
        out = run(leaf, triangles, WIDE)
        triangle, weights, depth = (
            out if isinstance(out, tuple) else (out.triangle, out.barycentric, out.depth_m)
        )
        pattern = torch.linspace(1, 2, weights.numel(), dtype=torch.float64).view_as(weights)
        seen = triangle >= 0
        ((weights * pattern).sum() + (depth[seen] * pattern[..., 0][seen]).sum()).backward()
        results.append((triangle, weights.detach(), depth.detach(), leaf.grad))
    (triangle, weights, depth, gradient), (triangle0, weights0, depth0, gradient0) = results
    assert 0.2 < (triangle0 >= 0).float().mean() < 1
    assert torch.equal(triangle, triangle0)
    torch.testing.assert_close(weights, weights0, rtol=0, atol=1e-9)
    torch.testing.assert_close(depth, depth0, rtol=1e-9, atol=0)
    torch.testing.assert_close(gradient, gradient0, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("chunk_px", [None, 500])
def test_a_device_gives_the_same_bits(chunk_px: int | None, monkeypatch: Patch) -> None:
    """Sizes that the CPU counts are only bounded there."""
    if chunk_px:
        monkeypatch.setattr("facerf_cli.raster.rasterize._CHUNK_PX", chunk_px)
    vertices, triangles = triangle_soup(40, seed=0)
    results, behind = [], vertices * torch.tensor([1.0, 1.0, -1.0])
    for place in (lambda tensor: tensor, OnDevice):
        leaf = place(torch.stack([vertices, behind, vertices.flip(0)])).requires_grad_()
        uv, ids = place(torch.linspace(0, 1, 240).view(120, 2).double()), place(triangles)
        with in_use():
            out = rasterize(leaf, ids, WIDE)
            shown = interpolate(uv, ids, out)
            depth = torch.where(out.covered, out.depth_m, 0)
            (shown.square().sum() + out.barycentric.square().sum() + depth.sum()).backward()
        results.append([out.triangle, out.barycentric, out.depth_m, shown, leaf.grad])
    assert 0.2 < out.covered.values[0].float().mean() < 1 and not out.covered.values[1].any()
    for here, there in zip(*results, strict=True):
        assert torch.equal(here, there.values)


def test_float32_differs_from_the_oracle_only_by_rounding() -> None:
    vertices, triangles = triangle_soup(40, seed=3)
    fragments = rasterize(vertices.float(), triangles, WIDE)
    triangle, weights, _ = rasterize_slowly(vertices.float(), triangles, WIDE)
    assert torch.equal(fragments.triangle, triangle)
    torch.testing.assert_close(fragments.barycentric, weights.float(), rtol=0, atol=1e-5)


def test_a_mesh_is_watertight() -> None:
    vertices, triangles = bumpy_grid(30, seed=0)
    alone = torch.zeros(WIDE.height_px, WIDE.width_px, dtype=torch.int64)
    for corners in triangles:
        alone += rasterize(vertices, corners[None], WIDE).covered
    assert bool((alone == 1).all()), f"{int((alone == 0).sum())} holes, {int((alone > 1).sum())} doubles"


def test_pixel_centres_on_edges_and_corners_are_owned_once() -> None:
    camera = Camera(focal_px=8.0, width_px=13, height_px=9, cx_px=6.5, cy_px=4.5)
    step = torch.arange(-10, 11, dtype=torch.float64) / 8  # every vertex on a pixel's centre
    y, x = torch.meshgrid(step, step, indexing="ij")
    vertices = torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)
    _, triangles = bumpy_grid(21, seed=0)
    alone = sum(rasterize(vertices, corners[None], camera).covered.long() for corners in triangles)
    assert isinstance(alone, Tensor) and bool((alone == 1).all())


def test_a_triangle_far_larger_than_the_image_fills_it_and_nothing_is_empty() -> None:
    vertices = torch.tensor([[-90.0, -90, -1], [90, -90, -1], [0, 180, -1]])
    fragments = rasterize(vertices, torch.tensor([[0, 1, 2]]), WIDE)
    assert bool(fragments.covered.all())
    torch.testing.assert_close(fragments.depth_m, torch.ones(22, 37))
    empty = rasterize(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), WIDE)
    assert not empty.covered.any() and bool(empty.depth_m.isinf().all())


def test_work_in_parts_gives_the_same_image_and_faces_turn_counter_clockwise(monkeypatch: Patch) -> None:
    vertices, triangles = triangle_soup(60, seed=4)
    whole = rasterize(vertices, triangles, WIDE)
    monkeypatch.setattr("facerf_cli.raster.rasterize._CHUNK_PX", 300)
    parts = rasterize(vertices, triangles, WIDE)
    assert torch.equal(whole.triangle, parts.triangle)
    vertices = torch.tensor([[-1.0, -1, -2], [1, -1, -2], [0, 1, -2]])
    triangles = torch.tensor([[0, 1, 2], [0, 2, 1]])
    assert front_facing(vertices, triangles).tolist() == [True, False]


def test_useless_triangles_are_dropped_without_a_trace() -> None:
    good = torch.tensor([[-1.0, -1, -2], [1, -1, -2], [0, 1, -2]], dtype=torch.float64)
    bad = {
        "behind the camera": good * torch.tensor([1, 1, -1]),
        "through the camera plane": good + torch.tensor([[0, 0, 3.0], [0, 0, 0], [0, 0, 0]]),
        "a point": good[:1].expand(3, 3),
        "a line": good[[0, 1, 0]],
        "edge-on": torch.tensor([[0.1, -1, -2], [0.1, 1, -2], [0.15, 0, -3]]) * torch.tensor([0, 1, 1]),
        "not a number": good * torch.nan,
    }
    for name, corners in bad.items():
        vertices = torch.cat([good, corners.double()]).requires_grad_()
        fragments = rasterize(vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]), WIDE)
        assert set(fragments.triangle.unique().tolist()) == {-1, 0}, name
        image = interpolate(vertices[:3].detach(), torch.tensor([[0, 1, 2]]), fragments)
        (image.sum() + fragments.depth_m[fragments.covered].sum()).backward()
        assert vertices.grad is not None and bool(vertices.grad[:3].isfinite().all()), name


def test_interpolated_positions_project_back_to_their_pixels() -> None:
    vertices, triangles = bumpy_grid(12, seed=7)
    fragments = rasterize(vertices, triangles, WIDE)
    px = project(interpolate(vertices, triangles, fragments), WIDE)
    y, x = torch.meshgrid(torch.arange(22) + 0.5, torch.arange(37) + 0.5, indexing="ij")
    torch.testing.assert_close(px, torch.stack([x, y], -1).double(), rtol=0, atol=1e-9)
