"""The callbacks that are called while something long goes on."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, str, float], None]
"""Called with a name (of a camera, a recording, a verb), what is being done, and which fraction of it is done."""
StageProgress = Callable[[str, float], None]
"""The same within one camera or stage: what is being done, and which fraction of it is done."""
CountProgress = Callable[[str, int, int], None]
"""What is being done, how many of its steps are done, and how many there are."""
