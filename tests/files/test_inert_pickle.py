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

from facerf_cli.files.inert_pickle import pickled_arrays
from facerf_cli.files.sandbox import read_in_subprocess
from tests.face.importers.heads import arrays_here
from tests.files.pickled import chumpy, python_2, saved_object
from tests.refusals import refused

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
def test_arrays_are_those_that_were_pickled(tmp_path: Path, protocol: int) -> None:
    found = pickled_arrays(written(tmp_path / "a.pkl", pickle.dumps(ARRAYS, protocol)))
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype.newbyteorder("=")


def test_what_python_2_and_numpy_wrote_is_read(tmp_path: Path) -> None:
    matrix = sparse.random(5, 40, 0.2, "csc", rng=RNG)
    with chumpy() as Ch:
        value = {"v": Ch(ARRAYS["floats"]), "J": matrix, "kind": "flame", "n": np.float64(3.5)}
        data = python_2(value)
    for name in (b"chumpy.ch\nCh", b"numpy.core.multiarray", b"scipy.sparse.csc\n", b"__builtin__\nset"):
        assert name in data
    found = pickled_arrays(written(tmp_path / "a.pkl", data))
    assert found["kind"].shape == (0,) and found["n"] == 3.5
    np.testing.assert_array_equal(found["v"], ARRAYS["floats"])
    np.testing.assert_array_equal(found["J"], matrix.toarray())
    raw = ARRAYS["floats"].tobytes()
    as_bytes = pickle.dumps({"a": ARRAYS["floats"]}, 3)
    head, tail = as_bytes.split(b"B" + struct.pack("<I", len(raw)) + raw)
    as_text = head + b"T" + struct.pack("<i", len(raw)) + raw + tail
    found = pickled_arrays(written(tmp_path / "a.pkl", as_text))
    np.testing.assert_array_equal(found["a"], ARRAYS["floats"])
    found = pickled_arrays(written(tmp_path / "a.npy", saved_object(ARRAYS)))
    np.testing.assert_array_equal(found["floats"], ARRAYS["floats"])
    np.save(tmp_path / "b.npy", ARRAYS["floats"])
    with pytest.raises(ValueError):
        arrays_here(pickled_arrays, tmp_path / "b.npy")


def test_sparse_matrices_are_read_and_not_trusted(tmp_path: Path) -> None:
    matrix = sparse.random(9, 4, 0.4, "csr", rng=RNG)
    for made in (matrix, matrix.tocsc(), sparse.csr_array(matrix), sparse.csc_array(matrix)):
        found = pickled_arrays(written(tmp_path / "a.pkl", pickle.dumps({"a": made})))
        np.testing.assert_array_equal(found["a"], matrix.toarray())
    for key, wrong in (
        ("indices", np.array([0, 99])), ("indices", np.array([0, -1])), ("indptr", np.array([0, 2**40, 2])),
        ("indptr", np.array([0, 2])), ("data", np.ones(3)), ("_shape", (2, "a")),
    ):  # fmt: skip
        matrix = sparse.csr_matrix(np.array([[1.0, 0, 0], [0, 0, 2.0]]))
        matrix.__dict__[key] = wrong
        with pytest.raises(ValueError):
            arrays_here(pickled_arrays, written(tmp_path / "a.pkl", pickle.dumps({"a": matrix})))


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
    refused(ValueError, "it names", pickled_arrays, written(tmp_path / "a.pkl", data))
    assert not (tmp_path / "run").exists()
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
    "a huge claim": array_pickle(HUGE + b"\x85"),
    "a product that overflows": array_pickle(HUGE * 2 + b"\x86"),
    "a negative length": array_pickle(b"J\xff\xff\xff\xff\x85"),
    "fewer numbers than data": array_pickle(b"K\x01\x85", data=bytes(16)),
    "objects of bytes": array_pickle(b"K\x01\x85", b"O8"),
    "records": array_pickle(b"K\x01\x85", b"f8,f8"),
    "a memo that is missing": b"\x80\x02j\x00\x00\x00\x10.",
    "an old instance": b"(ios\nsystem\n.",
    "someone else's store": b"Pabc\n.",
    "an extension": b"\x80\x02\x82\x01.",
    "nothing": b"",
    "an image": b"\x89PNG\r\n\x1a\n",
    "an end too soon": pickle.dumps(ARRAYS["floats"])[:-20],
    "a list as a key": b"\x80\x02}]Ns.",
    "no table": pickle.dumps([1, 2]),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_is_an_error(tmp_path: Path, case: str) -> None:
    with pytest.raises(ValueError):
        arrays_here(pickled_arrays, written(tmp_path / "a.pkl", DAMAGED[case]))


@pytest.mark.parametrize(
    "data",
    [b"\x80\x02})" + b"\x85" * 200_000 + b"Ns.", b"\x80\x02Nr\xff\xff\xff\x7f."],
    ids=["a nest as a key", "a memo far away"],
)
def test_what_exhausts_the_unpickler_costs_its_process_alone(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        read_in_subprocess(pickled_arrays, written(tmp_path / "a.pkl", data))


def test_values_without_numbers_are_empty_and_operations_not_computed(tmp_path: Path) -> None:
    values = {"dict": OrderedDict(b=1), "text": "text", "none": None, "set": {1, 2}, "ragged": [[1], [1, 2]]}
    found = pickled_arrays(written(tmp_path / "a.pkl", pickle.dumps(values)))
    assert all(found[name].shape == (0,) for name in values)
    data = b"\x80\x02}X\x01\x00\x00\x00acchumpy.reordering\nSelect\n)\x81}X\x01\x00\x00\x00xK\x01sbs."
    assert pickled_arrays(written(tmp_path / "a.pkl", data))["a"].shape == (0,)
