from pathlib import Path

import pytest
import torch

from facerf_cli.light.transport import BakeSettings
from facerf_cli.synth import bank as bank_room
from facerf_cli.synth.bank.heads import Bank, HeadBakeSettings, add_views, bake_heads, load_bank

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
