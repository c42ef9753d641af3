"""Pickles are read without running any code."""

import os
import pickle
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from facerf_cli.errors import InputError
from facerf_cli.files.inert_pickle import StandIn, array_of, read_inert_pickle
from tests.files.pickled import chumpy, python_2

RNG = np.random.default_rng(5)
ARRAYS = {
    "floats": RNG.normal(size=(3, 4, 5)),
    "in Fortran's order": np.asfortranarray(RNG.normal(size=(3, 4)).astype(np.float32)),
    "unsigned": RNG.integers(0, 2**32, (7, 2), dtype=np.uint32),
    "of the other end": RNG.normal(size=6).astype(">f8"),
    "without axes": np.array(2.5),
    "empty": np.zeros((0, 3)),
    "flags": np.array([True, False]),
}


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("protocol", range(1, 6))
@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_are_those_that_were_pickled(tmp_path: Path, name: str, protocol: int) -> None:
    array = ARRAYS[name]
    found = read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps({"a": array}, protocol)))
    np.testing.assert_array_equal(array_of(found["a"]), array)
    assert array_of(found["a"]).dtype == array.dtype


def test_what_python_2_wrote_is_read(tmp_path: Path) -> None:
    matrix = sparse.random(5, 40, 0.2, "csc", rng=RNG)
    with chumpy() as Ch:
        value = {"v": Ch(ARRAYS["floats"]), "J": matrix, "kind": "flame", "n": np.float64(3.5)}
        data = python_2(value)
    for name in (b"chumpy.ch\nCh", b"numpy.core.multiarray", b"scipy.sparse.csc\n", b"__builtin__\nset"):
        assert name in data
    found = read_inert_pickle(written(tmp_path / "a.pkl", data))
    assert isinstance(found["v"], StandIn) and found["kind"] == "flame" and array_of(found["n"]) == 3.5
    np.testing.assert_array_equal(array_of(found["v"]), ARRAYS["floats"])
    np.testing.assert_array_equal(array_of(found["J"]), matrix.toarray())


def test_python_2_s_text_for_bytes_is_read(tmp_path: Path) -> None:
    raw = ARRAYS["floats"].tobytes()
    as_bytes = pickle.dumps({"a": ARRAYS["floats"]}, 3)
    head, tail = as_bytes.split(b"B" + struct.pack("<I", len(raw)) + raw)
    as_text = head + b"T" + struct.pack("<i", len(raw)) + raw + tail
    found = read_inert_pickle(written(tmp_path / "a.pkl", as_text))
    np.testing.assert_array_equal(array_of(found["a"]), ARRAYS["floats"])


def test_rows_and_columns_of_sparse_matrices(tmp_path: Path) -> None:
    matrix = sparse.random(9, 4, 0.4, "csr", rng=RNG)
    for made in (matrix, matrix.tocsc(), sparse.csr_array(matrix), sparse.csc_array(matrix)):
        found = read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps(made)))
        np.testing.assert_array_equal(array_of(found), matrix.toarray())


class Calls:
    """Unpickled by pickle.load, it calls `function`."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.made = function, arguments

    def __reduce__(self) -> Any:
        return self.made


def touches(path: Path) -> str:
    return f"touch {path}"


HOSTILE = {
    "os.system": lambda t: Calls(os.system, touches(t / "run")),
    "eval": lambda t: Calls(eval, f"open({str(t / 'run')!r}, 'w')"),
    "exec": lambda t: Calls(exec, f"open({str(t / 'run')!r}, 'w')"),
    "open": lambda t: Calls(open, str(t / "run"), "w"),
    "getattr": lambda t: Calls(getattr, "", "join"),
    "inside an array": lambda t: {"v": np.array([Calls(os.system, touches(t / "run"))], dtype=object)},
    "as chumpy's state": lambda t: {"x": [1, Calls(os.system, touches(t / "run"))]},
    "numpy's own load": lambda t: Calls(np.load, "a.npy"),
    "a class of ours": lambda t: Path("/etc/passwd"),
}


@pytest.mark.parametrize("protocol", [2, 4, 5])
@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_pickle_runs_nothing(tmp_path: Path, case: str, protocol: int) -> None:
    data = pickle.dumps(HOSTILE[case](tmp_path), protocol)
    with pytest.raises(InputError, match=r"refused: it names .*nothing of it was run") as refused:
        read_inert_pickle(written(tmp_path / "a.pkl", data))
    assert "\n" not in str(refused.value) and not (tmp_path / "run").exists()
    if case == "os.system":  # the file is what it is said to be
        pickle.loads(data)
        assert (tmp_path / "run").exists()


def array_pickle(shape: bytes, code: bytes = b"f8", data: bytes = bytes(8)) -> bytes:
    """An array of protocol 2, its shape given as opcodes and its data as they are."""
    minus_one = b"J\xff\xff\xff\xff"
    text = b"U" + bytes([len(data)]) + data
    dtype = b"cnumpy\ndtype\nU" + bytes([len(code)]) + code + b"K\x00K\x01\x87R"
    dtype += b"(K\x03U\x01<NNN" + minus_one * 2 + b"K\x00tb"
    empty = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    return b"\x80\x02" + empty + b"(K\x01" + shape + dtype + b"\x89" + text + b"tb."


HUGE = b"\x8a\x05\x00\x00\x00\x00\x7f"
DAMAGED = {
    "a huge claim": (array_pickle(HUGE + b"\x85"), "does not fit"),
    "a product that overflows": (array_pickle(HUGE * 2 + b"\x86"), "does not fit"),
    "a negative length": (array_pickle(b"J\xff\xff\xff\xff\x85"), "does not fit"),
    "fewer numbers than data": (array_pickle(b"K\x01\x85", data=bytes(16)), "does not fit"),
    "objects": (array_pickle(b"K\x01\x85", b"O8"), "array of type O8"),
    "text": (array_pickle(b"K\x01\x85", b"S8"), "array of type S8"),
    "records": (array_pickle(b"K\x01\x85", b"f8,f8"), "array of type"),
    "a memo far away": (b"\x80\x02Nr\xff\xff\xff\x7f.", ""),
    "a memo that is missing": (b"\x80\x02j\x00\x00\x00\x10.", ""),
    "a long missing text": (b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0f.", ""),
    "an old instance": (b"(ios\nsystem\n.", ""),
    "someone else's store": (b"Pabc\n.", ""),
    "an extension": (b"\x80\x02\x82\x01.", ""),
    "nothing": (b"", ""),
    "an image": (b"\x89PNG\r\n\x1a\n", ""),
    "an end too soon": (pickle.dumps(ARRAYS["floats"])[:-20], ""),
    "an empty stack": (b"\x80\x020.", ""),
    "a list as a key": (b"\x80\x02}]Ns.", ""),
    "a mark for a value": (b"\x80\x02(.", ""),
    "a call of what is no name": (b"\x80\x02X\x01\x00\x00\x00a)R.", ""),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_is_one_line(tmp_path: Path, case: str) -> None:
    """A pickle that is damaged is refused when read; a damaged array (with a message) later."""
    data, message = DAMAGED[case]
    path = written(tmp_path / "a.pkl", data)
    if not message:
        with pytest.raises(InputError, match=r"not a readable pickle|refused") as refused:
            read_inert_pickle(path)
        assert "\n" not in str(refused.value) and str(path) in str(refused.value)
        return
    found = read_inert_pickle(path)
    with pytest.raises(ValueError, match=message):
        array_of(found)


def test_deep_nests_do_not_recurse(tmp_path: Path) -> None:
    read_inert_pickle(written(tmp_path / "a.pkl", b"\x80\x02" + b"]" * 60_000 + b"a" * 59_999 + b"."))
    as_key = b"\x80\x02})" + b"\x85" * 4990 + b"Ns."
    read_inert_pickle(written(tmp_path / "a.pkl", as_key))
    with pytest.raises(InputError, match="5000 tuples"):
        read_inert_pickle(written(tmp_path / "a.pkl", b"\x80\x02)" + b"\x85" * 60_000 + b"."))
    cyclic = b"\x80\x02cchumpy.ch\nCh\n)\x81q\x01}X\x01\x00\x00\x00xh\x01sb."
    with pytest.raises(ValueError, match="where numbers should"):
        array_of(read_inert_pickle(written(tmp_path / "a.pkl", cyclic)))


def test_the_work_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = "facerf_cli.files.inert_pickle"
    monkeypatch.setattr(f"{module}._MAX_OPCODES", 1000)
    with pytest.raises(InputError, match="more than 1000 instructions"):
        read_inert_pickle(written(tmp_path / "a.pkl", b"\x80\x02" + b"N" * 1000 + b"."))
    monkeypatch.setattr(f"{module}._MAX_BYTES", 100)
    with pytest.raises(InputError, match="too large"):
        read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps(ARRAYS["floats"])))


def test_a_sparse_matrix_is_not_trusted(tmp_path: Path) -> None:
    for key, wrong in (
        ("indices", np.array([0, 99])), ("indices", np.array([0, -1])), ("indptr", np.array([0, 2**40, 2])),
        ("indptr", np.array([0, 2])), ("data", np.ones(3)), ("data", 3),
        ("_shape", (2**31, 2)), ("_shape", (2, "a")),
    ):  # fmt: skip
        matrix = sparse.csr_matrix(np.array([[1.0, 0, 0], [0, 0, 2.0]]))
        found = read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps(matrix)))
        assert array_of(found).shape == (2, 3)
        matrix.__dict__[key] = wrong
        found = read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps(matrix)))
        with pytest.raises(ValueError):
            array_of(found)


def test_a_value_without_numbers_is_an_error(tmp_path: Path) -> None:
    for value in ({"a": OrderedDict(b=1)}, {"a": "text"}, {"a": None}, {"a": {1, 2}}):
        with pytest.raises(ValueError, match="where numbers should"):
            array_of(read_inert_pickle(written(tmp_path / "a.pkl", pickle.dumps(value)))["a"])


def test_an_operation_of_chumpy_is_kept_but_not_computed(tmp_path: Path) -> None:
    data = b"\x80\x02}X\x01\x00\x00\x00acchumpy.reordering\nSelect\n)\x81}X\x01\x00\x00\x00xK\x01sbs."
    found = read_inert_pickle(written(tmp_path / "a.pkl", data))
    assert found["a"].name == "chumpy.reordering.Select" and found["a"].state == {"x": 1}
    with pytest.raises(ValueError, match=r"a chumpy\.reordering\.Select stands where numbers should"):
        array_of(found["a"])
