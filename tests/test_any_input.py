"""Readers with drawn and with stored damaged inputs: each is read, or refused in one printable line."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st

from facerf_cli.batch.inputs import Item, NamePattern
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.run import write_report
from facerf_cli.batch.settings import Shard
from facerf_cli.errors import FacerfError
from facerf_cli.evaluation.folders import read_facts
from facerf_cli.evaluation.report import images_csv, read_figures
from facerf_cli.face.fit import load_fit
from facerf_cli.face.importers.flame import read_embedding, read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION, grid_triangles
from facerf_cli.files.documents import read_rig
from facerf_cli.files.icc import space_of_profile
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.light_files import (
    read_map_file,
)
from facerf_cli.files.olat_stack import is_olat_stack, read_olat_header, read_olats
from facerf_cli.files.output_options import parse_exposure
from facerf_cli.files.read import read_array, read_image
from facerf_cli.files.texts import read_light_list
from facerf_cli.light.entries import lit_images, parse_lights
from facerf_cli.main import app, read_config
from facerf_cli.network.checkpoint import load_checkpoint, load_networks
from facerf_cli.run.logs import escaped, json_line, printable_line
from facerf_cli.work.photo_options import parse_pose

# The same examples each time, in a second or two.
DRAWN = settings(derandomize=True, max_examples=100, deadline=None, database=None)
TEXT = st.text(st.characters(codec=None), max_size=60)  # surrogates too, as names of files have them


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn")


def refused_or_read(read: Callable[[], object]) -> None:
    """Pass if the reader succeeds or raises an error of one printable line."""
    try:
        read()
    except FacerfError as error:
        assert printable_line(str(error)) and printable_line(str(error)).isprintable()


@DRAWN
@given(name=TEXT)
def test_a_row_of_any_text_is_one_printable_line(name: str) -> None:
    line = json_line({name: [name, math.inf]})
    assert line.isprintable() and len(line.splitlines()) == 1
    # Halves of a pair, which no name of a file has side by side, come back as the character.
    back = json.loads(line)
    joined = name.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
    assert back == {joined: [joined, None]}


@DRAWN
@given(text=TEXT)
def test_what_is_shown_is_printable(text: str) -> None:
    assert escaped(text).isprintable() and printable_line(text).isprintable()


@DRAWN
@given(
    pattern=TEXT, values=st.dictionaries(st.sampled_from(["dir", "stem", "ext", "frame"]), st.text("ab/."))
)
def test_a_pattern_stays_in_its_folder(pattern: str, values: dict[str, str]) -> None:
    inside = {name: value.replace("..", "").strip("/") for name, value in values.items()}
    try:
        parsed = NamePattern.parse(pattern, "--name")
    except FacerfError:
        return
    filled = parsed.filled(inside)
    assert not filled.startswith("/") and ".." not in Path(filled).parts


OPTIONS = {
    "--light": lambda text: lit_images([text]),
    "--exposure": parse_exposure,
    "--lights": parse_lights,
    "--pose": parse_pose,
    "--shard": Shard.parse,
}
# Text that looks like options more often than any text does.
LIKELY = st.lists(
    st.sampled_from(["1", "-", ".", ",", ";", ":", "e9", "from", "=", "at", "inf", "nan", "/", "٣", "0"]),
    max_size=12,
).map("".join)


@pytest.mark.parametrize("option", OPTIONS)
@DRAWN
@given(text=st.one_of(TEXT, LIKELY))
def test_any_value_of_an_option_is_read_or_refused(option: str, text: str) -> None:
    refused_or_read(lambda: OPTIONS[option](text.replace("\0", "")))


READERS = {
    "a.pts": read_landmarks,
    "a.lp": read_light_list,
    "a.toml": read_rig,
}


@pytest.mark.parametrize("name", READERS)
@DRAWN
@given(content=st.one_of(st.binary(max_size=80), TEXT.map(lambda text: text.encode(errors="replace"))))
def test_any_file_is_read_or_refused(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)
    refused_or_read(lambda: READERS[name](folder / name))


@DRAWN
@given(content=st.binary(max_size=300))
def test_any_profile_is_understood_or_not(content: bytes) -> None:
    space_of_profile(content, "drawn")
    header = bytes(36) + b"acsp" + bytes(88)
    space_of_profile(header + content, "drawn")


def _image(path: Path) -> None:
    read_header(path)
    is_olat_stack(path)
    read_image(path)


def _olat_stack(path: Path) -> None:
    is_olat_stack(path)
    read_olat_header(path)
    read_olats(path)


def _checkpoint(path: Path) -> None:
    load_checkpoint(path)
    load_networks(path, LAYOUT_VERSION)


def _flame(path: Path) -> None:
    if path.name.startswith("embedding"):
        read_embedding(path, load_face_model().mean.numpy(), grid_triangles().numpy())
    else:
        read_flame(path)


def _journal(path: Path) -> None:
    item, output = Item(path, path, path.name), path.with_name("x.png")
    output.write_bytes(b"x")
    journal = Journal(path.parent, "segment")
    journal.why(item, output, "key")
    journal.open([item])


def _report(path: Path) -> None:
    write_report(path.parent)


def _options(path: Path) -> None:
    text = path.read_bytes().decode("utf-8", "surrogateescape")
    for read in OPTIONS.values():
        refused_or_read(lambda read=read: read(text))


# Folders of tests/corpus: files that readers once failed on with a traceback, a crash or much memory.
CORPUS = Path(__file__).parent / "corpus"
OF_CORPUS: dict[str, Callable[[Path], object]] = {
    "AVIF": _image,
    "CSV_tables": read_facts,
    "FLAME": _flame,
    "ICT_FaceKit": read_ict_facekit,
    "OLAT_stacks": _olat_stack,
    "configuration": lambda path: read_config(path, typer.main.get_command(app)),
    "environment_maps": read_map_file,
    "figures": lambda path: images_csv(read_figures(path).rows),
    "files_of_lights": lambda path: parse_lights(str(path)),
    "fits": load_fit,
    "images": _image,
    "journals": _journal,
    "landmarks": read_landmarks,
    "npy_images": read_array,
    "options": _options,
    "report": _report,
    "rigs": lambda path: lit_images([str(path)]),
    "safetensors": _checkpoint,
}
STORED = sorted(path.relative_to(CORPUS) for path in CORPUS.rglob("*") if path.is_file())


@pytest.mark.parametrize("stored", STORED, ids=lambda path: path.as_posix())
def test_a_stored_finding_is_read_or_refused(stored: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(CORPUS / stored, tmp_path))
    refused_or_read(lambda: OF_CORPUS[stored.parts[0]](path))
