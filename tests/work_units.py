"""Which tests one worker of pytest-xdist runs together: those of one file, or of several that share a scene."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import Any

from xdist.scheduler.loadscope import LoadScopeScheduling

_GROUP = re.compile(r'xdist_group\("(\w+)"\)')
_FOLDER = Path(__file__).parent


@lru_cache
def group_of(file_name: str) -> str | None:
    """The group that a test file names in its `pytestmark`, or None."""
    found = _GROUP.search((_FOLDER / file_name).read_text(encoding="utf-8"))
    return found[1] if found else None


class FileScheduling(LoadScopeScheduling):
    """Fixtures of a module are made once; groups, which are long, are begun first.

    In place of `--dist loadgroup`: xdist 3.8 marks groups at the end of node ids, which pytest 9.2 no longer lets it
    change, so that every worker would make every scene.
    """

    def _split_scope(self, nodeid: str) -> str:
        file_name = Path(nodeid.split("::", 1)[0]).name
        return group_of(file_name) or file_name

    def _assign_work_unit(self, node: Any) -> None:
        long = next((unit for unit in self.workqueue if not unit.endswith(".py")), None)
        if long is not None:
            self.workqueue.move_to_end(long, last=False)
        super()._assign_work_unit(node)
