"""Golden outputs: run every verb of facerf on small inputs, and compare two such folders value by value.

    python tools/golden.py make BEFORE --checkout PATH_OF_AN_OLDER_CHECKOUT
    python tools/golden.py make AFTER
    python tools/golden.py compare BEFORE AFTER

`make OUT` runs the code of `--checkout` (by default the one that this file stands in) in subprocesses, one
process a line of golden.toml, in order, with OUT as working folder. The results of a run are in OUT/NAME, its
exit status in OUT/NAME/exit.json, and what it printed in OUT/NAME/log.txt (not compared). `--only VERB,...`
takes verbs (relight) or names of runs (relight-maps) and adds to an OUT that exists: runs read each other's
results (a stack, a dataset, a trained checkpoint), so make the whole of OUT once, then repeat with --only.
`--photos FOLDER ...` adds the runs of [photos] for each photo in the folders. The whole takes about 6 minutes
on an idle core, and 20 s more for each photo.

`compare A B` prints a line for each file that differs, with the largest difference of its values, then the
counts; it exits 1 on any difference. `--only` is as above. `--within X` takes differences up to X of a file's
largest value for equal. Compared are: pixels, channels and numbers of every part of an image, frames of
videos, arrays of .npz and .safetensors, numbers of .json, .jsonl and .csv by their names (not words, nor the
names in TIMES), vertices of .glb and .obj, numbers of text. A page is compared by its size, within 1 %.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parents[1]
TIMES = re.compile(
    r"seconds|time|waiting|^files$|_s$|version|sha256|digest|memory|bytes|per_second|date", re.IGNORECASE
)
NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e[-+]?\d+)?(?![\w.])", re.IGNORECASE)

# Words in names of runs, files, layers and numbers: old, new. `compare` translates the names in A.
RENAMED = {
    "film": "video",
    "own": "original",
    "around": "uniform",
    "even": "delight",
    "room": "ambient",
    "white": "white-balance",
}
OLD_WORD = re.compile(rf"(?<![a-z])({'|'.join(RENAMED)})(?![a-z])")

TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
RUNS: dict[str, str] = TABLE["runs"]


def write_inputs(out: Path, checkout: Path) -> None:
    """Write small photos, frames, a video, a group, flashes of Extended Yale B and a folder of truths."""
    import av
    from PIL import Image

    whole = Image.open(checkout / "examples/astronaut.jpg").convert("RGB")
    photo = whole.crop((96, 0, 352, 224))
    photo.save(out / "photo.png")
    group = Image.new("RGB", (512, 224))
    group.paste(photo, (0, 0))
    group.paste(photo.transpose(Image.Transpose.FLIP_LEFT_RIGHT), (256, 0))
    group.save(out / "group.png")
    Image.fromarray((np.indices((224, 256))[1] > 120).astype(np.uint8) * 255).save(out / "mask.png")
    for folder in ("plates", "maps", "truths"):
        (out / folder).mkdir()
    for path in sorted((checkout / "examples/maps").glob("s*.exr")):
        shutil.copy(path, out / "maps")
    shutil.copy(checkout / "examples/maps/low_sun.exr", out / "sun.exr")
    photo.save(out / "truths/photo_light_70_20.png")
    frames = [whole.crop((110 + 2 * i, 10, 334 + 2 * i, 202)) for i in range(3)]
    with av.open(str(out / "video.mov"), "w") as container:
        stream: Any = container.add_stream("prores_ks", rate=25)
        stream.width, stream.height, stream.pix_fmt = 224, 192, "yuv422p10le"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(frame)))  # type: ignore[no-untyped-call]
        container.mux(stream.encode(None))
    from OpenImageIO import FLOAT, ImageOutput, ImageSpec

    for number, frame in enumerate(frames[:2]):
        plate = str(out / f"plates/plate.{1001 + number}.exr")
        stream = ImageOutput.create(plate)
        stream.open(plate, ImageSpec(224, 192, 3, FLOAT))
        stream.write_image((np.asarray(frame) / np.float32(255)) ** np.float32(2.2))
        stream.close()
    face = np.asarray(whole.crop((140, 20, 308, 212)).convert("L"), np.float32)
    subject = out / "yale/yaleB05"
    subject.mkdir(parents=True)
    for name, side in (("A+000E+00", 0), ("A-025E+00", -1), ("A+025E+00", 1)):  # a ramp from the lit side
        lit = (face * (1 + side * np.linspace(-0.5, 0.5, 168))).clip(0, 255).astype(np.uint8)
        (subject / f"yaleB05_P00{name}.pgm").write_bytes(b"P5\n168 192\n255\n" + lit.tobytes())
    (subject / "yaleB05_P00.info").write_text("a list\n")


def fewer_cameras(capture: Path, to: Path) -> None:
    """Copy a capture with two of its cameras."""
    described = json.loads((capture / "stage.json").read_text())
    described["cameras"] = [described["cameras"][index] for index in (0, 2)]
    shutil.rmtree(to, ignore_errors=True)
    for subject in described["subjects"]:
        for camera in described["cameras"]:
            shutil.copytree(capture / subject / camera["id"], to / subject / camera["id"])
    (to / "stage.json").write_text(json.dumps(described))


def add_photos(folders: Sequence[Path]) -> None:
    """Add the runs of each photo in the folders."""
    for path in sorted(path for folder in folders for path in folder.iterdir()):
        if path.suffix.lower() in (".jpg", ".png"):
            for name, line in TABLE["photos"].items():
                RUNS[f"{name}-{path.stem}"] = line.replace("{photo}", str(path.resolve()))


def chosen(only: str) -> list[str]:
    """Names of the runs whose name, or whose verb, is among `only`; without words all but the slow ones."""
    words = [word for word in only.split(",") if word]
    quick = [name for name in RUNS if name not in TABLE["slow"]["runs"]]
    named = [name for name, line in RUNS.items() if name in words or line.split()[0] in words]
    names = named if words else quick
    if not names:
        raise SystemExit(f"--only {only}: no such verb or run; the runs are {', '.join(RUNS)}")
    return names


def line_of(name: str) -> list[str]:
    """Return the words of a run after `facerf`."""
    line = RUNS[name]
    for word, meaning in reversed(TABLE["words"].items()):  # a word is made of earlier ones
        line = line.replace(f"{{{word}}}", meaning)
    return line.format(to=name).split()


def make(out: Path, checkout: Path, only: str) -> None:
    """Run the lines in `out`; a line that fails is said, and its status is part of the golden output."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "photo.png").exists():
        write_inputs(out, checkout.resolve())
    fixed = {"PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    environment = os.environ | fixed | {"XDG_CACHE_HOME": str(out.resolve() / ".cache"), "COLUMNS": "100"}
    for name in chosen(only):
        target = out / name
        if name != "train-resume":
            shutil.rmtree(target, ignore_errors=True)
        if name in TABLE["elsewhere"]:
            shutil.rmtree(out / TABLE["elsewhere"][name], ignore_errors=True)
        if name == "describe":
            fewer_cameras(out / "synth-stage", out / "capture")
        words = line_of(name)
        started = time.monotonic()
        command = [sys.executable, "-P", "-m", "facerf_cli", "--device", "cpu", *words]
        done = subprocess.run(
            command, cwd=out, env=environment, capture_output=True, stdin=subprocess.DEVNULL
        )
        target.mkdir(exist_ok=True)
        (target / "log.txt").write_bytes(done.stdout + b"\n" + done.stderr)
        (target / "exit.json").write_text(json.dumps({"exit": done.returncode}))
        line = done.stderr.decode(errors="replace").strip().splitlines()[-1:] if done.returncode else []
        print(f"{name:30} exit {done.returncode} {time.monotonic() - started:6.1f} s", *line, flush=True)


Values = dict[str, np.ndarray]


def image_values(path: Path) -> Values:
    """Pixels of every part by channel, and the numbers of its header."""
    import OpenImageIO as oiio

    stream, values = oiio.ImageInput.open(str(path)), {}
    if stream is None:
        raise ValueError(oiio.geterror())
    part = 0
    while stream.seek_subimage(part, 0):
        spec = stream.spec()
        pixels = stream.read_image(part, 0, 0, spec.nchannels, "float")
        for place, channel in enumerate(spec.channelnames):
            values[f"{part}.{channel}"] = np.asarray(pixels)[..., place]
        for attribute in spec.extra_attribs:
            if isinstance(attribute.value, int | float | tuple) and not TIMES.search(attribute.name):
                values[f"{part}.{attribute.name}"] = np.asarray(attribute.value, np.float64).ravel()
        part += 1
    stream.close()
    return values


def video_values(path: Path) -> Values:
    """Frames of a video."""
    import av

    with av.open(str(path)) as container:
        return {str(i): frame.to_ndarray(format="rgb24") for i, frame in enumerate(container.decode(video=0))}


def array_values(path: Path) -> Values:
    """Arrays of numbers of an .npz, an .npy or a .safetensors."""
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return {name: tensor.float().numpy() for name, tensor in load_file(path).items()}
    loaded = np.load(path)
    arrays = dict(loaded) if path.suffix == ".npz" else {"array": loaded}
    return {name: array for name, array in arrays.items() if array.dtype.kind in "biuf"}


def mesh_values(path: Path) -> Values:
    """Vertices and triangles of a mesh."""
    import trimesh

    scene: Any = trimesh.load(path, process=False, force="mesh")
    return {"vertices": np.asarray(scene.vertices), "faces": np.asarray(scene.faces)}


def number_values(path: Path) -> Values:
    """Numbers of JSON by their path, of JSON lines by `item`, of other text in order."""
    text = path.read_text(errors="replace")
    if path.suffix == ".json":
        return {name: np.array([number], np.float64) for name, number in numbers_of(json.loads(text), "")}
    if path.suffix == ".jsonl":
        rows = [json.loads(line) for line in text.splitlines()]
        rows.sort(key=lambda row: str(row.get("item", "")))
        return {name: np.array([number], np.float64) for name, number in numbers_of(rows, "")}
    return {"numbers": np.array([float(word) for word in NUMBER.findall(text)])}


def numbers_of(content: Any, name: str) -> Iterator[tuple[str, float]]:
    """Yield each number below `content` with its path, but for those whose name is of time or version."""
    if isinstance(content, bool | int | float):
        yield name, float(content)
    elif isinstance(content, dict | list):
        pairs = content.items() if isinstance(content, dict) else enumerate(content)
        for key, value in pairs:
            if not TIMES.search(str(key)):
                yield from numbers_of(value, f"{name}/{key}")


READERS: dict[str, Callable[[Path], Values]] = {
    **dict.fromkeys((".exr", ".png", ".tif", ".tiff", ".jpg", ".hdr"), image_values),
    **dict.fromkeys((".mp4", ".mov"), video_values),
    **dict.fromkeys((".npz", ".npy", ".safetensors"), array_values),
    **dict.fromkeys((".glb", ".obj"), mesh_values),
    **dict.fromkeys((".json", ".jsonl", ".csv", ".txt", ".toml", ".xml", ".md"), number_values),
}


def renamed(name: str) -> str:
    """Return a name with its old words replaced."""
    return OLD_WORD.sub(lambda match: RENAMED[match[0]], name)


def difference(a: Path, b: Path) -> tuple[float, str]:
    """Return the largest difference of two files as a share of their largest value, and its words."""
    if a.suffix not in READERS:  # a page, a script: its size within a hundredth
        sizes = [path.stat().st_size for path in (a, b)]
        share = abs(sizes[0] - sizes[1]) / max(*sizes, 1)
        return (share if share > 0.01 else 0.0), f"{sizes[0]} and {sizes[1]} bytes"
    before, after = READERS[a.suffix](a), READERS[a.suffix](b)
    before = {renamed(name): values for name, values in before.items()}
    if odd := sorted(before.keys() ^ after.keys()):
        return np.inf, f"{len(odd)} names in one alone: {', '.join(odd[:3])}"
    worst = 0.0, ""
    for name, old in before.items():
        new = after[name]
        if old.shape != new.shape:
            return np.inf, f"{name}: {old.shape} and {new.shape}"
        old, new = old.astype(np.float64), new.astype(np.float64)
        apart = np.where((old == new) | (np.isnan(old) & np.isnan(new)), 0.0, np.abs(old - new))
        if (largest := float(np.nan_to_num(apart, nan=np.inf, posinf=np.inf).max(initial=0.0))) > 0:
            scale = max(float(np.nanmax(np.abs(values))) for values in (old, new))
            count = f"{np.count_nonzero(apart)} of {apart.size}"
            worst = max(worst, (largest / scale, f"{name}: by {largest:.3g} of {scale:.3g}, {count}"))
    return worst


def files_of(folder: Path, only: str, rename: Callable[[str], str] = str) -> dict[str, Path]:
    """Files of results by name in a folder of `make`: of chosen runs, or of all."""
    wanted = chosen(only) if only else None
    left_out = re.compile(r"^\.|/\.|log\.txt$|/events\.out")
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    files = {rename(name): path for name, path in paths.items() if not left_out.search(name)}
    return {name: path for name, path in files.items() if not wanted or name.split("/")[0] in wanted}


def compare(a: Path, b: Path, only: str, within: float) -> int:
    """Print what differs and the counts; 1 where anything does."""
    before, after = files_of(a, only, renamed), files_of(b, only)
    equal = differ = 0
    for name in sorted(before.keys() & after.keys()):
        try:
            share, words = difference(before[name], after[name])
        except Exception as error:  # a file that one cannot read is a difference
            share, words = np.inf, f"cannot be read: {error}"
        if share <= within:
            equal += 1
        else:
            differ += 1
            print(f"differs {share:8.2g}  {name}  {words}")
    missing = sorted(before.keys() ^ after.keys())
    for name in missing:
        print(f"missing in {b if name in before else a}: {name}")
    print(f"{equal} equal, {differ} differ, {len(missing)} missing")
    return int(bool(differ or missing))


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    making, comparing = verbs.add_parser("make"), verbs.add_parser("compare")
    making.add_argument("out", type=Path)
    making.add_argument("--checkout", type=Path, default=HERE)
    making.add_argument("--photos", type=Path, nargs="+", default=[], metavar="FOLDER")
    comparing.add_argument("a", type=Path)
    comparing.add_argument("b", type=Path)
    comparing.add_argument("--within", type=float, default=0.0)
    for verb in (making, comparing):
        verb.add_argument("--only", default="")
    given = parser.parse_args()
    if given.verb == "make":
        add_photos(given.photos)
        make(given.out, given.checkout, given.only)
        return 0
    return compare(given.a, given.b, given.only, given.within)


if __name__ == "__main__":
    sys.exit(main())
