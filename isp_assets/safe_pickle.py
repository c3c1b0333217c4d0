"""Read the arrays of an SMPL ``.pkl`` without executing anything the file asks for.

A pickle is a program: it names functions and has them called. This reader maps
every name to an inert record that only keeps its arguments, and refuses names
outside a short list. Arrays are put together afterwards, from checked numbers.
Official SMPL files (Python 2, with chumpy objects and scipy sparse matrices)
and files saved again by Python 3 are read; neither chumpy nor its code is needed.
"""

import io
import pickle
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from isp_assets.errors import BodyError

# The names that numpy, scipy and pickle itself write for plain arrays, under Python 2 and 3.
_NUMPY_MODULES = [
    f"numpy.{core}.{module}" for core in ("core", "_core") for module in ("multiarray", "numeric")
]
_KINDS = {
    **{
        (module, name): name
        for module in _NUMPY_MODULES
        for name in ("_reconstruct", "_frombuffer", "scalar")
    },
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    **{
        (module, f"{layout}_{suffix}"): layout
        for layout in ("csc", "csr", "coo")
        for module in (f"scipy.sparse.{layout}", f"scipy.sparse._{layout}", "scipy.sparse")
        for suffix in ("matrix", "array")
    },
    ("_codecs", "encode"): "encode",
    **{
        (module, name): name
        for module in ("builtins", "__builtin__")
        for name in ("bytes", "bytearray", "object", "set")
    },
}
_RECONSTRUCTORS = {
    (module, name) for module in ("copyreg", "copy_reg") for name in ("_reconstructor", "__newobj__")
}
_NUMBER_TYPE = re.compile(r"^[<>=|]?(b1|[iu][1248]|f[248])$")
_MAX_ENTRIES = 200_000_000  # of one dense array: ten times the largest in any SMPL file
_MAX_DEPTH = 16


def read_smpl_pickle(path: Path, keys: Iterable[str]) -> dict[str, np.ndarray]:
    """The arrays stored under ``keys`` in the dictionary that a pickle holds; absent keys are left out.

    Raises:
        BodyError: If the file is damaged, names anything but plain arrays, or holds no dictionary.
    """
    try:
        content = _Reader(io.BytesIO(path.read_bytes()), where=str(path)).load()
    except BodyError:
        raise
    except Exception as error:  # a damaged pickle can raise anything: IndexError, KeyError, MemoryError, ...
        raise BodyError(f"{path}: not a readable pickle ({type(error).__name__}: {error})") from error
    if not isinstance(content, dict):
        raise BodyError(f"{path}: expected a dictionary of arrays, got a {type(content).__name__}")
    arrays = {}
    for key in keys:
        if key in content:
            try:
                arrays[key] = _resolve(content[key])
            except (ValueError, TypeError, KeyError, IndexError) as error:
                raise BodyError(f"{path}: {key}: expected an array of numbers ({error})") from error
    return arrays


class _Record:
    """What a pickle asked to have made: the kind, the arguments and the state; nothing is run."""

    kind = ""
    args: tuple[Any, ...]
    state: Any

    # Not __init__: pickle makes some objects through __new__ alone.
    def __new__(cls, *args: Any) -> "_Record":
        self = super().__new__(cls)
        self.args, self.state = args, None
        return self

    def __setstate__(self, state: Any) -> None:
        self.state = state


def _reconstruct_record(cls: Any, *_: Any) -> _Record:
    """Stands for ``copyreg._reconstructor``: an empty record of the class, which must be one of ours."""
    if not (isinstance(cls, type) and issubclass(cls, _Record)):
        raise pickle.UnpicklingError("a reconstructor was given no class")
    return cls()


class _Reader(pickle.Unpickler):
    """An unpickler whose every global is a record class."""

    def __init__(self, file: io.BytesIO, *, where: str) -> None:
        super().__init__(file, encoding="latin1")
        self._where = where

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _RECONSTRUCTORS:
            return _reconstruct_record
        # Any chumpy class will do: it becomes a record like all others, and only its numbers are looked at.
        kind = f"chumpy {name}" if module.split(".")[0] == "chumpy" else _KINDS.get((module, name))
        if kind is None:
            raise BodyError(
                f"{self._where}: the pickle asks for '{module}.{name}', which no SMPL body needs; expected "
                "numpy, scipy.sparse and chumpy arrays. Nothing was run; do not open this file elsewhere"
            )
        return type("_Record", (_Record,), {"kind": kind})


def _resolve(value: Any, depth: int = 0) -> np.ndarray:
    """The array that a record stands for."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"nested more than {_MAX_DEPTH} deep")
    if not isinstance(value, _Record):
        raise ValueError(f"got a {type(value).__name__}")
    if value.kind.startswith("chumpy "):
        return _resolve_chumpy(value, depth + 1)
    if value.kind in ("csc", "csr", "coo"):
        return _resolve_sparse(value, depth + 1)
    if value.kind == "_reconstruct":
        # Format version 1 comes first in the state since numpy 1.0; before that there was none.
        shape, dtype, fortran, data = value.state[-4:]
        return _array(data, dtype, shape, order="F" if fortran else "C")
    if value.kind == "_frombuffer":
        data, dtype, shape, order = value.args
        return _array(data, dtype, shape, order=order)
    if value.kind == "scalar":
        dtype, data = value.args
        return _array(data, dtype, (), order="C")
    raise ValueError(f"got a {value.kind}")


def _resolve_chumpy(value: _Record, depth: int) -> np.ndarray:
    """The numbers of a chumpy ``Ch`` (its ``x``) or of a ``Select`` (``a`` at ``idxs``)."""
    state = value.state
    if not isinstance(state, dict):
        raise ValueError(f"{value.kind} without state")
    if "x" in state:
        return _resolve(state["x"], depth)
    if "a" in state and "idxs" in state:
        picked = _resolve(state["a"], depth).ravel()[_resolve(state["idxs"], depth)]
        shape = state.get("preferred_shape")
        return picked if shape is None else picked.reshape(_checked_shape(shape))
    raise ValueError(f"{value.kind} holds no plain array; load it with chumpy and save its values")


def _resolve_sparse(value: _Record, depth: int) -> np.ndarray:
    state = value.state
    if not isinstance(state, dict):
        raise ValueError(f"{value.kind} matrix without state")
    shape = _checked_shape(state.get("_shape", state.get("shape")))
    data = _resolve(state["data"], depth)
    if value.kind == "coo":
        pair = state["coords"] if "coords" in state else (state["row"], state["col"])
        row, column = (_resolve(index, depth) for index in pair)
        return sparse.coo_matrix((data, (row, column)), shape=shape).toarray()
    make = sparse.csc_matrix if value.kind == "csc" else sparse.csr_matrix
    matrix = make((data, _resolve(state["indices"], depth), _resolve(state["indptr"], depth)), shape=shape)
    matrix.check_format(full_check=True)  # scipy's C code trusts the indices: check them before it runs
    return matrix.toarray()


def _array(data: Any, dtype: Any, shape: Any, *, order: Any) -> np.ndarray:
    """An array of plain numbers from raw bytes; object and structured types are refused."""
    number = _number_type(dtype)
    shape = _checked_shape(shape)
    raw = _raw_bytes(data)
    expected = int(np.prod(shape, dtype=np.int64)) * number.itemsize
    if len(raw) != expected:
        raise ValueError(f"expected {expected} bytes for shape {list(shape)} of {number}, got {len(raw)}")
    return np.frombuffer(raw, dtype=number).reshape(shape, order="F" if order == "F" else "C")


def _number_type(dtype: Any) -> np.dtype:
    if not (isinstance(dtype, _Record) and dtype.kind == "dtype" and dtype.args):
        raise ValueError("an array without a number type")
    code = dtype.args[0]
    order = dtype.state[1] if dtype.state else "="
    if not (isinstance(code, str) and _NUMBER_TYPE.match(code) and order in ("<", ">", "=", "|")):
        raise ValueError(f"array type {code!r} is refused; expected plain numbers")
    return np.dtype(code if order in "=|" else order + code.lstrip("<>=|"))


def _checked_shape(shape: Any) -> tuple[int, ...]:
    if not (isinstance(shape, (tuple, list)) and all(type(size) is int and size >= 0 for size in shape)):
        raise ValueError(f"bad array shape {shape!r}")
    # Python's integers do not overflow, numpy's product would.
    entries = 1
    for size in shape:
        entries *= size
    if entries > _MAX_ENTRIES:
        raise ValueError(f"array shape {list(shape)} is larger than any body needs")
    return tuple(shape)


def _raw_bytes(data: Any) -> bytes:
    """Bytes as the different Pythons pickle them: raw, as latin-1 text, or as a request to encode text."""
    if isinstance(data, _Record) and data.kind == "encode" and data.args[1:] in (("latin1",), ("latin-1",)):
        data = data.args[0]
    elif isinstance(data, _Record) and data.kind in ("bytes", "bytearray") and len(data.args) <= 1:
        return _raw_bytes(data.args[0]) if data.args else b""
    if isinstance(data, str):
        return data.encode("latin1")
    if isinstance(data, (bytes, bytearray)):
        return bytes(data)
    raise ValueError(f"expected raw bytes, got a {type(data).__name__}")
