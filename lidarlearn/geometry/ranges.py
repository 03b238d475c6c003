"""Distances from the sensor."""

from jaxtyping import Float
from torch import Tensor


def squared_ranges(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Squares of the distances from the origin [m^2].

    Summed axis by axis, several times as fast as a reduction over three coordinates, above all where they lie apart in
    memory.
    """
    x, y, z = points.unbind(-1)
    return (x * x).addcmul_(y, y).addcmul_(z, z)
