"""Time and size of written images by format, with all threads and with one; how views treat a relit person.

    python benchmarks/image_files.py [--side 2048] [--outputs lit/*.exr]

With `--outputs`, EXR files of `facerf relight`, these are written again by each lossless compression, and
the PNG beside each by level and filter of rows: processors' seconds, and bytes as a share of the values'.

Times are of one image with alpha and the layers person.A, albedo and normal, made of the example photo with
a little noise. `one part of floats` is the same EXR as one part, converted while it is written. The views
show the example photo under the light that is estimated from it, which should look like the photo, and under
a hard, warm light.
"""

import os
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import OpenImageIO as oiio
from _common import ASTRONAUT, arguments, best_s, print_header, print_row
from skimage.transform import resize

import facerf_cli as facerf
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display, write_exr, write_tiff
from facerf_cli.image.colour import auto_exposure_ev, encode_display, linear_to_srgb, named_view

_ROUNDS = 3
_NOISE = 0.005  # standard deviation; an image without noise is compressed too well
_COMPRESSIONS = ("zip", "none", "zips", "piz", "dwaa")
_LOSSLESS = ("none", "rle", "zip:2", "zip", "zip:6", "zips", "piz")
_UP = 32  # libpng's PNG_FILTER_UP
_VIEWS = ("none", "soft", "aces")
_WARM = facerf.Light.single(50, 20, (3.0, 2.0, 1.4))

Writer = partial[object]  # its first argument is the file's path


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--side", type=int, default=2048, help="of the written image, in pixels")
    parser.add_argument("--outputs", type=Path, nargs="+", default=[])
    given = parser.parse_args()
    if given.outputs:
        report_choices(given.outputs)
        return
    photo = read_image(ASTRONAUT).pixels
    with TemporaryDirectory() as folder:
        report_times(Path(folder), resize(photo, (given.side, given.side)).astype(np.float32))
    print()
    report_views(photo)


def report_times(folder: Path, clean: np.ndarray) -> None:
    """Print a row a format: seconds with all threads, the ratio of one thread's, and the size."""
    generator = np.random.default_rng(0)
    noisy = [(clean + generator.normal(0, _NOISE, clean.shape)).astype(np.float32) for _ in range(3)]
    pixels, albedo, normal = noisy
    image = pixels, pixels[..., 0].clip(0, 1)
    layers = {"person.A": albedo[..., 0].clip(0, 1), "albedo": albedo, "normal": normal}
    writers: dict[str, Writer] = {
        f"EXR, {name}": partial(write_exr, folder / "x.exr", *image, layers, compression=name)
        for name in _COMPRESSIONS
    }
    writers["EXR, zip, one part of floats"] = partial(write_one_part, folder / "one.exr", *image, layers)
    writers["TIFF"] = partial(write_tiff, folder / "x.tif", *image)
    writers["PNG"] = partial(write_display, folder / "x.png", pixels, 0.0)
    writers["PNG, 16 bits"] = partial(write_display, folder / "x.png", pixels, 0.0, bits=16)
    writers["JPEG"] = partial(write_display, folder / "x.jpg", pixels, 0.0)
    every = {name: partial(with_threads, writer, os.cpu_count() or 1) for name, writer in writers.items()}
    one = {name: partial(with_threads, writer, 1) for name, writer in writers.items()}
    print(f"{pixels.shape[1]} x {pixels.shape[0]} pixels, {os.cpu_count()} processors")
    print_header("format", "seconds", "one thread takes", "MB")
    for name in writers:
        seconds, sizes = best_s({"every": every[name], "one": one[name]}, _ROUNDS)
        ratio = seconds["one"] / seconds["every"]
        print_row(name, f"{seconds['every']:.2f}", f"{ratio:.2f} x", f"{sizes['every'] / 1e6:.1f}")


def report_choices(outputs: list[Path]) -> None:
    """Print a row a choice, with two cells a file: processors' seconds, and the share of bytes."""
    images = [[oiio.ImageBuf(str(path), part, 0) for part in (0, 1)] for path in outputs]
    shown = [[oiio.ImageBuf(str(path.with_suffix(".png")))] for path in outputs]
    choices = [("x.exr", f"EXR, {name}", {"compression": name}, images) for name in _LOSSLESS]
    for filtered in (0, _UP):
        for level in (1, 4, 6):
            options = {"png:compressionLevel": level, "png:filter": filtered}
            name = f"PNG, level {level}, {'rows less those above' if filtered else 'any filter'}"
            choices.append(("x.png", name, {key: value for key, value in options.items() if value}, shown))
    print_header("", *(cell for path in outputs for cell in (path.stem, "of bytes")))
    with TemporaryDirectory() as folder:
        for file, name, choice, all_parts in choices:
            cells = []
            for parts in all_parts:
                seconds = min(written_s(Path(folder) / file, parts, choice) for _ in range(_ROUNDS))
                values = sum(part.spec().image_bytes() for part in parts)
                cells += [f"{seconds:.3f}", f"{(Path(folder) / file).stat().st_size / values:.3f}"]
            print_row(name, *cells)


def written_s(path: Path, parts: list[oiio.ImageBuf], choice: dict[str, str | int]) -> float:
    """Write parts as they are; return the processors' seconds."""
    values, specs = [part.get_pixels(part.spec().format) for part in parts], []
    for part in parts:
        shape = part.spec()
        spec = oiio.ImageSpec(shape.width, shape.height, shape.nchannels, shape.format)
        spec.channelnames = shape.channelnames
        for name, value in {"name": str(len(specs)), **choice}.items():
            spec.attribute(name, value)
        specs.append(spec)
    start_s = time.process_time()
    stream = oiio.ImageOutput.create(str(path))
    assert stream.open(str(path), specs if len(specs) > 1 else specs[0])
    for number, (spec, pixels) in enumerate(zip(specs, values, strict=True)):
        assert not number or stream.open(str(path), spec, "AppendSubimage")
        assert stream.write_image(pixels)
    stream.close()
    return time.process_time() - start_s


def with_threads(writer: Writer, threads: int) -> int:
    """Write a file with a number of threads of OpenImageIO; return its size in bytes."""
    oiio.attribute("threads", threads)
    oiio.attribute("exr_threads", threads)
    writer()
    path: Path = writer.args[0]
    return path.stat().st_size


def write_one_part(path: Path, pixels: np.ndarray, alpha: np.ndarray, layers: dict[str, np.ndarray]) -> None:
    """Write all channels together, from floats."""
    data = np.dstack([pixels * alpha[..., None], alpha, *layers.values()])
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], "half")
    spec.attribute("compression", "zip")
    stream = oiio.ImageOutput.create(str(path))
    assert stream.open(str(path), spec) and stream.write_image(data) and stream.close()


def report_views(photo: np.ndarray) -> None:
    """Print a row a view: the difference from the photo, and pixels of the person without detail."""
    fitted = facerf.fit(facerf.load_models(), photo)
    own, warm = fitted.relight([fitted.light, _WARM])
    person = fitted.matte > 0.5
    print_header(
        "view", "own light: mean difference, of 255", "own light: grey 0.18", "warm light: a channel is 255"
    )
    for name in _VIEWS:
        view = named_view(name)
        shown = encode_display(own, view)[person]
        difference = 255 * np.abs(shown - linear_to_srgb(photo[person])).mean()
        grey = 255 * encode_display(np.full((1, 1, 3), 0.18, np.float32), view).mean()
        lit = encode_display(warm * np.float32(2.0 ** auto_exposure_ev(warm, person)), view)
        full = (np.rint(255 * lit[person]) == 255).any(-1).mean()
        print_row(name, f"{difference:.1f}", f"{grey:.0f}", f"{full:.1%}")


if __name__ == "__main__":
    main()
