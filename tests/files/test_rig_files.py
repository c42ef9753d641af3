"""Rig files: settings as text, and faults in one line, whatever a file holds."""

from pathlib import Path

import pytest

from facerf_cli.errors import InputError
from facerf_cli.files.texts import MOST_RIG_LIGHTS, read_rig


def test_values_become_the_text_of_an_option(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("# a rig\n[key]\nat = [0.5, 1, -2e-1]\nkelvin = 3200\naz = '0:90:4'\n")
    assert read_rig(tmp_path / "a.toml") == {
        "key": {"at": "0.5,1.0,-0.2", "kelvin": "3200.0", "az": "0:90:4"}
    }


@pytest.mark.parametrize(
    "data, said",
    [
        (b"", "0 lights; give 1 to 32"),
        (b"\n".join(b"[l%d]\naz = 1" % k for k in range(MOST_RIG_LIGHTS + 1)), "33 lights"),
        (b"# " + b"x" * 70000, "more than 65536 bytes"),
        (b"key = 3", "key: not a light"),
        (b"[key]\naz = true", "key: az: not a number"),
        (b"[key]\naz = [1, 'a']", "az: not a number"),
        (b"[key]\naz = {b = 1}", "az: not a number"),
        (b"[key]\naz = 1979-05-27", "az: not a number"),
        (b"[key]\naz = 0x" + b"f" * 4000, "az: not a number"),
        (b"[key]\naz = " + b"9" * 5000, "not TOML"),
        (b"a = " + b"[" * 30000, "not TOML"),
        (b"[key", "not TOML"),
        (b"\xff\xfe[key]", "not TOML"),
    ],
)
def test_faults(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_rig(path)
    assert said in str(caught.value) and str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_rig(tmp_path / "none.toml")
