"""Tables of named arrays: MATLAB files of all versions, NumPy archives, TDMS files of LabVIEW."""

import io
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import RecordError
from slpi_ros.io.columns import joined, printable
from slpi_ros.io.input_limits import (
    ARRAY_BYTES,
    MOST_COLUMNS,
    TABLE_BYTES,
    LimitError,
    most_unpacked,
    read_input,
    require_count,
    require_unpacked,
)
from slpi_ros.io.table_files import Table, unreadable

HDF5, TDMS, ZIP, _MATLAB_7_3 = b"\x89HDF\r\n\x1a\n", b"TDSm", b"PK\x03\x04", b"MATLAB 7"


class _Other(str):
    """What a value is that holds no numbers."""


# Bytes that are unpacked at once.
_AT_ONCE = 2**20
# Structures within structures.
_DEEPEST = 16
# Fields of a structure that hold its numbers, their name and their unit: of Simulink, dSPACE and other programs.
_DATA, _NAMES, _UNITS = ("values", "data"), ("label", "name"), ("unit", "units")
_SAVE_PLAIN = "save plain vectors"


@dataclass(frozen=True)
class ArrayTable(Table):
    """Table of vectors; a matrix is split into vectors along its longer side, named ``name(:,1)`` or ``name(1,:)``."""

    arrays: Mapping[str, NDArray[Any]]

    def _values(self, wanted: Sequence[str]) -> dict[str, FloatArray]:
        arrays = {column: self.arrays[column] for column in wanted}
        rows = max(array.size for array in arrays.values())
        for column, array in arrays.items():
            if np.iscomplexobj(array):
                raise RecordError(f"{self.path}: '{column}' is complex; save its real part")
            if array.size != rows:
                (other,) = [name for name in wanted if arrays[name].size == rows][:1]
                raise RecordError(
                    f"{self.path}: '{column}' has {array.size} values, '{other}' {rows}; as many are needed of each, "
                    "at least two; of a sampling period --sample-period"
                )
        return {column: _as_numbers(array) for column, array in arrays.items()}

    def holds_dates(self, column: str) -> bool:
        """Return whether an array holds dates."""
        return self.arrays[column].dtype.kind == "M"

    def single(self, column: str) -> float | None:
        """Return the value of an array of size one, such as a sampling period; else None."""
        array = self.arrays.get(column, np.empty(0))
        return float(array.ravel()[0]) if array.size == 1 and not np.iscomplexobj(array) else None

    def _place(self, row: int, column: str) -> str:
        return f"value {row + 1} of '{column}'"


def _as_numbers(array: NDArray[Any]) -> FloatArray:
    """Return a vector as numbers; dates as seconds from the first one."""
    if array.dtype.kind == "M":
        return np.asarray((array - array[0]) / np.timedelta64(1, "ns") * 1e-9)
    return array.astype(np.float64)


def load_arrays(path: Path, begin: bytes, group: str | None = None) -> ArrayTable:
    """Read the vectors in a file that begins with some bytes; `group`: of a TDMS file."""
    kind = "a MATLAB file" if path.suffix.lower() == ".mat" else "a file of arrays"
    try:
        content = read_input(path, TABLE_BYTES)
        period = None
        if begin.startswith(TDMS):
            values, period = _tdms(content, group)
        elif HDF5 in (begin[:8], content[512:520]) or begin.startswith(_MATLAB_7_3):
            kind += " of version 7.3" if begin.startswith(_MATLAB_7_3) else ""
            values = _hdf5(content)
        elif begin.startswith(ZIP):
            values = _npz(content)
        else:
            values = _mat(content)
        found = dict(_flattened(values))
    except LimitError as error:
        raise RecordError(f"{path}: {error.strerror}; save only the vectors of the record") from None
    except ImportError:
        raise
    except Exception as error:
        # Readers raise exceptions of many types for files that are damaged or of another kind.
        remedy = "save it anew with `save(..., '-v7')`" if "MATLAB" in kind else _SAVE_PLAIN
        raise unreadable(path, error, kind, remedy) from error
    arrays = {name: array for name, array in found.items() if not isinstance(array, str)}
    others = [f"{name} ({what})" for name, what in found.items() if isinstance(what, str)]
    if not arrays:
        raise RecordError(f"{path}: no numeric vector; there is {joined(others) or 'nothing'}; {_SAVE_PLAIN}")
    return ArrayTable(path, tuple(arrays), arrays, period=period, left_out=tuple(others))


def _flattened(values: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any] | str]]:
    """Yield name and vector of all columns, and what else there is, as text, by name."""
    # Of a file with a single structure the name of that is left out.
    (first, *others) = values.items() or [("", {})]
    if not others and isinstance(first[1], list) and len(first[1]) == 1 and isinstance(first[1][0], dict):
        values = first[1][0]
    count = 0
    for name, array in _each(values, _DEEPEST):
        count += 1 if isinstance(array, str) else min(array.shape)
        require_count(count, MOST_COLUMNS, "variables")
        if isinstance(array, str) or 1 in array.shape:
            yield name, array if isinstance(array, str) else array.ravel()
        elif array.shape[0] >= array.shape[1]:
            yield from ((f"{name}(:,{number + 1})", array[:, number]) for number in range(array.shape[1]))
        else:
            yield from ((f"{name}({number + 1},:)", array[number]) for number in range(array.shape[0]))


def _each(values: Mapping[str, Any], deepest: int) -> Iterator[tuple[str, NDArray[Any] | str]]:
    """Yield name and matrix of all numeric values in structures, and the kind of other values."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value = value[:, None] if value.ndim == 1 else value
            plain = value.ndim == 2 and value.size and value.dtype.kind in "biufcM"
            shape = "x".join(map(str, value.shape))
            yield printable(name), value if plain else f"{value.dtype.name.replace('float64', 'double')}, {shape}"
        elif isinstance(value, list) and deepest:
            for number, one in enumerate(value):
                place = name if len(value) == 1 else f"{name}({number + 1})"
                if isinstance(one, dict):
                    named = _named(one)
                    inner = named or {f"{place}.{field}": part for field, part in one.items()}
                else:
                    inner = {place: one}
                yield from _each(inner, deepest - 1)
        elif isinstance(value, _Other | list):
            yield printable(name), value if isinstance(value, _Other) else "nested too deeply"


def _named(structure: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the numbers of a structure that holds their name; None if it does not."""
    fields = {field.casefold(): value for field, value in structure.items()}
    text = next((fields[name] for name in _NAMES if _is_text(fields.get(name)) and fields[name].strip()), "")
    data = next((fields[name] for name in _DATA if isinstance(fields.get(name), np.ndarray)), None)
    unit = next((fields[name] for name in _UNITS if _is_text(fields.get(name))), "").strip()
    if not text or data is None:
        return None
    name = text.strip().replace('"', "")
    return {f"{name} [{unit}]" if unit else name: data}


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and not isinstance(value, _Other)


def _npz(content: bytes) -> dict[str, Any]:
    """Return the arrays of a NumPy archive; of records their fields."""
    require_unpacked(content)
    values: dict[str, Any] = {}
    with np.load(io.BytesIO(content)) as archive:
        for name in archive.files:
            try:
                array = archive[name]
                values[name] = [{field: array[field] for field in array.dtype.names}] if array.dtype.names else array
            except ValueError:
                values[name] = _Other("objects")
    return values


def _tdms(content: bytes, group: str | None) -> tuple[dict[str, Any], float | None]:
    """Return the channels of a group, and the period (s) of waveforms; LimitError if several groups are there."""
    from nptdms import TdmsFile

    file = TdmsFile.read(io.BytesIO(content))
    groups = {one.name: one for one in file.groups() if any(len(channel) for channel in one.channels())}
    if group is None and len(groups) > 1 or group is not None and group not in groups:
        raise LimitError(f"holds the groups {joined(list(groups))}: name one of them (--group)")
    values, periods = dict[str, Any](), set[float]()
    for channel in (channel for name, one in groups.items() if group in (None, name) for channel in one.channels()):
        unit = channel.properties.get("unit_string") or channel.properties.get("NI_UnitDescription") or ""
        data = np.asarray(channel[:])
        values[f"{channel.name} [{unit}]" if unit else channel.name] = (
            data if data.dtype.kind != "O" else _Other("text")
        )
        if channel.properties.get("wf_increment"):
            periods.add(float(channel.properties["wf_increment"]))
    return values, periods.pop() if len(periods) == 1 else None


def _hdf5(content: bytes) -> dict[str, Any]:
    """Return the variables of a MATLAB file of version 7.3, or of another HDF5 file."""
    import h5py

    left = [min(ARRAY_BYTES, most_unpacked(len(content)))]

    def value(item: Any, deepest: int) -> Any:
        if not deepest:
            return _Other("nested too deeply")
        if isinstance(item, h5py.Group):
            # A link may lead to another file.
            names = [name for name in item if isinstance(item.get(name, getlink=True), h5py.HardLink)]
            require_count(len(names), MOST_COLUMNS, "variables")
            fields = {name: value(item[name], deepest - 1) for name in names if not name.startswith("#")}
            # The elements of an array of structures are referred to, by each of its fields.
            many = {len(part) for part in fields.values() if isinstance(part, list)}
            if len(many) == 1 and not any("MATLAB_class" in item[name].attrs for name in fields):
                return [dict(zip(fields, each, strict=True)) for each in zip(*fields.values(), strict=True)]
            return [fields]
        kind = bytes(item.attrs.get("MATLAB_class", b"")).decode() if "MATLAB_class" in item.attrs else ""
        left[0] -= item.nbytes
        if left[0] < 0 or item.is_virtual or item.external:
            raise LimitError("unpacks to more than any record")
        if item.dtype == h5py.ref_dtype:
            return [value(item.file[one], deepest - 1) if one else _Other("empty") for one in item[()].ravel()]
        if "MATLAB_object_decode" in item.attrs or item.dtype.kind not in "biuf" or item.attrs.get("MATLAB_empty"):
            return _Other(kind or item.dtype)
        array = np.asarray(item[()]).T
        return array.astype(np.uint16).tobytes().decode("utf-16-le") if kind == "char" else array

    with h5py.File(io.BytesIO(content), "r") as file:
        (variables,) = value(file, _DEEPEST)
    return dict(variables)


def _mat(content: bytes) -> dict[str, Any]:
    """Return the variables of a MATLAB file up to version 7."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128], "")
    if not order:
        from scipy.io import loadmat

        # Version 4; it has no mark.
        return {name: value for name, value in loadmat(io.BytesIO(content)).items() if not name.startswith("__")}
    left = min(ARRAY_BYTES, most_unpacked(len(content)))
    values: dict[str, Any] = {}
    for kind, data in _elements(content, order, 128):
        if kind == _COMPRESSED:
            left -= _unpacked_size(data, left)
            ((kind, data),) = _elements(zlib.decompress(data), order)
        if kind == _MATRIX:
            name, value = _matrix(data, order)
            if name:
                values[name] = value
            require_count(len(values), MOST_COLUMNS, "variables")
    return values


def _unpacked_size(packed: bytes, most: int) -> int:
    """Return the size of packed data, found without keeping them; LimitError if it is larger than `most`."""
    decoder, size = zlib.decompressobj(), 0
    while packed and not decoder.eof:
        size += len(decoder.decompress(packed, _AT_ONCE))
        packed = decoder.unconsumed_tail
        if size > most:
            raise LimitError("unpacks to more than any record")
    return size


# https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf: types of elements, and classes of matrices.
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _OBJECT, _CHAR, _NUMBERS = 1, 2, 3, 4, range(6, 16)
_CLASSES = {3: "object", 5: "sparse", 16: "function", 17: "object"}
_COMPLEX, _LOGICAL = 0x800, 0x200


def _elements(data: bytes, order: str, at: int = 0) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of the elements in a part of a MATLAB file; ValueError if one is cut off."""
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        begin, step = at + 8, 8 + size + (-size % 8 if kind != _COMPRESSED else 0)
        if kind >> 16:
            # The content is in the same eight bytes.
            kind, size, begin, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        if begin + size > len(data):
            raise ValueError("a variable is cut off")
        yield kind, data[begin : begin + size]
        at += step


def _matrix(data: bytes, order: str, deepest: int = _DEEPEST) -> tuple[str, Any]:
    """Return name and value of a variable: an array, a text, a list of structures or cells, or what else it is."""
    parts = _elements(data, order)

    def part(of: Mapping[int, str] = _TYPES) -> tuple[str, bytes]:
        kind, content = next(parts, (0, b""))
        if kind not in of:
            raise ValueError(f"a part of a variable has the wrong type {kind}")
        return of[kind], content

    def nested() -> Any:
        kind, content = next(parts, (0, b""))
        if kind != _MATRIX:
            raise ValueError(f"a part of a variable has the wrong type {kind}")
        return _matrix(content, order, deepest - 1)[1] if content and deepest else _Other("empty")

    (flags,) = np.frombuffer(part()[1][:4], f"{order}u4").tolist()
    which = flags & 0xFF
    if which == 17:
        # An object of a class, such as a string: of it there is only the name.
        return part(_TEXTS)[1].decode("latin-1"), _Other("object")
    shape = np.frombuffer(part()[1], f"{order}i4").tolist()
    name = part(_TEXTS)[1].decode("latin-1")
    count = int(np.prod(shape, dtype=np.float64)) if all(size >= 0 for size in shape) else -1
    if count < 0 or len(shape) > 32:
        raise ValueError("the shape of a variable is wrong")
    if which in _NUMBERS:
        kind, content = part()
        array = np.frombuffer(content, order + kind)[:count].reshape(shape, order="F")
        if flags & _COMPLEX:
            kind, content = part()
            array = array + 1j * np.frombuffer(content, order + kind)[:count].reshape(shape, order="F")
        return name, array if which not in (6, 7) or array.dtype.kind in "fc" else array.astype(np.float64)
    if which == _CHAR:
        kind, content = part(_TEXTS)
        return name, content.decode(
            kind if kind in ("latin-1", "utf-8") else f"{kind}-{'le' if order == '<' else 'be'}"
        )
    if which == _CELL and 8 * count <= len(data):
        return name, [nested() for _ in range(count)]
    if which == _STRUCT:
        (length,) = np.frombuffer(part()[1], f"{order}i4").tolist()
        text = part(_TEXTS)[1]
        fields = [
            text[at : at + length].split(b"\0")[0].decode("latin-1") for at in range(0, len(text), max(length, 1))
        ]
        if 8 * count * max(len(fields), 1) > len(data):
            raise ValueError("a structure is cut off")
        return name, [{field: nested() for field in fields} for _ in range(count)]
    return name, _Other(f"{_CLASSES.get(which, 'unknown')}, {'x'.join(map(str, shape))}")
