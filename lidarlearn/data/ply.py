"""Polygon files (.ply): the properties of their vertices.

On disk: a text header lists the elements and the type of each of their properties; the values follow in the same
order, as text or binary. Types have two sets of names, and programs mix them: Open3D writes `uchar` beside `uint16`.
Elements after the vertices (PCL's camera, faces) are ignored.
"""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.scan_files import read_bytes

_HEADER = re.compile(rb"ply\s*?\n(.*?)^end_header\s*?\n", re.DOTALL | re.MULTILINE)
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    **{"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"},
    **{"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


@dataclass(frozen=True)
class _Element:
    """An element of the header.

    Args:
        name: "vertex", "face", ...
        count: number of records.
        properties: name and type of each; the type of a list is several words.
    """

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    def dtype(self, order: str) -> np.dtype[Any]:
        """Type of a binary record, whose fields are numbered: names may occur twice.

        Raises:
            ValueError: a property has an unknown type, or is a list, whose records differ in length.
        """
        if unknown := [f"{kind} {name}" for name, kind in self.properties if kind not in _TYPES]:
            raise ValueError(f"properties of element {self.name} that cannot be read: {', '.join(unknown)}")
        return np.dtype([(str(i), order + _TYPES[kind]) for i, (_, kind) in enumerate(self.properties)])


def read_ply(path: Path) -> dict[str, NDArray[Any]]:
    """The properties of the vertices by lower-case name.

    Raises:
        DamagedFileError: the file is not a .ply file, or is truncated.
    """
    content = read_bytes(path)
    header = _HEADER.match(content)
    if header is None:
        raise DamagedFileError(path, "no .ply file: it does not begin with `ply` and a header up to `end_header`")
    try:
        encoding, elements = _parsed(header[1].decode("latin-1"))
        place = [element.name for element in elements].index("vertex")
        before, vertices = elements[:place], elements[place]
        if encoding == "ascii":
            rows = _text_rows(content[header.end() :], sum(element.count for element in before), vertices)
        else:
            rows = _binary_rows(content, header.end(), before, vertices, _ORDERS[encoding])
    except (ValueError, KeyError, IndexError) as error:
        raise DamagedFileError(path, f"no .ply file that can be read ({error})") from error
    if len(rows) != vertices.count:
        raise DamagedFileError(path, f"truncated: {len(rows)} points where its header says {vertices.count}")
    return {name.lower(): rows[str(i)] for i, (name, _) in enumerate(vertices.properties)}


def write_ply(path: Path, fields: Mapping[str, NDArray[np.float32]]) -> None:
    """Write a cloud as a binary .ply file.

    Args:
        path: the file.
        fields: x, y, z and any others, one value per point.
    """
    rows = np.stack(list(fields.values()), axis=1).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in fields)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def _parsed(header: str) -> tuple[str, list[_Element]]:
    """The encoding, and all elements in order."""
    encoding, elements = "", list[_Element]()
    for words in map(str.split, header.splitlines()):
        match words:
            case ["format", encoding, _]:
                pass
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
            case ["property", *kind, name]:
                elements[-1].properties.append((name, " ".join(kind)))
    return encoding, elements


def _binary_rows(
    content: bytearray, start: int, before: list[_Element], vertices: _Element, order: str
) -> NDArray[Any]:
    """The vertices; fewer than the header says if the file is truncated."""
    start += sum(element.count * element.dtype(order).itemsize for element in before)
    dtype = vertices.dtype(order)
    available = max(len(content) - start, 0) // max(dtype.itemsize, 1)
    return np.frombuffer(content, dtype, min(available, vertices.count), min(start, len(content)))


def _text_rows(text: bytearray, before: int, vertices: _Element) -> NDArray[Any]:
    """The vertices after `before` lines of other elements; fewer than the header says if the file is truncated."""
    lines = text.split(b"\n")[before:][: vertices.count]
    dtype = np.dtype([(name, "f8") for name in vertices.dtype("=").names or ()])
    filled = [line for line in lines if line.strip()]
    return np.loadtxt(io.BytesIO(b"\n".join(filled)), dtype, comments=None, ndmin=1) if filled else np.zeros(0, dtype)
