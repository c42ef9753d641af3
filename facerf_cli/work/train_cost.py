"""`facerf train --dry-run`: what a run will write, computed from its networks and its data."""

import logging
from collections.abc import Iterable, Mapping

from torch import Tensor, nn

from facerf_cli.dataset.cost import cost_of_textures, in_words
from facerf_cli.dataset.dataset import read_dataset
from facerf_cli.dataset.textures import model_of
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.training.run_folder import refuse_another_run
from facerf_cli.work.train_networks import StageNetworks
from facerf_cli.work.train_options import TrainOptions

_UNWRAPPED = ("reflectance", "diffuse-sh")  # stages that unwrap a dataset into files
log = logging.getLogger(LOGGER_NAME)


def say_cost(options: TrainOptions, make: StageNetworks) -> None:
    """Log the sizes of the run's checkpoints and of the textures that its dataset lacks."""
    if not options.resume:
        refuse_another_run(options.output)
    networks = make.of_stage()
    weights, state = checkpoint_bytes(networks, bool(options.training.ema_decay))
    trained = ", ".join(networks)
    log.info("last.safetensors and best.safetensors (%s): %s each", trained, in_words(weights))
    log.info("state.pt: %s", in_words(state))
    if options.dataset and options.stage in _UNWRAPPED:
        dataset, side = read_dataset(options.dataset), make.texture_side
        subjects = [*dataset.splits["train"], *dataset.splits["validation"]]
        cost = cost_of_textures(dataset, model_of(dataset, options.fit_with), side, subjects)
        log.info("%s: %s", dataset.folder / f"textures-{side}", cost)
    elif options.dataset is None or options.photos or options.stage == "portrait":
        log.info("synthetic heads, portraits and the faces of photos that are kept: not computed")


def checkpoint_bytes(networks: Mapping[str, nn.Module], averaged: bool) -> tuple[int, int]:
    """Bytes of a checkpoint of networks and of a run's state; both optimizers keep two moments a weight."""
    tensors = _bytes(tensor for network in networks.values() for tensor in network.state_dict().values())
    weights = _bytes(weight for network in networks.values() for weight in network.parameters())
    return tensors, tensors * (2 if averaged else 1) + 2 * weights


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)
