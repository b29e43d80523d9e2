"""The one exception family of rigwake.

    RigwakeError                    anything that rigwake itself reports (CLI exit code 1)
    ├── UsageError                  the call contradicts itself or names what is not there (exit code 2)
    ├── InputError                  a file or a recording cannot be read as what it claims to be
    │   └── TrajectoryError         ... a trajectory file
    ├── CameraError                 a camera model cannot do what was asked of it
    ├── EstimationError             an estimator did not reach a trustworthy answer
    ├── UnobservableError           the motion cannot determine what was asked (exit code 3)
    ├── PartialResultError          the result was written, but a camera is missing from it (exit code 4)
    └── HostError                   disk, memory, permissions or processes of the computer failed (exit code 1)

Libraries raise these, only the command line exits. A message gives cause, consequence and remedy.
"""

from __future__ import annotations

from typing import ClassVar


class RigwakeError(Exception):
    """Base of every error that rigwake raises on purpose: *cause*, what follows, and what to do about it."""

    exit_code: ClassVar[int] = 1

    def __init__(self, cause: str, *, consequence: str = "", remedy: str = "") -> None:
        self.cause = cause
        self.consequence = consequence
        self.remedy = remedy
        super().__init__(" ".join(part for part in (cause, consequence, remedy) if part))


class UsageError(RigwakeError):
    """The call contradicts itself, or names something that is not there."""

    exit_code = 2


class InputError(RigwakeError):
    """A file, folder or recording cannot be read as what it claims to be."""


class TrajectoryError(InputError):
    """A trajectory file or value is broken beyond repair."""


class CameraError(RigwakeError):
    """A camera model cannot represent or do what was asked of it."""


class EstimationError(RigwakeError):
    """An estimator did not reach an answer that can be trusted."""


class UnobservableError(RigwakeError):
    """The motion in the recording cannot determine what was asked."""

    exit_code = 3


class PartialResultError(RigwakeError):
    """A result was written, but something that the user has is missing from it."""

    exit_code = 4


class HostError(RigwakeError):
    """The computer failed: disk, memory, permissions, open files, a process that was ended."""

    exit_code = 1
