"""Provenance where viewers look for it."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from facerf_cli.files.images import read_image, write_display, xmp_packet
from facerf_cli.logs import COMPOSITE_SOURCE_TYPE, Provenance

IPTC = "{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType"


def properties(data: bytes) -> dict[str, str]:
    (packet,) = re.findall(rb"<x:xmpmeta.*?</x:xmpmeta>", data, re.S)
    return ElementTree.fromstring(packet)[0][0].attrib


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_display_image_says_that_it_is_synthetic(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    pixels = np.full((9, 14, 3), 0.25, np.float32)
    write_display(path, pixels, metadata=Provenance('a "b" <c> ü.jpg', "default").attributes())
    found = properties(path.read_bytes())
    assert found[IPTC] == COMPOSITE_SOURCE_TYPE and found["{urn:facerf:1}synthetic"] == "1"
    assert found["{urn:facerf:1}input"] == 'a "b" <c> ü.jpg'
    np.testing.assert_allclose(read_image(path).pixels, pixels, atol=0.01)  # and is whole


def test_what_has_no_place_in_xmp_is_left_out() -> None:
    assert b"compression" not in xmp_packet({"compression": "zip"})
