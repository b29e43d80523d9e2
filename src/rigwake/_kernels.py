"""Compiled loops whose copies on disk stay right when several processes compile at once."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from glob import escape
from pathlib import Path
from typing import Any
from uuid import uuid4

import numba
from numba.core.caching import IndexDataCacheFile

__all__ = ["KernelFile", "inlined", "is_stored", "njit"]


class KernelFile(IndexDataCacheFile):
    """Files of one kernel, one for each set of argument types, and an index that says which is which.

    numba numbers these files. Two processes that compile for different types at the same time choose the same
    number; the index may then name the code of one for the types of the other, which crashes or computes wrongly,
    also in later runs (numba issues 4807 and 10128). Here each file has a name of its own, so that what can get lost
    is an entry of the index: that kernel is compiled once more.
    """

    def _data_name(self, number: int) -> str:
        name: str = super()._data_name(number)
        return f"{name.removesuffix('.nbc')}.{uuid4().hex[:16]}.nbc"

    def _save_index(self, overloads: dict[Any, str]) -> None:
        """Besides, remove what is outdated: of this kernel as it was, and where it stood in the source before."""
        super()._save_index(overloads)
        folder, own = Path(self._cache_path), self._index_name.removesuffix(".nbi")
        outdated = set(folder.glob(f"{escape(own)}.*.nbc")) - {folder / name for name in overloads.values()}
        name, _, place = own.rpartition("-")
        python = place.partition(".")[2]  # another Python, with another numba perhaps, keeps its own
        for index in folder.glob(f"{escape(name)}-*.{escape(python)}.nbi"):
            if index.stem != own and not self._is_current(index):
                # whole files only: a process of the former source may be writing one, and fails without it
                outdated |= {index, *folder.glob(f"{escape(index.stem)}.*.nbc")}
        for path in outdated:
            with suppress(OSError):  # of another user, or in use: nothing of this kernel depends on it
                path.unlink(missing_ok=True)

    def _is_current(self, index: Path) -> bool:
        """Whether the index of a kernel of this name belongs to the source as it is."""
        try:
            return bool(KernelFile(str(index.parent), index.stem, self._source_stamp)._load_index())
        except Exception:  # cut off or unreadable: what pickle raises then is anything
            return False


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: `numba.njit(cache=True, **options)`, with files that concurrent processes cannot mix up."""

    def compiled(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(cache=True, **options)(function)
        files = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
        if isinstance(files, IndexDataCacheFile):  # not where compilation is switched off (NUMBA_DISABLE_JIT)
            files.__class__ = KernelFile
        return kernel

    return compiled


# For what compiled loops call. Inlined by LLVM: numba's own inlining (`inline="always"`) infers the types of the same
# lines again at every level, which takes five times as long. A function that is not inlined would have two copies, one
# of them optimised again inside its caller, and which one runs would differ between the process that compiles and those
# that load, by a rounding of sums. Pixels may be NaN: `nnan` is left out
inlined = njit(
    nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy", forceinline=True
)


def is_stored(kernel: Any) -> bool:
    """Whether compiled code of a kernel, as it stands in the source now, is on disk."""
    files = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    try:
        return isinstance(files, KernelFile) and bool(files._load_index())
    except Exception:  # cut off or unreadable: what pickle raises then is anything
        return False
