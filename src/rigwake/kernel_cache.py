"""Where compiled loops are kept, when neither the installation nor the home folder can be written.

numba keeps them beside the source or in the user's cache folder, and refuses to start where it can write neither:
in a container without a home, say.
"""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from functools import lru_cache
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
_PLAIN_WORDS = "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"
_PACKAGE = Path(__file__).parent


@lru_cache(maxsize=1)
def provide_kernel_cache() -> Path | None:
    """Choose a folder of temporary files for compiled loops if no better place can be written; that folder, if so.

    Sets the variable NUMBA_CACHE_DIR (and MPLCONFIGDIR, for figures), which other processes inherit.
    """
    given = os.environ.get(VARIABLE)
    if given and _can_be_written(Path(given)):
        return None
    if not given and (_can_be_written(_PACKAGE / "__pycache__") or _can_be_written(_user_cache())):
        return None
    folder = _private_folder()
    if folder is None:
        return None
    os.environ[VARIABLE] = str(folder)
    os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))
    if "numba" in sys.modules:
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    return folder


def speed_up_compilation() -> None:
    """Before numba is imported: have it leave the messages of failed guesses of types uncoloured. It makes thousands
    while it compiles, and where `colorama` is installed it colours each, which takes a third of its time."""
    os.environ.setdefault(_PLAIN_WORDS, "1")


def _can_be_written(folder: Path) -> bool:
    """Whether files can be made in the folder, which may have to be made first."""
    for above in (folder, *folder.parents):
        if above.exists():
            try:  # permissions alone do not tell: disks can be read-only or full
                with tempfile.TemporaryFile(dir=above):
                    return True
            except OSError:
                return False
    return False


def _user_cache() -> Path:
    """The folder that numba uses: the user's cache."""
    given = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return Path(given) if given else Path(os.path.expanduser("~")).absolute() / ".cache"


def _private_folder() -> Path | None:
    """A folder among the temporary files that nobody else can write: what is in it gets executed."""
    owner = os.getuid() if hasattr(os, "getuid") else 0
    try:
        folder = Path(tempfile.gettempdir()) / f"rigwake-kernels-{owner}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
        if os.name == "posix" and not (private and found.st_uid == owner):
            folder = Path(tempfile.mkdtemp(prefix="rigwake-kernels-"))
    except OSError:
        return None
    return folder
