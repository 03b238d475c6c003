"""ROS messages of type sensor_msgs/PointCloud2: a buffer of points, and the layout of their fields in it."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def fields_of(message: Any) -> dict[str, NDArray[Any]]:
    """The fields of a cloud by lower-case name, one number per point; rows of organised clouds are concatenated.

    Fields of several numbers per point, or of types unknown to ROS, are left out.

    Args:
        message: with the members of sensor_msgs/PointCloud2.

    Raises:
        ValueError: the buffer is shorter than the message says, or a field extends beyond its point.
    """
    height, width, step = message.height, message.width, message.point_step
    # Some drivers leave row_step at 0 if there is only one row.
    row_step = message.row_step if height > 1 else width * step
    needed = max(height - 1, 0) * row_step + width * step
    if len(message.data) < needed or row_step < width * step:
        raise ValueError(
            f"a PointCloud2 of {height} x {width} points of {step} bytes takes {needed} bytes in rows of {row_step},"
            f" and has {len(message.data)}"
        )
    order = ">" if message.is_bigendian else "<"
    single = [field for field in message.fields if field.datatype in _TYPES and field.count <= 1]
    layout: Any = {
        "names": [str(i) for i in range(len(single))],  # those of the message may be empty or occur twice
        "formats": [order + _TYPES[field.datatype] for field in single],
        "offsets": [field.offset for field in single],
        "itemsize": step,
    }
    points = np.ndarray((height, width), np.dtype(layout), message.data, strides=(row_step, step)).reshape(-1)
    return {field.name.lower(): points[str(i)] for i, field in enumerate(single)}
