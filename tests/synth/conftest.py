import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.light.transport import BakeSettings
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.synth import bank as bank_room
from facerf_cli.synth import person
from facerf_cli.synth.bank.heads import Bank, HeadBakeSettings, add_views, bake_heads, load_bank
from facerf_cli.synth.bank.people import PeopleBankSettings, bake_person
from facerf_cli.synth.bank.proxies import look_at_photos

TINY = HeadBakeSettings(side=32, lights=20, bake=BakeSettings(light_samples=1, bounce_samples=2))


@pytest.fixture(scope="session")
def bank_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six tiny baked heads with two views each, made without other processes."""
    folder, threads = tmp_path_factory.mktemp("bank"), torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bank_room, "in_shards", lambda work, items, jobs: work(items))
        bake_heads(folder / "heads", "builtin", 6, jobs=1, seed=1, settings=TINY)
        add_views(folder / "heads", folder / "views", "builtin", 2, jobs=1, seed=1)
    torch.set_num_threads(threads)
    return folder


@pytest.fixture(scope="session")
def bank(bank_folder: Path) -> Bank:
    return load_bank(
        bank_folder / "heads", bank_folder / "views", {"heads": "six for a test", "licence": "MIT"}
    )


SMALL = PeopleBankSettings(cameras=1, squares=2, images=3, looks=2, lights=14, side_px=192)


def backgrounds() -> Tensor:
    random = torch.Generator().manual_seed(0)
    return (60 + 100 * torch.rand(2, 3, 32, 32, generator=random)).byte()


@pytest.fixture(scope="session")
def people_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bank of one person, whom two squares of a photo show; all processes of a run have the same."""

    def fill(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(person, "_SMALL_PX", SMALL.side_px)  # a coarse mesh
            made = bake_person(["builtin"], 10, SMALL, 1)
        for name, tensors in made.items():
            save_file(tensors, folder / f"{name}.safetensors")
        look_at_photos(backgrounds(), SHIPPED_NETWORKS, 0, list(folder.glob("photo_*")))

    return made_once(tmp_path_factory, "people", fill)


def made_once(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]) -> Path:
    """A folder that the first process that needs it fills; others of the same run wait for it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with FileLock(folder.with_suffix(".lock")):
        if not folder.with_suffix(".made").exists():
            folder.mkdir(exist_ok=True)
            fill(folder)
            folder.with_suffix(".made").touch()
    return folder
