"""How the renderer's loops are compiled: without the interpreter's lock, inlined, and without counting references."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from rigwake._kernels import njit

# no `nnan`, `ninf`: misses are infinite. Inlined by LLVM: a call would copy the arrays' descriptors each time
_FAST = {"contract", "reassoc", "arcp", "nsz", "afn"}
loop = njit(nogil=True, fastmath=_FAST, error_model="numpy")
inlined = njit(nogil=True, fastmath=_FAST, error_model="numpy", forceinline=True)


@intrinsic
def borrowed(context: Any, record: Any) -> Any:
    """The same named tuple of arrays, without their owners.

    Numba counts references to an array wherever a function with branches is entered: atomic operations for every
    ray, on counters that all threads share. The caller of a loop owns the arrays until it returns.
    """

    def generate(target: Any, builder: Any, signature: Any, args: Any) -> Any:
        (value,) = args
        for i, member in enumerate(record.types):
            if isinstance(member, types.Array):
                array = make_array(member)(target, builder, builder.extract_value(value, i))
                array.meminfo = array.meminfo.type(None)
                value = builder.insert_value(value, array._getvalue(), i)
        return value

    return record(record), generate
