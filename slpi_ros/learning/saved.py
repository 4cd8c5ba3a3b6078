"""What was learned as a part of a JSON document, and back: the arrays and figures of an object, by their names."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slpi_ros.errors import ModelError

# Type and dimensions of an array: names, each of which has one size everywhere, or sizes.
Arrays = Mapping[str, tuple[type, tuple[str | int, ...]]]


def written(value: Any) -> Any:
    """Return a value as JSON has it: null for numbers that are not finite, pairs for complex numbers."""
    if isinstance(value, np.ndarray):
        if np.iscomplexobj(value):
            value = np.stack([value.real, value.imag], axis=-1)
        value = value.astype(np.float64).tolist()
    if isinstance(value, list | tuple):
        return [written(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def saved(one: object, arrays: Arrays, figures: Sequence[str] = ()) -> dict[str, Any]:
    """Return the attributes of an object by these names."""
    return {name: written(getattr(one, name)) for name in (*arrays, *figures)}


def read(
    document: Mapping[str, Any], arrays: Arrays, sizes: dict[str | int, int], figures: Sequence[str] = ()
) -> dict[str, Any]:
    """Return what `saved` has made of the attributes of an object; null within an array becomes NaN.

    `sizes` of dimensions by name; those that are not there yet are added. ModelError if an array is of another size.
    """
    found = {name: document[name] for name in (*arrays, *figures)}
    for name, (kind, shape) in arrays.items():
        if found[name] is None:
            continue
        value = np.array(found[name], dtype=np.float64)
        own = (*shape, 2) if kind is complex else shape
        if not value.size:
            # The inner sizes of an empty array are not written.
            value = value.reshape([sizes.setdefault(each, 0) if isinstance(each, str) else each for each in own])
        seen = zip(own, value.shape, strict=False)
        wanted = [each if isinstance(each, int) else sizes.get(each, size) for each, size in seen]
        if value.ndim != len(own) or list(value.shape) != wanted:
            raise ModelError(f"{name} is of another size than the rest; learn the path again")
        sizes |= {each: size for each, size in zip(own, value.shape, strict=True) if isinstance(each, str)}
        found[name] = value[..., 0] + 1j * value[..., 1] if kind is complex else value.astype(kind)
    return found
