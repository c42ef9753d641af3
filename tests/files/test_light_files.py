import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.files.light_files import (
    FORMAT,
    LightRecord,
    read_light,
    read_map_file,
    write_light,
)
from facerf_cli.files.read import read_image
from facerf_cli.light.sh import CONVENTION
from tests.refusals import refused


def random_rows(rows: int) -> torch.Tensor:
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(rows))


def make_light() -> LightRecord:
    directions = torch.nn.functional.normalize(random_rows(7), dim=-1)
    return LightRecord(directions, random_rows(7), "seven", random_rows(9), {"facerf:input": "ä.jpg"})


def test_a_light_comes_back_from_plain_json(tmp_path: Path) -> None:
    before, path = make_light(), tmp_path / "deep" / "light.json"
    with np.printoptions(legacy="1.13"):  # as colour-science sets it for its whole process
        write_light(path, before)
    after = read_light(path)
    torch.testing.assert_close(after.directions, before.directions, rtol=0, atol=1e-6)  # normalized again
    assert torch.equal(after.weights, before.weights)
    assert before.sh is not None and after.sh is not None and torch.equal(after.sh, before.sh)
    assert (after.rig, after.attributes) == ("seven", before.attributes)
    assert list(path.parent.iterdir()) == [path]
    write_light(tmp_path / "a.json", make_light())
    fields = json.loads((tmp_path / "a.json").read_text())
    assert fields["format"] == FORMAT and "white" in fields["units"] and "camera" in fields["axes"]
    assert [len(row) for row in fields["weights"]] == [3] * 7 and fields["sh"]["order"] == 2
    (tmp_path / "a.json").write_text("[1]")
    refused(InputError, "a.json: use an object", read_light, tmp_path / "a.json")


BAD: dict[str, dict[str, Any]] = {
    "format: ... facerf-light-1": {"format": "other"},
    "directions: is missing; add it": {"directions": None},
    "2 directions but 1 weights": {"weights": [[1, 1, 1]]},
    "directions that are unit vectors": {"directions": [[1, 0, 0], [0, 2, 0]]},
    "weights: ... rows of 3": {"weights": [[1, 1, 1], [1, 1]]},
    "NaN is not a finite": {"weights": [[1, 1, 1], [1, 1, float("nan")]]},
    "3 finite numbers": {"weights": [[1, 1, 1], [1, 1, "2"]]},
    "directions: ... 1 to 4096 rows": {"directions": []},
    "rows, not 8": {"sh": {"coefficients": [[0, 0, 0]] * 8, "convention": CONVENTION}},
    "sh has another convention": {"sh": {"coefficients": [[1, 1, 1]], "convention": "x"}},
    "sh: use an object": {"sh": 5},
}


@pytest.mark.parametrize("complaint", BAD)
def test_an_error_is_one_line_that_names_the_fault(complaint: str, tmp_path: Path) -> None:
    good = {"format": FORMAT, "directions": [[1, 0, 0], [0, 1, 0]], "weights": [[1, 1, 1], [2, 2, 2]]}
    fields = {name: value for name, value in (good | BAD[complaint]).items() if value is not None}
    (tmp_path / "a.json").write_text(json.dumps(fields))
    refused(InputError, f"a.json ... {complaint}", read_light, tmp_path / "a.json")


@pytest.mark.parametrize("text", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b" " * (5 << 20)])
def test_damaged_files_are_refused(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(text)
    refused(InputError, "a.json: ... use a .json", read_light, tmp_path / "a.json")
    refused(InputError, "no such file", read_light, tmp_path / "b.json")


def pano(path: Path, levels: np.ndarray, full: tuple[int, int], start: tuple[int, int]) -> Path:
    """An image with GPano metadata; sizes are height and width."""
    named = zip(("FullPano", "CroppedAreaImage", "CroppedArea"), (full, levels.shape[:2], start), strict=True)
    sides = [("Height", "Width"), ("Height", "Width"), ("Top", "Left")]
    said = " ".join(
        f'GPano:{name}{side}Pixels="{value}"'
        for (name, values), pair in zip(named, sides, strict=True)
        for side, value in zip(pair, values, strict=True)
    )
    space = 'xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"'
    rdf = 'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
    packet = (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {rdf}><rdf:Description rdf:about="" {space} {said}/>'
    )
    Image.fromarray(levels).save(path, xmp=f"{packet}</rdf:RDF></x:xmpmeta>".encode(), quality=98)
    return path


def test_a_part_of_a_sphere_is_refused(tmp_path: Path) -> None:
    levels = np.full((16, 32, 3), 200, np.uint8)
    assert read_map_file(pano(tmp_path / "a.jpg", levels, (16, 32), (0, 0))).shape == (16, 32, 3)
    part = pano(tmp_path / "a.jpg", levels, (32, 64), (4, 10))
    refused(InputError, "a.jpg: ... extend it to 360 x 180 degrees", read_map_file, part)
    assert read_image(part).pixels.shape == (16, 32, 3)  # a photo is what it shows
