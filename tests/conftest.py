"""What tests share. The data of `../shared` is not in the repository; tests that need it skip without it."""

import multiprocessing
import os
import signal
import tarfile
from collections.abc import Generator, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import typer

from facerf_cli import pipeline
from facerf_cli.face import head
from facerf_cli.face.importers.ict import ict_source as ict_source_of
from facerf_cli.face.importers.resample import resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.network.stored_graph import StoredGraph
from facerf_cli.run import memory
from tests.once import outside_training, remembered

# A shell that starts the tests in the background ignores SIGINT, and children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(os.environ.get("FACERF_SHARED", Path(__file__).parents[2] / "shared"))

# Files that take 10 s or more, the longest first: where they come first, both processes end together.
LONG = """
test_paper_script.py test_docs_commands.py
cli/test_train.py cli/test_film.py cli/test_prepare_dataset.py cli/test_relight.py
cli/test_output_options.py viewer/test_viewer_agreement.py cli/test_evaluate_protocols.py
test_ray_workers.py portrait/test_find.py cli/test_prepare_checks.py test_stopping.py
cli/test_predict_olat.py test_python_api.py test_gradients.py test_notebook.py cli/test_synth_stage.py
cli/test_estimate_light.py training/test_loop.py tools/test_builtin_face.py cli/test_evaluate_yale_b.py
cli/test_relight_dataset.py
cli/test_shards_sum_up.py test_foreign_modules.py test_distribution.py test_near_lights.py
synth/test_path_tracer.py synth/head/test_hair.py test_portrait_field.py
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
    return ict_source_of(archive, raw)


@pytest.fixture(scope="session")
def ict_model(ict_source: SourceModel) -> MorphableModel:
    """What an import makes of `ict_source`."""
    return resample_model(ict_source)


@pytest.fixture(scope="session", autouse=True)
def _the_same_photo_costs_once() -> None:
    """Steps of the method give what they gave to the same input: most tests show one photo."""
    for kind in (ParsingNetwork, PortraitNetwork):
        kind.forward = remembered(kind.forward, applies=outside_training)
    StoredGraph.forward = remembered(StoredGraph.forward, most=200)
    head.unwrap = remembered(head.unwrap)
    pipeline.source_light = remembered(
        pipeline.source_light,
        lambda models, *rest: (models.networks.reflectance, models.source_colours, rest),
        lambda models, *_: type(models.networks.reflectance).__module__.startswith("facerf_cli."),
    )
    pipeline.reflectance_of = remembered(
        pipeline.reflectance_of,
        lambda models, *rest: (
            *(getattr(models.networks, name) for name in ("reflectance", "portrait", "parsing")),
            (models.face, models.source_colours, id(models.networks.reflectance), rest),
        ),
        lambda models, head, kind="field", *_: kind == "portrait",
        most=3,
        copied=False,  # it is frozen
    )


@pytest.fixture(scope="session", autouse=True)
def _the_command_line_is_built_once() -> None:
    """Otherwise each call of `main` builds all verbs. A verb that a test adds builds it anew."""
    build = typer.main.get_command
    built = cache(lambda app, verbs: build(app))
    typer.main.get_command = lambda app: built(app, len(app.registered_commands))
    typer.main.build_command = build


@pytest.fixture
def fresh_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command line as no call has used it: a used one remembers how its help was shown."""
    monkeypatch.setattr(typer.main, "get_command", typer.main.build_command)


@pytest.fixture(scope="session", autouse=True)
def _processes_have_torch() -> None:
    """Processes of `--jobs` are forked from one that has imported it: each spawned one would import it again.

    What goes to them is pickled either way.
    """
    context_of = multiprocessing.get_context
    multiprocessing.set_forkserver_preload(["torch", "scipy.spatial", "trimesh", "OpenImageIO"])
    multiprocessing.get_context = lambda method=None: context_of(
        "forkserver" if method == "spawn" else method
    )


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
