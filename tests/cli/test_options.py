"""Groups of options: fields of dataclasses become a verb's options, and come back as the dataclass."""

from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import pytest
import typer
from typer.testing import CliRunner

from facerf_cli.batch.settings import Settings
from facerf_cli.cli.estimate_light import EstimateLight
from facerf_cli.cli.fit_geometry import FitGeometry
from facerf_cli.cli.options import with_groups
from facerf_cli.cli.predict_olat import PredictStacks
from facerf_cli.cli.segment import Segment
from facerf_cli.cli.view import MakePage
from facerf_cli.option import Only, Without, attributes_of, option
from facerf_cli.work.photo_options import PhotoOptions


@dataclass(frozen=True)
class Paint:
    settings: Settings
    side_px: int = option(8, "Side of the image, in pixels.", "N", least=1, flags=("--size", "-s"))
    kind: Literal["oil", "ink"] = option("oil", "Kind of paint.")
    secret: int = 3


@dataclass(frozen=True)
class Frame:
    """A frame.

    Attributes:
        width_px: Width of the frame,
            in pixels.
        gold: Gild it.
    """

    width_px: int = option(...)
    gold: bool = option(False)


def run(verb: object, *arguments: str) -> object:
    app = typer.Typer()

    @app.callback()
    def _root(context: typer.Context) -> None:
        context.obj = Settings(seed=5)

    app.command("verb")(with_groups(verb))  # type: ignore[arg-type]
    return CliRunner().invoke(app, ["verb", *arguments])


def test_groups_come_back_as_values_with_the_docstrings_help() -> None:
    made = []

    def verb(context: typer.Context, name: str, paint: Paint, frame: Frame) -> None:
        made.append((name, paint, frame))

    assert run(verb, "a", "-s", "4", "--width", "2", "--gold").exit_code == 0
    name, paint, frame = made[0]
    assert (name, paint.side_px, paint.kind, paint.secret, paint.settings.seed) == ("a", 4, "oil", 3, 5)
    assert frame == Frame(2, True)
    assert attributes_of(Frame) == {"width_px": "Width of the frame, in pixels.", "gold": "Gild it."}

    def verb(context: typer.Context, frame: Frame) -> None: ...

    assert "Width of the frame, in pixels." in run(verb, "--help").output

    def verb(context: typer.Context, paint: Annotated[Paint, Only("kind")]) -> None:
        assert paint.side_px == 8

    assert run(verb, "--kind", "ink").exit_code == 0
    assert run(verb, "--size", "4").exit_code == 2


@pytest.mark.parametrize(
    "wrong",
    [["--kind", "wax"], ["--size", "0"], ["--secret", "1"], []],
    ids=lambda w: " ".join(w) or "missing",
)
def test_limits_hold(wrong: list[str]) -> None:
    def verb(context: typer.Context, paint: Paint, frame: Frame) -> None: ...

    width = ["--width", "2"] if wrong else []
    assert run(verb, *wrong, *width).exit_code == 2


def test_no_two_verbs_write_one_name() -> None:
    photo = PhotoOptions(Settings())
    works = (Segment, FitGeometry, EstimateLight, MakePage, partial(PredictStacks, page=True))
    ends = [end for make in works for end in make(photo=photo).endings]
    ends += ["_relight/info.json"]
    assert len(set(ends)) == len(ends)
    verbs = [kind(photo=photo) for kind in (Segment, FitGeometry, EstimateLight, PredictStacks)]
    endings = Counter(ending for verb in verbs for ending in verb.endings)
    assert max(endings.values()) == 1


@dataclass(frozen=True)
class Picture:
    paint: Annotated[Paint, Without("kind")]
    share: float = option(0.5, "Share.", typed=float, default_text=50.0, parse=lambda percent: percent / 100)
    words: tuple[str, ...] = option((), "Words.", parse=lambda text: tuple(text.split(",")))
    shape: Literal["round", "square"] = option("round", "Shape.", typed=Literal["round", "square"] | None)


def test_groups_hold_groups_and_parse_what_is_typed() -> None:
    made: list[Picture] = []

    def verb(picture: Picture) -> None:
        made.append(picture)

    assert run(verb).exit_code == 0
    assert run(verb, "--size", "3", "--share", "20", "--words", "a,b", "--shape", "square").exit_code == 0
    plain, given = made
    assert plain == Picture(Paint(Settings(seed=5)))
    assert given == Picture(Paint(Settings(seed=5), side_px=3), 0.2, ("a", "b"), "square")
    assert run(verb, "--kind", "ink").exit_code == run(verb, "--shape", "flat").exit_code == 2
