"""Baked heads, the views that are fitted to them, and their samples."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.light.sphere import rig_directions
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.bank.heads import (
    Bank,
    ViewSettings,
    bake_head,
    bake_heads,
    build_views,
    draw_coefficients,
    load_bank,
)
from facerf_cli.synth.bank.texture_samples import draw_light
from tests.refusals import refused
from tests.synth.conftest import TINY

EXACT = ViewSettings(point_noise=0, group_noise=0, contour_noise=0, yaw_deg=0, pitch_deg=0, roll_deg=0)


def test_finished_heads_are_kept_and_a_lost_one_is_rebuilt_the_same(bank_folder: Path) -> None:
    paths = sorted((bank_folder / "heads").iterdir())
    before = [path.read_bytes() for path in paths]
    kept = paths[0].stat().st_mtime_ns
    paths[3].unlink()
    bake_heads(bank_folder / "heads", "builtin", 6, jobs=1, seed=1, settings=TINY)
    assert [path.read_bytes() for path in sorted((bank_folder / "heads").iterdir())] == before
    assert paths[0].stat().st_mtime_ns == kept


def test_heads_of_another_model_and_an_empty_folder_are_errors(bank_folder: Path, tmp_path: Path) -> None:
    save_face_model(tmp_path / "other.npz", replace(load_face_model(), name="other"))
    with pytest.raises(InputError, match=r"builtin.*--bank"):
        bake_heads(bank_folder / "heads", str(tmp_path / "other.npz"), 6, jobs=1, seed=1, settings=TINY)
    refused(InputError, "no baked heads", load_bank, tmp_path, tmp_path, {})
    views = load_file(sorted((bank_folder / "views").iterdir())[1])
    assert views["warp"].dtype == torch.float16 and views["visible"].dtype == torch.uint8
    lengths = views["normals"].float().norm(dim=1)
    assert torch.allclose(lengths, torch.ones_like(lengths), atol=2e-3)


def test_head_zero_is_the_mean_face_and_a_neutral_head_is_unwrapped_in_place() -> None:
    model = load_face_model()
    head = bake_head(model, 0, 1, TINY)
    assert torch.allclose(head["vertices"], model.mean, atol=1e-6)
    front = head["directions"] @ torch.tensor([0.0, 0, 1])
    forehead = head["visibility"][:, 6:8, 15:17].float().mean((1, 2))
    assert forehead[front > 0.7].min() > 200 and forehead[front < -0.5].max() == 0
    views = build_views(model.mean, model, 1, 64, seed=2, settings=EXACT)
    seen = views["visible"][0] > 200
    shift = (views["warp"][0].float() - texel_centres_uv(64).permute(2, 0, 1)).norm(dim=0) * 64
    assert seen.float().mean() > 0.4
    # Perspective differs from the fixed camera's, so a texel of error is fair; a swapped axis would be tens.
    assert shift[seen].median() < 1.0
    directions = rig_directions(150)
    drawn = [draw_light(directions, torch.Generator().manual_seed(seed)).mean(-1) for seed in range(60)]
    shares = torch.stack([weights.max() / weights.sum() for weights in drawn])
    assert min(weights.min() for weights in drawn) > 0
    assert shares.max() > 0.5 and shares.min() < 0.1


def test_expressions_differ_on_both_sides_and_some_heads_are_neutral() -> None:
    model = load_face_model()
    drawn = [draw_coefficients(model, np.random.default_rng(seed), TINY)[1] for seed in range(40)]
    neutral = sum(bool((beta == 0).all()) for beta in drawn)
    assert 5 < neutral < 25
    assert max(float(beta.max()) for beta in drawn) <= 2.8
    index = {name: position for position, name in enumerate(model.expression_names)}
    drawn = torch.stack([draw_coefficients(model, np.random.default_rng(s), TINY)[1] for s in range(60)])
    smiles = drawn[:, [index["smile_left"], index["smile_right"]]] > 0
    assert (smiles[:, 0] == smiles[:, 1]).all() and smiles.float().mean() > 0.2
    jaw = drawn[:, [index["jaw_left"], index["jaw_right"]]] > 0
    assert (jaw[:, 0] != jaw[:, 1]).any()
    assert drawn[:, index["jaw_open"]].max() <= 1.6


def test_samples_are_at_one_exposure_and_targets_brighten_where_they_face_their_light(bank: Bank) -> None:
    sample = bank.draw(torch.tensor([1, 2, 3]), 4, torch.Generator().manual_seed(0))
    for field in (sample.source, sample.target, sample.normals_source, sample.weight):
        assert field.isfinite().all()
    assert sample.target.shape == (3, 4, 3, 32, 32) and sample.target.min() >= 0
    mean = (sample.source.mean(1) * sample.visible[:, 0]).sum((1, 2)) / sample.visible[:, 0].sum((1, 2))
    assert torch.allclose(mean, torch.full((3,), 0.25), atol=0.03)
    assert torch.allclose(sample.lights.norm(dim=-1), torch.ones(3, 4), atol=1e-5)
    generator = torch.Generator().manual_seed(2)
    sample = bank.draw(torch.arange(1, 6), 6, generator)
    cosine = torch.einsum("blc,bcij->blij", sample.lights, sample.normals_target)
    seen = sample.weight[:, :1].expand_as(cosine) > 0.5
    luminance = sample.target.mean(2)
    facing, away = luminance[seen & (cosine > 0.6)].mean(), luminance[seen & (cosine < -0.3)].mean()
    assert facing > 8 * away
