"""The diffuse baseline beside the field: a face in its own light, and relit.

    python benchmarks/diffuse_sh.py --bank DIR [--draws 2]
    python benchmarks/diffuse_sh.py --dataset DATASET [--split validation] [--pairs 4]

--bank: in the chart, on the held-out heads of a bank of baked heads, samples as in training: Si-MSE, clipped
at white, of the source in the light that each model reads off it, and of sums of eight lights.

--dataset: as a user's photo is taken, on people of a prepared dataset: pictures of the crop at 256 texels,
the mean of the truth in the mask brought to 0.25. Beside the baseline stand two forms of it that were not
taken: `low-pass`, its albedo at the network's own side, and `network`, its light as the network has it.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from facerf_cli.baselines.field import Field, explain_by_field
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.baselines.diffuse_sh import CHECKPOINT, explain_texture, load_diffuse_network
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import Pair, image_path, read_pairs
from facerf_cli.evaluation.methods import View
from facerf_cli.face.fit import fit_from_arrays
from facerf_cli.files.images import read_image
from facerf_cli.files.olat_stack import read_olat_header, read_olats
from facerf_cli.light.sphere import rig_directions
from facerf_cli.metrics import mean_interval, si_mse_clipped
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.pipeline import FaceTexture, Models, estimate_photo_light, load_models, turn_to, weigh
from facerf_cli.synth.head_fields import head_fields
from facerf_cli.synth.heads_bank import Bank
from facerf_cli.synth.texture_samples import Sample, draw_light
from facerf_cli.training.diffuse_sh_objective import draw_sums, predicted_images, sum_lights
from facerf_cli.training.losses import clipped_si_mse
from facerf_cli.training.objective import seeded

_COARSE_RIG = 50  # lights over which the field explains a source
_HELD_OUT, _LIGHTS, _SUMS = 12, 8, 3  # of the stage's validation
_METHODS = ("field", "diffuse-sh", "low-pass", "network")
_MEAN = 0.25  # of a truth, in its mask
Errors = dict[tuple[str, str], list[tuple[str, float]]]  # by figure and method: (person, error)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--bank", type=Path, help="with heads/ and views-builtin/, as `facerf train --bank` keeps it")
    add("--dataset", type=Path, help="of prepare-dataset and relight-dataset")
    add("--split", default="validation")
    add("--draws", type=int, default=2, help="samples of each head")
    add("--pairs", type=int, default=4, help="pairs of each person")
    add("--methods", nargs="+", default=_METHODS, choices=_METHODS, help="of the people's pictures")
    add("--diffuse", type=Path, default=CHECKPOINT, help="checkpoint of the stage diffuse-sh")
    given = parser.parse_args()
    models = load_models(None, "builtin", torch.device("cpu"))
    network = load_diffuse_network(given.diffuse)
    with torch.no_grad():
        if given.bank:
            _print(on_heads(models, network, given.bank, given.draws))
        if given.dataset:
            dataset = read_dataset(given.dataset)
            chosen = [pair for pair in read_pairs(dataset) if pair.split == given.split]
            chosen = [pair for pair in chosen if pair.index < given.pairs]
            _print(on_people(models, network, dataset, chosen, given.methods))


def _print(errors: Errors) -> None:
    for (figure, method), values in sorted(errors.items()):
        found = mean_interval(values)
        assert found
        interval = f"{found.mean:.5f} [{found.low:.5f}, {found.high:.5f}], sd {found.sd:.5f}"
        print(f"{figure:20} {method:10} {interval}, {found.images} pictures of {found.groups}")


def on_heads(models: Models, network: DiffuseNetwork, folder: Path, draws: int) -> Errors:
    """Errors on held-out heads of a bank."""
    bank, errors = _held_out(folder), defaultdict(list)
    for head in bank.heads(_HELD_OUT)[1]:
        for draw in range(draws):
            generator = seeded(12345, int(head), draw)
            sample = bank.draw(head[None], _LIGHTS, generator)
            weights = draw_sums(_SUMS, _LIGHTS, generator)
            batch = sum_lights(sample, weights, head[None])
            estimate = network(batch.source, batch.normals_source, batch.visible)
            by_field = _by_field(models, sample, weights)
            found = {"network": predicted_images(estimate, batch), "field": by_field}
            for method, (own, relit) in found.items():
                of_source = clipped_si_mse(own, batch.source[:, None], batch.visible)
                of_sums = clipped_si_mse(relit, batch.targets, batch.weight)
                errors["source", method].append((str(int(head)), float(of_source.mean())))
                errors["sums of lights", method].append((str(int(head)), float(of_sums.mean())))
    return errors


def _held_out(folder: Path) -> Bank:
    """The mean face and the held-out heads of a bank."""
    heads = sorted((folder / "heads").glob("*.safetensors"))[: _HELD_OUT + 1]
    views = [load_file(folder / "views-builtin" / path.name) for path in heads]
    return Bank([head_fields(load_file(path)) for path in heads], views, {})


def _by_field(models: Models, sample: Sample, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The source in its own light [1, 1, 3, T, T], and sums of lights [1, M, 3, T, T]."""
    face = FaceTexture(sample.source[0], sample.visible[0, 0], sample.normals_source[0])
    light = estimate_photo_light(models, face, rig_directions(_COARSE_RIG))
    own = Field(models, face).relit(light.directions, light.weights[None])
    encoded = models.network.encode(sample.source, sample.normals_source, sample.visible)
    olats = models.network.decode(encoded, sample.normals_target, sample.lights)[0]
    return own[None], weigh(olats, weights)[None]


def on_people(
    models: Models, network: DiffuseNetwork, dataset: Dataset, pairs: list[Pair], methods: Sequence[str]
) -> Errors:
    """Errors on pictures of a dataset's people."""
    errors: Errors = defaultdict(list)
    for pair in pairs:
        for figure, method, error in _on_pair(models, network, dataset, pair, methods):
            errors[figure, method].append((pair.subject, error))
    return errors


def _on_pair(
    models: Models, network: DiffuseNetwork, dataset: Dataset, pair: Pair, methods: Sequence[str]
) -> Iterator[tuple[str, str, float]]:
    """Figure, method and error: of the source, and of the target's camera under two drawn lights."""
    source, target = (
        _view(models, dataset, pair.subject, c) for c in (pair.source_camera, pair.target_camera)
    )
    image = read_image(image_path(dataset, *pair.key)).pixels
    face, stack = source.texture_of(image), dataset.stack_path(pair.subject, pair.target_camera)
    directions = torch.from_numpy(read_olat_header(stack).directions).float()
    weights = torch.stack([draw_light(directions, seeded(7, pair.index, k)) for k in range(2)])
    truths = weigh(read_olats(stack).float(), weights).permute(0, 2, 3, 1).numpy()
    turn = turn_to(source.fit, target.fit.rotation)
    pose = "same" if pair.source_camera == pair.target_camera else "other"
    for method in methods:
        found = _explained(method, models, network, face)
        own = found.reflectance.relit(found.light.directions, found.light.weights[None])[0]
        yield "source", method, _error(source, own, image)
        for texture, truth in zip(found.reflectance.relit(directions, weights, turn), truths, strict=True):
            yield f"relit, {pose} pose", method, _error(target, texture, truth)


def _explained(method: str, models: Models, network: DiffuseNetwork, face: FaceTexture) -> Explained:
    if method == "field":
        return explain_by_field(models, face, held_to_photo=False)
    return explain_texture(network, face, fine=method != "low-pass", refit=method != "network")


def _view(models: Models, dataset: Dataset, subject: str, camera: str) -> View:
    header = read_olat_header(dataset.stack_path(subject, camera))
    return View.of(models.face, fit_from_arrays(header.fit), header.seen)


def _error(view: View, texture: Tensor, truth: np.ndarray) -> float:
    mean = (truth.mean(-1) * view.mask).sum() / view.mask.sum()
    return si_mse_clipped(view.image(texture), truth * (_MEAN / mean), view.mask)


if __name__ == "__main__":
    main()
