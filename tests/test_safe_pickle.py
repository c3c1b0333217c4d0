"""SMPL pickles are read; what else a pickle can do is refused by name and never happens."""

import pickle
import struct

import numpy as np
import pytest
from reference_smpl import tiny_smpl_arrays
from scipy import sparse

from isp_assets.body import Body
from isp_assets.errors import BodyError
from isp_assets.safe_pickle import read_smpl_pickle


class Opcodes(bytes):
    """A piece of a pickle, ready to be pasted into another."""


def emit(value):
    """Protocol 2 opcodes of a value, with texts as Python 2 wrote them: raw bytes."""
    if isinstance(value, Opcodes):
        return value
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        number = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
        return b"\x8a" + bytes([len(number)]) + number
    if isinstance(value, (str, bytes)):
        text = value if isinstance(value, bytes) else value.encode("latin1")
        return b"T" + struct.pack("<i", len(text)) + text
    if isinstance(value, tuple):
        return b"(" + b"".join(map(emit, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(emit, value)) + b"e"
    if isinstance(value, dict):
        return b"}(" + b"".join(emit(key) + emit(item) for key, item in value.items()) + b"u"
    assert value is None
    return b"N"


def named(module, name):
    return Opcodes(f"c{module}\n{name}\n".encode())


def called(module, name, *arguments):
    return Opcodes(named(module, name) + emit(arguments) + b"R")


def made(module, name, state):
    """An instance made without its constructor, with a state: how Python 2 wrote objects."""
    return Opcodes(named(module, name) + b")\x81" + emit(state) + b"b")


def number_type(code, order="<"):
    return Opcodes(
        called("numpy", "dtype", code, 0, 1) + emit((3, order, None, None, None, -1, -1, 0)) + b"b"
    )


def array(values, *, shape=None, dtype=None, data=None, fortran=False):
    values = np.asarray(values)
    order = ">" if values.dtype.byteorder == ">" else "<"
    start = called("numpy.core.multiarray", "_reconstruct", named("numpy", "ndarray"), (0,), "b")
    state = (
        1,
        values.shape if shape is None else shape,
        number_type(values.dtype.str[1:], order) if dtype is None else dtype,
        fortran,
        values.tobytes(order="F" if fortran else "C") if data is None else data,
    )
    return Opcodes(start + emit(state) + b"b")


def program(value):
    return b"\x80\x02" + emit(value) + b"."


def read(tmp_path, content, key="x"):
    path = tmp_path / "body.pkl"
    path.write_bytes(content)
    return read_smpl_pickle(path, [key])[key]


def test_the_emitter_writes_true_pickles():
    """A control: numpy itself reads the arrays that the other tests are built from."""
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    for kind in (values, values.astype(">f8"), values.astype(np.uint32)):
        loaded = pickle.loads(program({"x": array(kind, fortran=True)}), encoding="latin1")
        np.testing.assert_array_equal(loaded["x"], kind)


def test_python_2_body_with_chumpy_and_scipy(tmp_path):
    arrays = tiny_smpl_arrays()
    matrix = sparse.csc_matrix(arrays["J_regressor"])
    stored = {key: array(value) for key, value in arrays.items()}
    stored["shapedirs"] = made(
        "chumpy.ch", "Ch", {"x": stored["shapedirs"], "dirty_vars": named("chumpy", "Ch")}
    )
    picked = {"a": stored["v_template"], "idxs": array(np.arange(120)), "preferred_shape": (40, 3)}
    stored["v_template"] = made("chumpy.reordering", "Select", picked)
    parts = {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr}
    state = {"_shape": (24, 40), "maxprint": 50, **{key: array(value) for key, value in parts.items()}}
    stored["J_regressor"] = made("scipy.sparse.csc", "csc_matrix", state)
    stored |= {
        "bs_type": "lrotmin",
        "J": called("chumpy", "array", 1),
        "vert_sym_idxs": called("__builtin__", "set", [1]),
    }
    (tmp_path / "body.pkl").write_bytes(program(stored))
    np.savez(tmp_path / "body.npz", **arrays)
    assert Body.load(tmp_path / "body.pkl").sha256 == Body.load(tmp_path / "body.npz").sha256


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("layout", ["dense", "csc_matrix", "csr_matrix", "coo_matrix", "csr_array"])
def test_bodies_saved_again_by_python_3(tmp_path, protocol, layout):
    arrays = tiny_smpl_arrays()
    stored = dict(arrays, gender="neutral", scale=np.float64(1))
    if layout != "dense":
        stored["J_regressor"] = getattr(sparse, layout)(arrays["J_regressor"])
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(stored, protocol=protocol))
    np.savez(tmp_path / "body.npz", **arrays)
    assert Body.load(tmp_path / "body.pkl").sha256 == Body.load(tmp_path / "body.npz").sha256


@pytest.mark.parametrize(
    "values",
    [
        np.arange(12.0).reshape(3, 4),
        np.arange(12, dtype=">i4").reshape(3, 4),
        np.arange(3, dtype=np.float16),
        np.zeros((0, 3), np.uint32),
        np.array([True, False]),
    ],
)
@pytest.mark.parametrize("fortran", [False, True])
def test_array_layouts(tmp_path, values, fortran):
    read_back = read(tmp_path, program({"x": array(values, fortran=fortran)}))
    np.testing.assert_array_equal(read_back, values)
    assert read_back.dtype == values.dtype


# What each would run if it were run: create a file. The path is put in by the test.
ATTACKS = {
    "posix.system": lambda path: called("posix", "system", f"touch {path}"),
    "os.system": lambda path: called("os", "system", f"touch {path}"),
    "builtins.eval": lambda path: called("builtins", "eval", f"open({str(path)!r}, 'w')"),
    "__builtin__.eval": lambda path: called("__builtin__", "eval", f"open({str(path)!r}, 'w')"),
    "builtins.exec": lambda path: called("builtins", "exec", f"open({str(path)!r}, 'w')"),
    "builtins.getattr": lambda path: called("builtins", "getattr", named("numpy", "ndarray"), "tofile"),
    "subprocess.Popen": lambda path: called("subprocess", "Popen", ["touch", str(path)]),
    "io.open": lambda path: called("io", "open", str(path), "w"),
    "numpy.savetxt": lambda path: called("numpy", "savetxt", str(path), [1]),
    "numpy.load": lambda path: called("numpy", "load", str(path), None, True),
    "numpy.core.multiarray.fromfile": lambda path: called("numpy.core.multiarray", "fromfile", str(path)),
    "scipy.sparse.save_npz": lambda path: called("scipy.sparse", "save_npz", str(path), None),
    "chumpyx.Ch": lambda path: called("chumpyx", "Ch"),
    "pickle.loads": lambda path: called("pickle", "loads", b"cposix\nsystem\n(S'true'\ntR."),
}


@pytest.mark.parametrize("name", ATTACKS)
@pytest.mark.parametrize("place", ["top", "value", "inside an array", "chumpy state"])
def test_foreign_names_are_refused_and_not_run(tmp_path, name, place):
    marker = tmp_path / "was_run"
    attack = ATTACKS[name](marker)
    content = {
        "top": attack,
        "value": {"y": attack, "x": array([1.0])},
        "inside an array": {"x": array([1.0], data=attack)},
        "chumpy state": {"x": made("chumpy.ch", "Ch", {"x": attack})},
    }[place]
    with pytest.raises(BodyError, match=f"asks for '{name}'.*Nothing was run"):
        read(tmp_path, program(content))
    assert not marker.exists()


def test_the_attack_is_real(tmp_path):
    """A control: the ordinary unpickler does run it."""
    marker = tmp_path / "was_run"
    pickle.loads(program(ATTACKS["os.system"](marker)))
    assert marker.exists()


def test_attributes_of_allowed_names_are_refused(tmp_path):
    """Protocol 4 may name ``ndarray.tofile``: a dotted path below an allowed name."""
    dotted = b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93."
    assert pickle.loads(dotted) is np.ndarray.tofile
    with pytest.raises(BodyError, match=r"asks for 'numpy\.ndarray\.tofile'"):
        read(tmp_path, dotted)


NESTED = b"cposix\nsystem\n(S'true'\ntR."
TRICKS = {
    "object array": array([1.0], dtype=number_type("O8", "|"), data=[{}]),
    "object array from a list": array(
        [1.0], dtype=number_type("O8", "|"), data=[called("numpy", "dtype", "f8")]
    ),
    "object scalar, a pickle in a pickle": called(
        "numpy.core.multiarray", "scalar", number_type("O8", "|"), NESTED
    ),
    "structured type": array([1.0], dtype=number_type([("a", "O")])),
    "text array": array([1.0], dtype=number_type("S8", "|")),
    "void array": array([1.0], dtype=number_type("V8", "|")),
    "type without name": array([1.0], dtype="f8"),
    "array too short for its shape": array([1.0, 2.0], shape=(3,)),
    "array too long for its shape": array([1.0, 2.0], shape=(1,)),
    "negative shape": array([1.0], shape=(-1,)),
    "shape that overflows": array(np.zeros(0), shape=(2**62, 4)),
    "shape of zeros that overflows": array(np.zeros(0), shape=(2**62, 4, 0, 2**62)),
    "shape of truth values": array([1.0], shape=(True,)),
    "sparse indices outside": made(
        "scipy.sparse.csc",
        "csc_matrix",
        {
            "_shape": (2, 2),
            "data": array([1.0]),
            "indices": array(np.array([10**6])),
            "indptr": array(np.array([0, 1, 1])),
        },
    ),
    "sparse pointers outside": made(
        "scipy.sparse.csr",
        "csr_matrix",
        {
            "_shape": (2, 2),
            "data": array([1.0]),
            "indices": array(np.array([0])),
            "indptr": array(np.array([0, 10**6, 1])),
        },
    ),
    "sparse and too large": made(
        "scipy.sparse.coo",
        "coo_matrix",
        {
            "_shape": (10**6, 10**6),
            "data": array([1.0]),
            "row": array(np.array([0])),
            "col": array(np.array([0])),
        },
    ),
    "sparse without parts": made("scipy.sparse.csc", "csc_matrix", {"_shape": (2, 2)}),
    "sparse without state": called("scipy.sparse", "csc_matrix", (2, 2)),
    "selection outside": made(
        "chumpy.reordering", "Select", {"a": array([1.0]), "idxs": array(np.array([9]))}
    ),
    "chumpy expression": made("chumpy.ch", "add", {"p": array([1.0]), "q": array([1.0])}),
    "number": 3,
    "list": [1, 2],
    "array type itself": named("numpy", "ndarray"),
    "request never filled": called(
        "numpy.core.multiarray", "_reconstruct", named("numpy", "ndarray"), (0,), "b"
    ),
}


@pytest.mark.parametrize("trick", TRICKS)
def test_what_is_no_plain_array_is_refused(tmp_path, trick):
    with pytest.raises(BodyError, match=r"body\.pkl: x: expected an array of numbers"):
        read(tmp_path, program({"x": TRICKS[trick]}))


def test_deep_nesting_is_refused(tmp_path):
    value = array([1.0])
    for _ in range(200):
        value = made("chumpy.ch", "Ch", {"x": value})
    with pytest.raises(BodyError, match="nested"):
        read(tmp_path, program({"x": value}))


def test_files_cut_short_are_refused(tmp_path):
    whole = program({"x": array(np.arange(4.0)), "y": made("chumpy.ch", "Ch", {"x": array([1.0])})})
    for length in range(len(whole)):
        with pytest.raises(BodyError, match="not a readable pickle"):
            read(tmp_path, whole[:length])


@pytest.mark.parametrize(
    "content", [b"\x80\x02Qpersistent\n.", b"Pname\n.", b"\x82\x01.", b"not a pickle", b"\x80\x02}}a."]
)
def test_strange_opcodes_are_refused(tmp_path, content):
    with pytest.raises(BodyError, match="not a readable pickle"):
        read(tmp_path, content)


def test_content_must_be_a_dictionary(tmp_path):
    with pytest.raises(BodyError, match="expected a dictionary of arrays, got a list"):
        read(tmp_path, program([1]))


def test_missing_keys_are_named_by_the_body(tmp_path):
    (tmp_path / "body.pkl").write_bytes(program({"x": array([1.0])}))
    with pytest.raises(BodyError, match="missing v_template, shapedirs"):
        Body.load(tmp_path / "body.pkl")


def test_reading_imports_nothing(tmp_path, monkeypatch):
    """Not even the modules that the file names: importing runs code."""
    (tmp_path / "chumpy.py").write_text(f"open({str(tmp_path / 'was_run')!r}, 'w').close()")
    monkeypatch.syspath_prepend(tmp_path)
    content = program({"x": made("chumpy", "Ch", {"x": array([1.0])})})
    assert read(tmp_path, content) == [1.0]
    assert not (tmp_path / "was_run").exists()
    with pytest.raises(AttributeError):
        pickle.loads(content)
    assert (tmp_path / "was_run").exists(), "the control ran the module"
