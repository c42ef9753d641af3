"""The doors: each reader of files or words that a user gives, with its sound samples and its faults."""

import io
import json
import os
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults import mutations, samples
from benchmarks.faults.mutations import Mutation
from benchmarks.faults.samples import Samples


@dataclass(frozen=True)
class Door:
    """A reader: `open` gets a file's path. `fixed` files stand beside the damaged one.

    `weight` is its share of a campaign's cases; heavy readers have less.
    """

    sound: Callable[[], Samples]
    open: Callable[[Path], object]
    faults: tuple[Mutation, ...] = (mutations.bytes_,)
    weight: float = 1.0
    fixed: Callable[[], Mapping[str, bytes]] = field(default=dict)


def _image(path: Path) -> None:
    from facerf_cli.files.image_metadata import read_header
    from facerf_cli.files.olat_stack import is_olat_stack
    from facerf_cli.files.read import read_image

    read_header(path)
    is_olat_stack(path)
    read_image(path)


def _stack(path: Path) -> None:
    from facerf_cli.files.olat_stack import is_olat_stack, read_olat_header, read_olats

    is_olat_stack(path)
    read_olat_header(path)
    read_olats(path)


def _light(path: Path) -> None:
    from facerf_cli.files.light_files import read_light_file

    read_light_file(path)


def _map(path: Path) -> None:
    from facerf_cli.files.light_files import read_map_file

    read_map_file(path)


def _landmarks(path: Path) -> None:
    from facerf_cli.face.landmarks import read_landmarks

    read_landmarks(path)


def _light_list(path: Path) -> None:
    from facerf_cli.capture.light_lists import match_lights
    from facerf_cli.files.texts import read_light_list

    match_lights(read_light_list(path), ["a", "b"], {"image_00": "a"})


def _table(path: Path) -> None:
    from facerf_cli.capture.yale_b import read_shifts
    from facerf_cli.evaluation.folders import read_facts

    (read_shifts if path.name == "shifts.csv" else read_facts)(path)


def _directions(path: Path) -> None:
    from facerf_cli.light.entries import parse_lights

    parse_lights(str(path))


def _checkpoint(path: Path) -> None:
    from facerf_cli.face.topology import LAYOUT_VERSION
    from facerf_cli.network.checkpoint import load_checkpoint, load_networks

    load_checkpoint(path)
    load_networks(path, LAYOUT_VERSION)


def _fit(path: Path) -> None:
    from facerf_cli.face.fit import load_fit

    load_fit(path)


def _array(path: Path) -> None:
    from facerf_cli.files.arrays import read_array

    read_array(path)


def _face_model(path: Path) -> None:
    from facerf_cli.face.morphable import load_face_model

    load_face_model(str(path))


def _flame(path: Path) -> None:
    from facerf_cli.face.importers.flame import read_embedding, read_flame

    if path.name.startswith("embedding"):
        mean, triangles = samples._grid()
        read_embedding(path, mean, triangles)
    else:
        read_flame(path)


def _basel_2009(path: Path) -> None:
    from facerf_cli.face.importers.basel import read_basel_2009

    read_basel_2009(path)


def _basel_2017(path: Path) -> None:
    from facerf_cli.face.importers.basel import read_basel_2017

    read_basel_2017(path)


def _ict(path: Path) -> None:
    from facerf_cli.face.importers.ict import read_ict_facekit

    read_ict_facekit(path)


def _stage(path: Path) -> None:
    from facerf_cli.capture.stage_json import read_stage

    read_stage(path.parent)


def _dataset(path: Path) -> None:
    from facerf_cli.dataset.dataset import read_dataset

    read_dataset(path.parent)


def _pairs(path: Path) -> None:
    from facerf_cli.dataset.dataset import read_dataset
    from facerf_cli.dataset.pairs import RELIT, read_pairs

    relit = path.parent / RELIT
    relit.mkdir(exist_ok=True)
    os.replace(path, relit / path.name)
    read_pairs(read_dataset(path.parent))


def _rig(path: Path) -> None:
    from facerf_cli.light.entries import lit_images

    lit_images([str(path)])


def _configuration(path: Path) -> None:
    import typer

    from facerf_cli.cli.installation import read_config
    from facerf_cli.main import app

    read_config(path, typer.main.get_command(app))


def _index(path: Path) -> None:
    from facerf_cli.batch.made_from import FolderIndex, keyed

    recipes, index = keyed([{"verb": "segment", "files": {}}]), FolderIndex(path.parent, "segment")
    index.why_again(path, [path.parent / "x.png"], recipes)
    index.open(recipes, has_work=True)


def _report(path: Path) -> None:
    from facerf_cli.batch.run import open_report

    open_report(path, "segment", [], [], lambda _: [])


def _figures(path: Path) -> None:
    from facerf_cli.evaluation.report import images_csv, read_figures

    images_csv(read_figures(path).rows)


def _names(path: Path) -> None:
    """The file's content is a name: of an input, in a report, a page and a message."""
    from facerf_cli.batch.inputs import PHOTO_SUFFIXES, NamePattern, collect_items
    from facerf_cli.batch.run import rows_of
    from facerf_cli.run.logs import json_line, printable_line
    from facerf_cli.viewer.page import IndexEntry, index_page

    name = os.fsdecode(path.read_bytes().replace(b"/", b"").replace(b"\0", b"")[:180]) + ".png"
    folder = path.parent / "photos"
    folder.mkdir(exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    (folder / name).write_bytes(b"x")
    out = path.parent / "out"
    if name.startswith("."):
        return
    (item,) = collect_items([str(folder)], out, PHOTO_SUFFIXES)
    pattern = NamePattern.parse("{dir}/{stem}_{ext}_{frame:04}", "--name")
    for made in (item.output("_relit.exr"), item.filled(pattern)):
        assert out in Path(os.path.normpath(made)).parents, f"out of the folder: {made!a}"
    report = path.parent / "report.jsonl"
    report.write_text(json_line({"verb": "x", "item": item.name}) + "\n", encoding="utf-8")
    (row,) = rows_of(report)
    assert row["item"] == json.loads(json_line({"item": item.name}))["item"]
    assert "<script>x" not in index_page([IndexEntry(f"<script>x{name}", name, "")])
    assert printable_line(name).isprintable()


def _words(path: Path) -> None:
    """The file's content is the value of an option."""
    from facerf_cli.batch.inputs import PHOTO_SUFFIXES, NamePattern, collect_items
    from facerf_cli.batch.settings import Shard
    from facerf_cli.errors import FacerfError
    from facerf_cli.light.entries import lit_images, parse_lights
    from facerf_cli.work.output_options import parse_exposure, parse_formats
    from facerf_cli.work.photo_options import parse_pose

    word = path.read_bytes().decode("utf-8", "surrogateescape").replace("\0", "")
    refused = None
    readers: tuple[Callable[[str], object], ...] = (
        lambda text: lit_images([text]),
        parse_exposure,
        parse_lights,
        parse_pose,
        parse_formats,
        Shard.parse,
        lambda text: NamePattern.parse(text, "--name").filled({"stem": "a", "frame": "7"}),
        lambda text: collect_items([text], path.parent / "out", PHOTO_SUFFIXES),
    )
    for read in readers:
        try:
            read(word)
        except FacerfError as error:
            refused = error
    if refused is not None:
        raise refused


def _page(path: Path) -> None:
    from facerf_cli.viewer.page import IndexEntry, index_page, strip_of

    strip = strip_of(path.read_text(encoding="utf-8", errors="replace"))
    index_page([IndexEntry("a", "a.html", strip)])


def _commands(path: Path) -> None:
    """The file's content is a command line, without files; only what typer and the verbs check first."""
    from facerf_cli.main import main

    words = path.read_bytes().decode("utf-8", "surrogateescape").replace("\0", "").split("\n")
    with redirect_stdout(io.StringIO()):
        code = main([*words[:12], "--dry-run", "-o", str(path.parent / "out"), "no-such-photo.png"])
    assert code in (0, 1, 2), f"exit code {code}"


def _command_lines() -> Samples:
    lines = {
        "segment": "segment\n--format\npng\n--overwrite\nchanged\n--jobs\n1",
        "estimate": "estimate-light\n--seed\n3\n--face\nlargest",
        "convert": "convert-light\nx.json\n--lights\n20",
        "relight": "relight\n--light\n30,10\n--exposure\nauto\n--name\n{stem}_{light}\n--shard\n1/2",
    }
    return {name: line.encode() for name, line in lines.items()}


def _npy_pixels() -> Samples:
    return {
        name: content for name, content in samples.arrays().items() if np.lib.format.MAGIC_PREFIX in content
    }


_JSON = (mutations.json_, mutations.json_, mutations.text, mutations.bytes_)
_TEXT = (mutations.text, mutations.text, mutations.bytes_)
_FITS = (mutations.zip_, mutations.zip_, mutations.bytes_)

DOORS: dict[str, Door] = {
    "images": Door(samples.images, _image, (mutations.png, mutations.bytes_), 6),
    "HEIC": Door(samples.phone_photos, _image, weight=0.03),
    "AVIF": Door(samples.avif, _image, weight=0.5),
    "environment maps": Door(samples.images, _map, (mutations.png, mutations.bytes_), 1),
    "OLAT stacks": Door(samples.stacks, _stack, (mutations.json_inside, mutations.bytes_), 3),
    "light JSON": Door(samples.lights, _light, _JSON, 2),
    "landmarks": Door(samples.landmarks, _landmarks, (*_JSON, mutations.text), 2),
    "LP files": Door(samples.light_lists, _light_list, _TEXT, 1),
    "CSV tables": Door(samples.shifts, _table, _TEXT, 1),
    "files of --lights": Door(samples.directions, _directions, _TEXT, 1),
    "safetensors": Door(samples.checkpoints, _checkpoint, (mutations.safetensors, mutations.bytes_), 2),
    "fits": Door(samples.fits, _fit, _FITS, 2),
    "npy images": Door(_npy_pixels, _array, (mutations.npy, mutations.bytes_), 1),
    "face models": Door(samples.face_models, _face_model, _FITS, 0.1),
    "FLAME": Door(samples.flame, _flame, (mutations.bytes_, mutations.bytes_, mutations.zip_), 0.2),
    "Basel 2009": Door(samples.basel_2009, _basel_2009, weight=0.02),
    "Basel 2017": Door(samples.basel_2017, _basel_2017, weight=0.02),
    "ICT-FaceKit": Door(samples.ict, _ict, (mutations.zip_, mutations.bytes_), 0.2),
    "stage.json": Door(samples.stages, _stage, _JSON, 2),
    "dataset.json": Door(samples.datasets, _dataset, _JSON, 2, samples.beside_datasets),
    "pairs.jsonl": Door(samples.pairs, _pairs, _JSON, 1, samples.dataset_of_pairs),
    "rigs": Door(samples.rigs, _rig, _TEXT, 2),
    "configuration": Door(samples.configurations, _configuration, _TEXT, 0.3),
    "index": Door(samples.indexes, _index, _JSON, 1),
    "report": Door(samples.reports, _report, _JSON, 1),
    "figures": Door(samples.figures, _figures, _JSON, 1),
    "names": Door(samples.names, _names, _TEXT, 1),
    "options": Door(samples.words, _words, _TEXT, 0.3),
    "command lines": Door(_command_lines, _commands, _TEXT, 0.2),
    "pages of view": Door(samples.pages, _page, _TEXT, 0.2),
}
