"""What tests share. The data of `../shared` is not in the repository; tests that need it skip without it."""

import os
import signal
import tarfile
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.batch import journal
from facerf_cli.cli import relight
from facerf_cli.face.importers.ict import ict_source as ict_source_of
from facerf_cli.face.importers.resample import resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.run import memory

# A shell that starts the tests in the background ignores SIGINT, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(os.environ.get("FACERF_SHARED", Path(__file__).parents[2] / "shared"))

# Files that take 10 s or more, the longest first: where they come first, both processes end together.
LONG = """
test_paper_script.py test_docs_commands.py cli/test_video.py cli/test_relight.py cli/test_train.py
run/test_ray_workers.py viewer/test_viewer_agreement.py cli/test_predict_olat.py test_gradients.py
cli/test_prepare_dataset.py cli/test_estimate_light.py cli/test_output_options.py cli/test_person.py
cli/test_relight_reflectance.py cli/test_evaluate_protocols.py test_main.py cli/test_synth_stage.py
portrait/test_person.py cli/test_original.py relighting/test_portrait_field.py
cli/test_relight_dataset.py cli/test_segment.py training/test_loop.py relighting/test_reflectance.py
relighting/test_near_lights.py test_python_api.py cli/test_ambient.py relighting/test_white.py
cli/test_evaluate_yale_b.py relighting/test_photo_light.py cli/test_prepare_checks.py
portrait/test_find.py run/test_stopping.py test_notebook.py tools/test_assets.py
cli/test_shards_sum_up.py test_foreign_modules.py test_distribution.py benchmarks/test_path_tracer.py
synth/head/test_hair.py
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--kills", type=int, default=3, help="runs that tests/test_kills.py kills")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {Path(__file__).parent / name: place for place, name in enumerate(LONG.split())}
    items.sort(key=lambda item: places.get(item.path, len(places)))


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
    return ict_source_of(raw)


@pytest.fixture(scope="session")
def ict_model(ict_source: SourceModel) -> MorphableModel:
    """What an import makes of `ict_source`."""
    return resample_model(ict_source)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_journals(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the journals of files that `-o` names, and maps, out of the user's cache."""
    folder, in_cache = tmp_path_factory.mktemp("journals"), journal._in_cache
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relight, "_cached", lambda *parts: folder.joinpath(*parts))
        patch.setattr(journal, "_in_cache", lambda file: folder / in_cache(file).name)
        yield


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
