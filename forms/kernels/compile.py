"""How the per-cell kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numba
import numpy as np
import numpy.typing as npt
from numba import types
from numba.extending import intrinsic
from numba.np.numpy_support import carray as carray

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
_TYPES = {
    "Array": types.float64[:, ::1],
    "Ints": types.Array(types.int32, 2, "C", readonly=True),
    "bool": types.boolean,
    "float": types.float64,
    "None": types.void,
}

# Fused multiply-add, but no reordering and nothing that would hide a NaN; x / 0 is inf. C does not
# call them, and what would let it takes time to compile.
OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "nsz"},
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
}


def compiled[F: Callable[..., Any]](function: F) -> F:
    """A function that other compiled functions call."""
    return cast(F, numba.njit(**OPTIONS)(function))


def cell_loop[F: Callable[..., Any]](function: F) -> F:
    """A loop over cells that Python calls, compiled when its module is imported.

    Its arguments are annotated as `Ints`, `Array` or `bool`, and it returns a float or None.
    """
    *arguments, result = (_TYPES[name] for name in function.__annotations__.values())
    return cast(F, numba.njit(result(*arguments), cache=True, **OPTIONS)(function))


def _local_array(typing_context: Any, size: Any) -> Any:
    """A pointer to `size` doubles on the stack, uninitialised: no allocation in a kernel."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        with builder.goto_entry_block():
            return builder.alloca(context.get_value_type(types.float64), size.literal_value)

    return types.CPointer(types.float64)(size), generate


local_array: Any = intrinsic(prefer_literal=True)(_local_array)
