"""What tests share. The data of `../shared` is not in the repository; tests that need it skip without it."""

import hashlib
import os
import signal
import tarfile
from collections import OrderedDict
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facerf_cli.face.importers.ict import ict_source as ict_source_of
from facerf_cli.face.importers.resample import resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.run import memory

# A shell that starts the tests in the background ignores SIGINT, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(os.environ.get("FACERF_SHARED", Path(__file__).parents[2] / "shared"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Escape what is no UTF-8 in what a test printed: xdist's workers cannot send it."""
    report = yield
    report.sections = [
        (title, text.encode("utf-8", "backslashreplace").decode()) for title, text in report.sections
    ]
    return report


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not (SHARED / "data").is_dir():
        pytest.skip(f"{SHARED / 'data'} is not here (set FACERF_SHARED)")
    return SHARED / "data"


@pytest.fixture(scope="session")
def ict_source(shared_data: Path) -> SourceModel:
    """ICT-FaceKit with a few of its shapes."""
    wanted = ("generic_neutral_mesh", "identity000", "identity001", "jawOpen")
    wanted += tuple(f"{stem}_{side}" for stem in ("eyeBlink", "eyeLookDown", "eyeLookOut") for side in "LR")
    archive = shared_data / "ict_facekit" / "ICT-FaceKit-master.tar.xz"
    raw = {}
    with tarfile.open(archive, "r|*") as tar:
        for member in tar:
            if Path(member.name).stem in wanted and "FaceXModel/" in member.name:
                raw[Path(member.name).stem] = tar.extractfile(member).read()
                if len(raw) == len(wanted):
                    break
    return ict_source_of(archive, raw)


@pytest.fixture(scope="session")
def ict_model(ict_source: SourceModel) -> MorphableModel:
    """What an import makes of `ict_source`."""
    return resample_model(ict_source)


@pytest.fixture(scope="session", autouse=True)
def _the_same_photo_costs_once() -> None:
    """The two large shipped networks give what they gave to the same input: most tests show one photo."""
    for kind in (ParsingNetwork, PortraitNetwork):
        kind.forward = remembered(kind.forward)


def remembered(forward: Callable[..., Any], most: int = 24) -> Callable[..., Any]:
    """Keep the last results of a network's `forward` outside training, by its weights and its input."""
    kept: OrderedDict[str, Any] = OrderedDict()

    def again(network: torch.nn.Module, given: Any) -> Any:
        if network.training or torch.is_grad_enabled():
            return forward(network, given)
        inputs = [given] if isinstance(given, torch.Tensor) else list(vars(given).values())
        digest = hashlib.sha1(repr([tuple(tensor.shape) for tensor in inputs]).encode())
        for tensor in (*inputs, *network.state_dict().values()):
            digest.update(tensor.contiguous().cpu().numpy().tobytes())
        if (key := digest.hexdigest()) not in kept:
            kept[key] = forward(network, given)
        kept.move_to_end(key)
        while len(kept) > most:
            kept.popitem(last=False)
        return type(kept[key])(*(tensor.clone() for tensor in kept[key]))

    return again


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """What a test draws does not depend on the tests before it."""
    torch.manual_seed(0)
    np.random.seed(0)


@pytest.fixture(autouse=True)
def _with_all_memory() -> Iterator[None]:
    """A budget that a test sets is gone after it, for the fixtures of the next module, too."""
    memory.set_limit(memory.default_limit())
    yield
    memory.set_limit(memory.default_limit())
