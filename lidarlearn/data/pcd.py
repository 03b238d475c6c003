"""PCL's clouds (.pcd): text, binary and compressed, read with the library `pypcd4`.

The library is stricter than the format: it requires a COUNT, single blanks between numbers, and comments in UTF-8.
"""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pypcd4 import PointCloud

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.scan_files import read_bytes

_HEADER = re.compile(rb"(.*?^DATA[^\S\n]+\w+)\s*?\n", re.DOTALL | re.MULTILINE)


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """The fields by lower-case name.

    Raises:
        DamagedFileError: the file is not a .pcd file, or is truncated.
    """
    content = bytes(read_bytes(path))
    header = _HEADER.match(content)
    if header is None:
        raise DamagedFileError(path, "no .pcd file: no header up to a line DATA")
    body = content[header.end() :]
    try:
        entries = _entries(header[1].decode("latin-1"))
        needed = _needed_bytes(entries, body)
        cloud = PointCloud.from_fileobj(_normalized(entries, body)) if len(body) >= needed else None
    except Exception as error:  # the library raises many types, none of its own
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DamagedFileError(path, f"no .pcd file that can be read ({reason})") from error
    if cloud is None:
        raise DamagedFileError(path, f"truncated: {len(body)} bytes of points where its header says {needed}")
    rows = np.atleast_1d(cloud.pc_data)
    if len(rows) != cloud.metadata.points:
        raise DamagedFileError(path, f"truncated: {len(rows)} points where its header says {cloud.metadata.points}")
    return {name.lower(): rows[name] for name in cloud.fields}


def _entries(header: str) -> dict[str, list[str]]:
    """The words of each line by its first word; with the COUNT that is optional in the format."""
    lines = (line.split() for line in header.splitlines() if not line.startswith("#"))
    entries = {words[0].upper(): words[1:] for words in lines if words}
    return {"COUNT": ["1"] * len(entries["FIELDS"])} | entries


def _needed_bytes(entries: dict[str, list[str]], body: bytes) -> int:
    """Size of the points [B]; 0 for text, where it is unknown."""
    match entries["DATA"][0]:
        case "binary":
            fields = (int(size) * int(count) for size, count in zip(entries["SIZE"], entries["COUNT"], strict=True))
            return int(entries["POINTS"][0]) * sum(fields)
        case "binary_compressed":
            return 8 + int.from_bytes(body[:4], "little")
        case _:
            return 0


def _normalized(entries: dict[str, list[str]], body: bytes) -> io.BufferedReader:
    """The file in the spelling that the library accepts."""
    entries = entries | {"VERSION": ["0.7"]}  # it rejects older versions, whose lines mean the same
    order = sorted(entries, key=lambda entry: entry == "DATA")  # the header ends with this line
    header = "".join(f"{entry} {' '.join(entries[entry])}\n" for entry in order)
    if entries["DATA"] == ["ascii"]:
        body = b"\n".join(b" ".join(line.split()) for line in body.split(b"\n"))
    return io.BufferedReader(io.BytesIO(header.encode() + body))
