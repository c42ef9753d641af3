"""Small sound files for each door, which the campaign damages; made here or by facerf's own writers."""

import io
import json
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import OpenImageIO as oiio
import tifffile
import torch
from PIL import Image
from safetensors.torch import save

from facerf_cli.evaluation.report import FORMAT
from facerf_cli.face.fit import fit_from_arrays, save_fit
from facerf_cli.face.importers.ict import VERTICES
from facerf_cli.face.morphable import BUILTIN_PATH
from facerf_cli.files.image_metadata import embed_xmp
from facerf_cli.files.light_files import Harmonics, LightRecord, write_light
from facerf_cli.files.olat_stack import StackHeader, write_olat_stack
from facerf_cli.files.write import linear_profile, write_display, write_exr
from facerf_cli.image.colour import LINEAR_P3
from facerf_cli.light.sh import CONVENTION
from facerf_cli.light.sphere import rig_directions
from facerf_cli.network.checkpoint import save_networks
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork, DefaultReflectanceSettings

Samples = dict[str, bytes]  # files by name
_HEIGHT, _WIDTH, _LIGHTS = 12, 24, 3
_TESTS = Path(__file__).parents[2] / "tests" / "files"
_RIGS = BUILTIN_PATH.parent / "rigs"


def _draw() -> np.random.Generator:
    return np.random.default_rng(0)


def _written(write: Callable[[Path], object], *names: str) -> Samples:
    """What `write` puts under each name into a folder."""
    files = {}
    with TemporaryDirectory() as folder:
        for name in names:
            write(Path(folder) / name)
            files[name] = (Path(folder) / name).read_bytes()
    return files


def _oiio(path: Path, kind: str = "uint8", **attributes: Any) -> None:
    channels = attributes.pop("channels", 3)
    spec = oiio.ImageSpec(_WIDTH, _HEIGHT, channels, kind)
    if attributes.pop("tiles", False):
        spec.tile_width = spec.tile_height = 16
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    stream = oiio.ImageOutput.create(str(path))
    assert stream is not None and stream.open(str(path), spec), path
    stream.write_image(_draw().random((_HEIGHT, _WIDTH, channels), np.float32))
    stream.close()


@cache
def images() -> Samples:
    """An image of each format and of the compressions of EXR and TIFF."""
    files: Samples = {}
    for name in ("a.jpg", "a.tif", "a.webp", "a.tga", "a.dpx", "a.ppm", "a.pgm", "a.jxl", "a.hdr"):
        channels = 1 if name.endswith("pgm") else 3
        try:
            files |= _written(lambda path, c=channels: _oiio(path, channels=c), name)  # type: ignore[misc]
        except AssertionError:
            continue  # this OpenImageIO does not write it
    for kind in ("zip", "zips", "rle", "piz", "pxr24", "b44", "dwaa", "none"):
        files |= _written(lambda path, k=kind: _oiio(path, "half", compression=k), f"{kind}.exr")  # type: ignore[misc]
    files |= _written(lambda path: _oiio(path, "float", tiles=True, compression="zip"), "tiled.exr")
    for kind in ("lzw", "packbits", "none"):
        files |= _written(lambda path, k=kind: _oiio(path, "uint16", compression=k), f"{kind}.tif")  # type: ignore[misc]
    files |= _written(lambda path: _oiio(path, "uint16", channels=4, Orientation=6), "four.png")
    pixels = _draw().random((_HEIGHT, _WIDTH, 3), np.float32)
    layers = {"normal": pixels, "depth": pixels[..., 0], "uv": pixels[..., :2]}
    files |= _written(lambda path: write_exr(path, pixels, pixels[..., 0], layers), "layers.exr")
    files |= _written(lambda path: write_display(path, pixels), "shown.png", "shown.jpg")
    files |= _written(lambda path: (_oiio(path), embed_xmp(path, {"Software": "x"})), "xmp.png", "xmp.jpg")
    profile = _profile()
    files |= _written(lambda path: _with_profile(path, profile), "icc.png", "icc.jpg", "icc.tif")
    return files | _stated()


def _stated() -> Samples:
    """Images whose header says more than size and format."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nCOLORCORR=1 2 1\nPIXASPECT=2\n"
    head += b"PRIMARIES=.708 .292 .17 .797 .131 .046 .3127 .329\n\n+X 4 -Y 24\n"
    files = {"runs.hdr": head + 4 * bytes([9, 8, 7, 128, 1, 1, 1, 23])}
    files |= _written(lambda path: _oiio(path, "half", PixelAspectRatio=2.0), "wide.exr")
    chunks = {b"gAMA": 45455, b"cHRM": 31270}
    body = b"".join(
        _chunk(kind, struct.pack(">I", value) * (8 if kind == b"cHRM" else 1))
        for kind, value in chunks.items()
    )
    sound = _written(_oiio, "a.png")["a.png"]
    files["primaries.png"] = sound[:33] + body + sound[33:]
    files["multiplied16.jxl"] = (_TESTS / "multiplied16.jxl").read_bytes()
    files["codes.png"] = sound[:33] + _chunk(b"cICP", bytes([9, 14, 0, 0])) + sound[33:]
    values = (255 * _draw().random((_HEIGHT, _WIDTH, 5))).astype(np.uint8)
    kinds = {"separated": values, "miniswhite": values[..., :2].astype(np.uint16)}
    for name, stored in kinds.items():
        files |= _written(
            lambda path, n=name, s=stored: tifffile.imwrite(
                path, s, photometric=n, extrasamples=["assocalpha"]
            ),  # type: ignore[misc]
            f"{name}.tif",
        )
    return files


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@cache
def phone_photos() -> Samples:
    """A HEIC photo; each is decoded in a process of its own."""
    return {"a.heic": (_TESTS / "phone.heic").read_bytes()}


@cache
def avif() -> Samples:
    """AVIF images: deep ones of the tests; with alpha and a profile, grey, multiplied and turned ones."""
    files = {name: (_TESTS / name).read_bytes() for name in ("deep.avif", "multiplied.avif", "limited.avif")}
    values = _draw().integers(0, 256, (_HEIGHT, _WIDTH, 4), np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    kinds = {
        "alpha.avif": (values, {"icc_profile": _profile()}),
        "grey.avif": (values[..., 0], {}),
        "multiplied8.avif": (values, {"alpha_premultiplied": True}),
        "turned.avif": (values[..., :3], {"exif": exif}),
    }
    for name, (stored, options) in kinds.items():
        files |= _written(lambda path, v=stored, o=options: Image.fromarray(v).save(path, **o), name)  # type: ignore[misc]
    return files


def _profile() -> bytes:
    return linear_profile(LINEAR_P3)


def _with_profile(path: Path, profile: bytes) -> None:
    spec = oiio.ImageSpec(_WIDTH, _HEIGHT, 3, "uint8")
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), np.frombuffer(profile, np.uint8))
    stream = oiio.ImageOutput.create(str(path))
    stream.open(str(path), spec)
    stream.write_image(_draw().random((_HEIGHT, _WIDTH, 3), np.float32))
    stream.close()


@cache
def fit_arrays() -> dict[str, np.ndarray]:
    """The arrays of a fit."""
    draw = _draw()
    return {
        "model": np.array("builtin"),
        "error_iod": np.float32(0.02),
        "x0_px": np.array(3.0),
        "y0_px": np.array(4.0),
        "side_px": np.array(64.0),
        "size_px": np.array(64),
        "rotation": np.eye(3, dtype=np.float32),
        "translation_m": np.array([0, 0, -1], np.float32),
        "alpha": draw.normal(size=8).astype(np.float32),
        "beta": draw.normal(size=4).astype(np.float32),
        "landmarks_px": draw.random((68, 2)).astype(np.float32) * 60,
    }


@cache
def stacks() -> Samples:
    """An OLAT stack."""
    draw = _draw()
    normals = draw.normal(size=(_HEIGHT, _WIDTH, 3))
    header = StackHeader(
        kind="texture",
        directions=rig_directions(_LIGHTS).numpy().astype(np.float64),
        rotation=np.eye(3),
        source=draw.random((_HEIGHT, _WIDTH, 3)),
        seen=draw.random((_HEIGHT, _WIDTH)),
        normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        layout_version=1,
        fit=fit_arrays(),
        metadata={"facerf:input": "a.jpg", "facerf:synthetic": 1, "Software": "facerf"},
    )
    olats = torch.from_numpy(draw.random((_LIGHTS, 3, _HEIGHT, _WIDTH)))
    return _written(lambda path: write_olat_stack(path, header, [olats]), "a_olat.exr")


@cache
def lights() -> Samples:
    """JSON lights: a rig, coefficients, and both."""
    rig, weights = rig_directions(6), torch.rand(6, 3, generator=torch.Generator().manual_seed(0))
    sh = Harmonics(torch.linspace(-1, 1, 27).reshape(9, 3), CONVENTION)
    none = torch.zeros(0, 3)
    records = {
        "both.json": LightRecord(rig, weights, "six", sh, {"facerf:input": "a.jpg", "facerf:version": "1"}),
        "rig.json": LightRecord(rig, weights, "six"),
        "sh.json": LightRecord(none, none, sh=sh),
    }
    files: Samples = {}
    for name, record in records.items():
        files |= _written(lambda path, r=record: write_light(path, r), name)  # type: ignore[misc]
    return files


@cache
def landmarks() -> Samples:
    """68 landmarks as .pts and JSON."""
    points = fit_arrays()["landmarks_px"].tolist()
    rows = "".join(f"{x:.3f} {y:.3f}\n" for x, y in points)
    return {
        "a.pts": f"version: 1\nn_points: 68\n{{\n{rows}}}\n".encode(),
        "a.json": json.dumps(points).encode(),
        "b.json": json.dumps({"landmarks": points}).encode(),
    }


@cache
def light_lists() -> Samples:
    """LP files and lists of directions."""
    rows = [
        f"image_{n:02d}.jpg {x:.4f} {y:.4f} {z:.4f}" for n, (x, y, z) in enumerate(rig_directions(5).tolist())
    ]
    bare = "# lights\n" + "\n".join(row.split(" ", 1)[1].replace(" ", ", ") for row in rows)
    return {"a.lp": "\n".join(["5", *rows]).encode(), "lights.txt": bare.encode()}


@cache
def shifts() -> Samples:
    """Shifts of Extended Yale B, and facts of evaluated images."""
    return {
        "shifts.csv": b"subject,light,dy,dx\nyaleB01,A-130E+20,2,-1\nyaleB02,A+000E+00,0,3\n",
        "facts.csv": b"name,person,age,tone\na,p1,31,light\nb,p2,40,\n",
    }


@cache
def directions() -> Samples:
    """A file of `--lights`."""
    return {"lights.csv": b"# az,el\n0,0\n30,10\n-45.5 20\n"}


@cache
def checkpoints() -> Samples:
    """A small reflectance network, and a file of tensors without networks."""
    settings = DefaultReflectanceSettings(
        side=16, encoder_widths=(4, 8), decoder_widths=(4, 8), template_channels=1, rig_lights=4
    )
    network = DefaultReflectanceNetwork(settings)
    metadata = {"layout_version": 1, "provenance": {"licence": "MIT"}, "metrics": {"l1": 0.1}}
    files = _written(lambda path: save_networks(path, {"reflectance": network}, metadata), "a.safetensors")
    bare = {"format": "facerf-checkpoint-1", "facerf": json.dumps({"networks": {}, "layout_version": 1})}
    files["b.safetensors"] = save({"w": torch.zeros(3, 4), "n": torch.arange(4)}, bare)
    return files


@cache
def fits() -> Samples:
    """A fit as .npz."""
    return _written(lambda path: save_fit(path, fit_from_arrays(fit_arrays())), "fit.npz")


@cache
def arrays() -> Samples:
    """Images as .npy."""
    files = {}
    for name, kind in (("a.npy", np.float32), ("b.npy", np.float16)):
        file = io.BytesIO()
        np.save(file, _draw().random((_HEIGHT, _WIDTH, 3)).astype(kind))
        files[name] = file.getvalue()
    return files


@cache
def face_models() -> Samples:
    """The built-in face model with few coefficients."""
    with np.load(BUILTIN_PATH, allow_pickle=False) as file:
        kept = {key: file[key][:2] if key in ("identity", "expression") else file[key] for key in file.files}
    if "expression_names" in kept:
        kept["expression_names"] = kept["expression_names"][:2]
    return _written(lambda path: np.savez_compressed(path, **kept), "model.npz")


@cache
def _grid(side: int = 21) -> tuple[np.ndarray, np.ndarray]:
    """A bent sheet in metres: vertices [N, 3] and triangles [F, 3]."""
    y, x = np.meshgrid(np.linspace(-0.1, 0.1, side), np.linspace(-0.08, 0.08, side), indexing="ij")
    mean = np.stack([x, -y, 0.05 - 3 * (x**2 + y**2)], -1).reshape(-1, 3)
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return mean, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


@cache
def flame() -> Samples:
    """FLAME's tables as a pickle of numpy arrays and as .npz, and embeddings of its landmarks."""
    import pickle

    mean, triangles = _grid()
    tables = {"v_template": mean, "f": triangles, "shapedirs": _draw().normal(size=(len(mean), 3, 6)) / 1e3}
    points = {"lmk_face_idx": np.arange(51), "lmk_b_coords": np.full((51, 3), 1 / 3)}
    embedding = {"static_lmk_faces_idx": np.arange(51), "static_lmk_bary_coords": np.full((51, 3), 1 / 3)}
    npz, npy = io.BytesIO(), io.BytesIO()
    np.savez(npz, **tables)
    np.save(npy, np.array(embedding, dtype=object), allow_pickle=True)
    return {
        "flame.pkl": pickle.dumps(tables, 2),
        "newer.pkl": pickle.dumps(tables, 4),
        "flame.npz": npz.getvalue(),
        "embedding.npy": npy.getvalue(),
        "embedding.pkl": pickle.dumps(points, 2),
    }


@cache
def basel_2009() -> Samples:
    """`01_MorphableModel.mat`, compressed and not."""
    import scipy.io

    mean, triangles = _grid()
    tables = {
        "shapeMU": (mean * 1e6).reshape(-1, 1).astype(np.float32),
        "shapePC": np.linalg.qr(_draw().normal(size=(mean.size, 5)))[0].astype(np.float32),
        "shapeEV": np.ones((5, 1), np.float32),
        "tl": (triangles + 1).astype(np.float64),
    }
    files = {}
    for name, compressed in (("plain.mat", False), ("small.mat", True)):
        file = io.BytesIO()
        scipy.io.savemat(file, tables, do_compression=compressed)
        files[name] = file.getvalue()
    return files


@cache
def basel_2017() -> Samples:
    """`model2017-1.h5`."""
    import h5py

    mean, triangles = _grid()
    basis = np.linalg.qr(_draw().normal(size=(mean.size, 5)))[0].astype(np.float32)
    marks = [{"id": "center.nose.tip", "coordinates": (1000 * mean[40]).tolist()}]
    tables = {
        "shape/model/mean": (1000 * mean).ravel(),
        "shape/model/pcaBasis": basis,
        "shape/model/pcaVariance": np.ones(5),
        "shape/representer/cells": triangles.T.astype("i4"),
        "expression/model/mean": np.zeros(mean.size),
        "expression/model/pcaBasis": basis,
        "expression/model/pcaVariance": np.ones(5),
        "metadata/landmarks/json": json.dumps(marks),
    }
    file = io.BytesIO()
    with h5py.File(file, "w") as written:
        for name, values in tables.items():
            written.create_dataset(name, data=values)
    return {"model.h5": file.getvalue()}


@cache
def ict() -> Samples:
    """ICT-FaceKit's archives with three shapes."""
    plain = b"v 0.5 1 2\n" * VERTICES + b"f 1/1 2/2 3/3\n"
    members = {
        f"ICT/FaceXModel/{stem}.obj": plain for stem in ("generic_neutral_mesh", "identity000", "jawOpen")
    }
    zipped, files = io.BytesIO(), {}
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    for name, mode in (("a.tar.gz", "w:gz"), ("a.tar.xz", "w:xz")):
        file = io.BytesIO()
        with tarfile.open(fileobj=file, mode=mode) as tar:  # type: ignore[call-overload]
            for member, content in members.items():
                entry = tarfile.TarInfo(member)
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
        files[name] = file.getvalue()
    return {"a.zip": zipped.getvalue(), **files}


@cache
def stages() -> Samples:
    """`stage.json` of two cameras."""
    lights = [
        {"id": f"L{n:03d}", "direction": direction, "intensity": [1, 1, 1.5]}
        for n, direction in enumerate(rig_directions(4).double().tolist())
    ]
    pose = [[1, 0, 0, 0], [0, 1, 0, 0.1], [0, 0, 1, 1.2]]
    k = [[600, 0, 80], [0, 600, 80], [0, 0, 1]]
    cameras = [{"id": f"C{n}", "width": 160, "height": 160, "K": k, "world_to_camera": pose} for n in (0, 1)]
    content = {
        "format": "facerf-stage-1",
        "colour_space": "lin_rec709",
        "black_level": 0.01,
        "axes": "opencv",
        "unit": "m",
        "pattern": "{subject}/{camera}/{light}.exr",
        "lights": lights,
        "cameras": cameras,
        "subjects": {"0000": {"age": 30, "tone": "light"}},
        "provenance": {"made_by": "a campaign"},
    }
    return {"stage.json": json.dumps(content, indent=1).encode()}


@cache
def datasets() -> Samples:
    """`dataset.json` of two subjects."""
    lights = [
        {"id": f"L{n:03d}", "direction_world": direction}
        for n, direction in enumerate(rig_directions(4).double().tolist())
    ]
    done = {"status": "done", "traits": {"age": 30}, "cameras": ["C0", "C1"]}
    content = {
        "format": "facerf-dataset-1",
        "capture": "small",
        "face_model": "builtin",
        "crop_px": 64,
        "colour_space": "lin_rec709",
        "axes": "x right, y up, z toward the camera",
        "rig": {"lights": lights},
        "cameras": [{"id": "C0"}, {"id": "C1"}],
        "normalisation": {"from": "lin_rec709", "to": "lin_rec709", "black_level": 0.0},
        "splits": {"train": ["0000"], "validation": [], "test": ["0001"]},
        "subjects": {"0000": done, "0001": done | {"lights": ["L000", "L002"]}},
        "provenance": {"synthetic": True},
    }
    return {"dataset.json": json.dumps(content, indent=1).encode()}


@cache
def beside_datasets() -> Samples:
    """Files that a dataset names; only their presence is looked at."""
    places = [f"{subject}/{camera}" for subject in ("0000", "0001") for camera in ("C0", "C1")]
    return {f"olat/{place}.exr": b"x" for place in places} | {f"fits/{place}.npz": b"x" for place in places}


@cache
def dataset_of_pairs() -> Samples:
    """What stands beside `pairs.jsonl`."""
    return datasets() | beside_datasets()


@cache
def pairs() -> Samples:
    """`relit/pairs.jsonl` of that dataset."""
    row = {
        "subject": "0000",
        "index": 0,
        "split": "train",
        "source_camera": "C0",
        "envmap": "procedural:0:1:64",
        "rotate_deg": 12.5,
        "exposure_ev": -1,
        "target_camera": "C1",
        "target_light": 2,
    }
    rows = [row, row | {"index": 1, "target_light": 0}]
    return {"pairs.jsonl": "".join(json.dumps(entry) + "\n" for entry in rows).encode()}


@cache
def rigs() -> Samples:
    """The rigs that facerf ships."""
    return {path.name: path.read_bytes() for path in sorted(_RIGS.glob("*.toml"))}


@cache
def configurations() -> Samples:
    """Defaults of options."""
    text = "[relight]\nexposure = 'auto'\njobs = 2\n\n[evaluate.yale-b]\njobs = 5\n\n"
    text += "[global]\nseed = 3\n"
    return {"facerf.toml": text.encode()}


@cache
def indexes() -> Samples:
    """The index of an output folder."""
    rows = [
        {"file": "/a/x.jpg", "size": 10, "mtime_ns": 5, "inode": 7, "sha256": "ab" * 32},
        {"recipe": "r1", "of": {"verb": "segment", "options": {"bits": 8}, "files": {}}},
        {"output": "x.png", "verb": "segment", "sha256": "cd" * 32, "input": "ab" * 32, "recipe": "r1"},
    ]
    return {".facerf-index.jsonl": "".join(json.dumps(row) + "\n" for row in rows).encode()}


@cache
def reports() -> Samples:
    """The report of an output folder."""
    done = {"verb": "segment", "item": "x", "input": "in/x.jpg", "status": "done", "seconds": 0.1}
    rows = [
        done | {"error": None, "outputs": ["x.png"]},
        done | {"item": "y", "status": "failed", "error": "no"},
    ]
    return {"report.jsonl": "".join(json.dumps(row) + "\n" for row in rows).encode()}


@cache
def figures() -> Samples:
    """The figures of an evaluated item."""
    row = {"case": "a", "person": "p", "method": "field", "facts": {"tone": "light"}, "values": {"l1": 0.1}}
    strip = {
        "case": "a",
        "methods": ["field"],
        "scales": [1.0],
        "size_px": [10, 12],
        "has_source": True,
        "jpeg": "",
    }
    content = {"format": FORMAT, "rows": [row], "strips": [strip], "pictures": ["x.exr"]}
    return {"a.json": json.dumps(content).encode()}


@cache
def names() -> Samples:
    """Names of files, as bytes."""
    return {"name": b"a photo.0001.jpg", "other": "Fran\u00e7ois \u4e2d.exr".encode()}


@cache
def words() -> Samples:
    """Values of options."""
    texts = ("30,10", "0:360:24", "at=0.5,0.3,1;size=0.4;rgb=1,0.9,0.8", "from=20,10;name=key", "auto", "1.5")
    texts += (
        "{dir}/{stem}_{light}{frame:04}",
        "10,-5,3",
        "fibonacci:150",
        "0,0;10,20",
        "plate.1001-1050.exr",
    )
    texts += ("plate.%04d.exr", "3/8", "-0.5")
    return {str(number): value.encode() for number, value in enumerate(texts)}


@cache
def pages() -> Samples:
    """A page of `facerf view`, of which the index reads the strip."""
    from facerf_cli.viewer.page import page

    return {"a.html": page("a", ["a.jpg"], {"a": 1}, "data:image/jpeg;base64,AAAA").encode()}
