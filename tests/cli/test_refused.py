"""Lines that are refused in one line, before anything is written: for each verb a table of line -> words."""

import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from facerf_cli.network.checkpoint import save_checkpoint, save_networks
from facerf_cli.network.files import SHIPPED
from tests.astronaut import PATH as PHOTO
from tests.capture.yale_fixture import write_yale_b
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Folders, Patch, Said
from tests.worlds import write_flat_stage


@pytest.fixture(scope="module")
def place(tmp_path_factory: Folders) -> Path:
    """A folder with data/, stage/, photos, a map, facts, checkpoints, folders of images and a database."""
    folder = tmp_path_factory.mktemp("place")
    write_small_dataset(folder / "data", counts=(1, 0, 1), lights=12, crop_px=32)
    assert main(["relight-dataset", str(folder / "data"), "--envmaps", "procedural:2", "--lazy"]) == 0
    (folder / "stage").mkdir()
    write_flat_stage(folder / "stage", subjects={"0000": {}, "0001": {}})
    for name in ("a.jpg", "b.jpg", "one/c.jpg", "index/index.jpg"):
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copy(PHOTO, folder / name)
    (folder / "link.jpg").symlink_to("a.jpg")
    (folder / "who.csv").write_text("name,person\nastronot,Eileen\n")
    (folder / "empty").mkdir()
    for name in ("good/0.exr", "truth/0.exr"):
        write_exr(folder / name, np.ones((4, 5, 3), np.float32))
    write_exr(folder / "sky.exr", np.ones((8, 16, 3), np.float32))
    write_yale_b(folder / "yale")
    network = save_toy_checkpoint(folder / "toy.st")
    save_networks(folder / "other.st", {"reflectance": network}, {"layout_version": 99})
    described = {"reflectance": network.as_metadata()}
    save_checkpoint(folder / "torn.st", {}, {"layout_version": LAYOUT_VERSION, "networks": described})
    return folder


WRONG: dict[str, dict[str, str]] = {
    "": {
        "nonsense": "No such command 'nonsense'. (a command comes first",
        "--nonsense": "No such option: --nonsense",
        "doctor --nonsense": "see 'facerf doctor --help'",
        "--seed x doctor": "Invalid value for '--seed'",
        "--device abacus doctor": "--device abacus: ... use auto,",
        "-v -q doctor": "-v and -q: contradict each other",
        "--seed": "'--seed' requires an argument",
        "-v": "Missing command",
        "doctor extra": "unexpected extra argument(s) (extra)",
        "doctor --config none.toml": "no such file",
    },
    "relight a.jpg": {
        "": "no light given; add --envmap, --light",
        "--light 1": "'1': no such light or key; use AZ,EL",
        "--light original --pose 10,0,0": "--light original",
        "--light original --composite face": "--light original",
        "--light original --reflectance diffuse-sh": "--light original",
        "--light delight --reflectance diffuse-sh": "--light delight",
    },
    "relight a.jpg --light 0,0": {
        "--light-from background": "add --background FILE",
        "--light-from sky=background": "add --background FILE",
        "--fov 180 --light-from a.jpg": "170",
        "--pose 1,2": "YAW,PITCH,ROLL",
        "--pose 100,20,0": "use yaw",
        "--pose 25,0,0 --composite photo": "use --composite face",
        "--exposure bright": "auto or face or EV",
        "--photo b.jpg": "No such option: --photo ... relight the photo itself",
        "--ball mirror": "No such option: --ball ... estimate-light",
        "--exposure-group a": "No such option: --exposure-group ... pass one --exposure EV",
        "--match-tones": "No such option: --match-tones ... use --light-wrap",
        "--white scene": "No such option: --white ... use --white-balance",
        "--room 0.1": "No such option: --room ... use --ambient",
        "--matte-from rembg:u2net": "No such option: --matte-from ... pass --person",
        "--ocio who.csv": "Error reading OCIO config",
        "--ocio missing.ocio": "--ocio missing.ocio: no such file",
        "--lights 0": "use 1 to 4096",
        "--texture-size 100": "a multiple of 256",
        "--envmap-sampling best": "'best' is not one of 'cell'",
        "--background-blur nan": "--background-blur",
        "--light-wrap 0.5": "--light-wrap: ... add --background FILE, COLOUR",
        "--light-wrap 2 --background black": "--light-wrap",
        "--light wrap=left --light-wrap 1 --background black": "--light: wrap ... rename",
        "--light person=left": "--light: person ... rename",
        "--background nothing.png": "--background",
        "--background 1,2,-3": "--background",
        "--matte none.exr": "--matte ",
        "--ambient=2": "--ambient",
        "--reflectance wax": "specular-sh",
        "--reflectance prt --network-alone": "--network-alone: ... --reflectance portrait or field",
        "--input-colourspace nope": "unknown colour space 'nope'",
        "--view nope": "unknown view 'nope' (known: none, soft, aces, ",
        "--output-colourspace ACEScgg": "unknown colour space 'ACEScgg' (similar names: ACEScg",
        "--output-colourspace sRGB": "--output-colourspace sRGB: ... such as ACEScg",
        "--format png --aov normal": "--aov ... add exr to --format",
        "-o me.gif": "-o me.gif: ... use a folder",
        "-o who.csv/out": "cannot be written to",
        "-o two.png --light 9,9": "-o two.png: ... use a folder",
        "-o wrong.png --format exr": "-o wrong.png: ",
        "-o a.jpg": "-o a.jpg: is ",
    },
    "predict-olat a.jpg": {
        "--lights 0": "use 1 to 4096",
        "--lights few": "no such file; pass a number",
        "--frame photo --pose 20,0,0": "use --frame face or uv",
        "--frame photo --page --network-alone": "--page: ... remove --pose and --network-alone",
        "--texture-size 300": "multiple of 256",
        "--precision int8": "int8",
        "--memory 0": "memory",
        "--face best": "--face",
        "--input-colourspace nonsense": "unknown colour space",
    },
    "estimate-light a.jpg": {
        "--reflectance prt --signed": "--reflectance prt",
        "--lights 2000": "1024",
        "--width 101": "even",
        "--matte nowhere.png": "no such file",
    },
    "segment a.jpg": {
        "-o me.jpg": "-o me.jpg: ... the suffix .png or .exr",
        "-o me.JSON": "-o me.JSON: ... use a folder",
        "-o me.png --face all": "-o me.png: ... use a folder",
        "-o me.png b.jpg": "-o me.png: ... use a folder",
        "-o me.png --name {stem}": "--name: ... remove it",
        "-o a.JPG": "-o a.JPG: ... use a folder",
        "--person none.png": "no such file or folder",
    },
    "fit-geometry a.jpg": {
        "--geometry network --landmarks who.csv": "--landmarks: ... remove one",
        "--landmarks none": "no such file or folder",
    },
    "view": {
        "a.jpg b.jpg -o me.html": "-o me.html: ... use a folder",
        "index": "rename the photo",
    },
    "envmap": {"--kind moon": "moon", "--size 33": "--size", "--count 0": "--count"},
    "prepare-dataset stage": {
        "--split 300/10/40": "the capture has 2",
        "--split half": "--split",
        "--crop 97": "--crop",
        "--layout multipie": "extended-yale-b, faceolat, faceolat-linear, stage",
        "--checks only --shard 1/2": "--shard: --checks only checks all subjects; use --jobs or --ray",
        "--pattern x": "--pattern requires --describe",
    },
    "prepare-dataset": {"one": "stage.json: no such file"},
    "relight-dataset data --per-subject 4": {
        "--envmaps empty": "empty: no inputs found (looked for .exr .hdr)",
        "--envmaps procedural:999999999": "--envmaps: 999999999 maps ... 1000000",
        "--envmaps procedural:3 --memory inf": "--memory inf: not a size; pass a number",
        "--envmaps nowhere": "--envmaps nowhere: no such folder",
    },
    "train": {
        "--form cubist": "form cubist: ... default, paper",
        "--dataset d --heads 20": "--heads: ... use one",
        "--dataset d --heads-from builtin": "--heads-from: ... use one",
        "--texture-size 64": "--texture-size: ... add --dataset",
        "--preset paper": "--stage joint: ... add --dataset",
        "--stage joint --dataset d --heads 20": "--heads: does not apply to the stage",
        "--stage geometry --dataset d": "--dataset: does not apply to the stage geometry",
        "--photos p": "--photos: does not apply to the stage reflectance",
        "--stage light-features --mean-face": "--mean-face: does not apply to the stage light",
        "--dataset d --mean-face": "--mean-face: ... use --stage joint",
        "--without-normals --start-from f": "--without-normals: ... use one",
        "--stage joint --dataset d --geometry landmarks --photos p": "--photos: ... remove --geometry",
        "--stage joint --dataset d --fit-with m.npz": "--fit-with: ... add --geometry landmarks",
        "--geometry landmarks": "--geometry: does not apply to the stage reflectance",
        "--preset paper --dataset d --vgg-weights v --appearance-features a": "use one of them",
        "--preset paper --dataset data": "--vgg-weights imagenet ... --light-features FILE",
        f"--checkpoint {SHIPPED['parsing']}": "Parsing Network ... uses no network",
        f"--checkpoint {SHIPPED['portrait']}": "Portrait Network ... uses no network",
        "--heads 13": "--heads 13: the mean face and 12 heads are held out; use more",
        "--stage parsing --preset tiny --heads 4": "4 people are held out; use more",
        **{
            f"--max-time={time}": f"--max-time {time}: not a time; use a number and s, m or h, such as 45m"
            for time in ("5", "-3m", "0s")
        },
    },
    "face-model": {
        "import nowhere -o m.zip": "ends in .npz",
        "import nowhere": "--output",
        "import": "FILE",
        "": "Missing command",
    },
    "evaluate": {
        "olat data --preset paper --every 2": "remove --preset or --every",
        "olat data --split validation": "no pairs in the split validation",
        "olat data --reflectance phong": "use portrait, field, diffuse-sh",
        "olat data --reflectance prt --network-alone": "add --reflectance field",
        "olat data --against none.safetensors": "no such file",
        "olat data --against field.safetensors": "two methods have the name 'field'",
        "geometry data a.jpg": "one dataset among several inputs",
        "geometry a.jpg --against a.jpg": "--against",
        "geometry a.jpg --every 2": "--every requires a prepared dataset",
        "geometry data --facts who.csv": "--facts requires photos",
        "reconstruction a.jpg --every 1": "--every requires a prepared dataset",
        "reconstruction a.jpg --joint-fit": "--joint-fit requires a prepared dataset",
        "reconstruction data --face all": "--face requires photos",
        "transfer a.jpg": "add --photos",
        "transfer data --landmarks .": "--landmarks requires photos",
        "transfer --photos a.jpg": "two photos per person",
        "transfer --photos a.jpg a.jpg": "passed twice",
        "transfer --photos a.jpg link.jpg": "passed twice",
        "compare truth": "no method; add --method",
        "compare truth --method none": "no such folder",
        "compare truth --method good -o truth": "use another folder",
        "compare truth --method good -o good/here": "use another folder",
        "compare truth --method good --lpips y": "--vgg-weights",
        "compare truth --method good --preset paper": "--preset",
        "compare truth --method good --method=good": "two methods have the name 'good'",
        "compare truth --method good --method=same=good": "passed twice",
        "compare truth --method good --network-alone": "add --reflectance field",
        "yale-b yale --subjects yaleB07,yaleB99": "--subjects yaleB99: not in",
        "yale-b yale --keep-eyes": "--keep-eyes",
    },
}
FAILING: dict[str, dict[str, str]] = {
    "relight a.jpg --light 0,0": {"--face-model nope.npz": "nope.npz: no such face model"},
    "predict-olat a.jpg": {
        "--face-model none.npz": "no such face model",
        "--checkpoint other.st": "another UV layout",
        "--checkpoint torn.st": "do not fit",
        "--checkpoint none.st": "no such checkpoint",
    },
    "synth-stage": {"--face-model nothing.npz": "no such face model"},
    "prepare-dataset stage": {"--face-model nowhere.npz": "nowhere.npz"},
    "relight-dataset": {"empty --envmaps procedural:3": "dataset.json: no such file"},
    "train": {
        "--heads-from nobody.npz": "nobody.npz: no such face model",
        "--start-from who.csv": "not a facerf checkpoint",
        "--start-from torn.st": "torn.st: its weights do not fit",
        "--dataset one": "one/dataset.json: no such file",
    },
    "face-model": {
        "import nowhere -o m.npz": "nowhere: no such file; use ICT-FaceKit",
        "import nowhere.pkl -o m.npz": "nowhere.pkl: no such file; use FLAME's .pkl",
        "import nowhere.mat -o m.npz": "01_MorphableModel.mat",
        "import a.mat -o m.npz --landmarks a.npy": "a.npy: --landmarks is for FLAME",
    },
    "evaluate": {
        "reconstruction a.jpg --facts who.csv": "who.csv: no photo of this run is named astronot",
        "yale-b nowhere": "no such folder",
        "yale-b .": "no folders yaleB01",
        "yale-b yale --shifts shifts.csv": "shifts.csv: no such file",
        "olat data --against a.jpg": "a.jpg",
        "geometry a.jpg --mean-checkpoint b.jpg": "b.jpg",
    },
}
TABLES = [
    (head, line, words, code)
    for code, table in ((2, WRONG), (1, FAILING))
    for head, rows in table.items()
    for line, words in rows.items()
]
WITHOUT_OUTPUT = ("", "face-model", "relight-dataset")


@pytest.mark.parametrize(("head", "line", "words", "code"), TABLES)
def test_a_line(
    place: Path, capsys: Said, monkeypatch: Patch, head: str, line: str, words: str, code: int
) -> None:
    monkeypatch.chdir(place)
    before = set(place.rglob("*"))
    unasked = " -o " in f" {line}" or head.partition(" ")[0] in WITHOUT_OUTPUT
    assert main([*head.split(), *shlex.split(line), *([] if unasked else ["-o", "out"])]) == code
    out, err = capsys.readouterr()
    said = [each for each in err.splitlines() if all(part in each for part in words.split(" ... "))]
    assert (out, len(said)) == ("", 1), err
    made = {path.name for path in set(place.rglob("*")) - before}
    assert not made if code == 2 or head != "evaluate" else "summary.json" not in made


CONFIGURATIONS = {
    "[train.loss]\nphotometric = -9": "[train.loss] photometric is -9",
    "[train.optimizer]\nname = 'SGD'": "name is 'SGD'; use one of AdamW, Adadelta",
    "[train.optimizer]\nbetas = [0.9]": "[train.optimizer] betas",
    "[train]\nschedule = 3": "[train.schedule] is not a table",
    "[relight]\nexpo = 1": "expo: no such command or option; see `facerf relight --help-all`",
    "[relighting]\n": "relighting: no such command or option; see `facerf --help-all`",
    "global = 3": "global: no such command or option",
    "[global]\nversion = true": "version: no such command or option",
    "[evaluate.olat]\nx = 1": "see `facerf evaluate olat --help-all`",
    "[relight": "not TOML",
    "a = " + "[" * 5000: "not TOML",
    "[global]\nseed = -1": "--seed",
    "[relight]\noverwrite = 'x'": "--overwrite",
}


@pytest.mark.parametrize(("text", "words"), CONFIGURATIONS.items(), ids=range(len(CONFIGURATIONS)))
def test_a_configuration(text: str, words: str, tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "c.toml").write_text(text + "\n")
    verb = ["train"] if "[train" in text else ["relight", "a.png"]
    assert main([*verb, "-o", str(tmp_path / "out"), "--config", str(tmp_path / "c.toml")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "name", ["olat", "reconstruction", "transfer", "geometry", "yale-b", "cases", "compare"]
)
def test_every_protocol_has_help_and_the_shared_options(name: str, capsys: Said) -> None:
    assert main(["evaluate", name, "--help-all"]) == 0
    out = capsys.readouterr().out
    assert "--output" in out and ("--space" in out) == (name != "cases") and "{options}" not in out
    assert ("--form" in out) == ("--reflectance" in out) == (name != "cases")
    assert ("--keep-eyes" in out) == (name not in ("yale-b", "compare"))
