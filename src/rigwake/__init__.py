"""rigwake: calibrate a camera rig from the wake it leaves.

import rigwake

calibration = rigwake.calibrate("sail.bag", "OUT")
calibration.camera("front").rig_from_cam.translation
"""

from __future__ import annotations

import sys
from importlib import import_module
from inspect import Signature, signature
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rigwake.api import FUNCTIONS
from rigwake.kernel_cache import provide_kernel_cache, speed_up_compilation

if TYPE_CHECKING:
    from rigwake.api import *  # noqa: F403
    from rigwake.calibration import Calibration as Calibration
    from rigwake.recording import Recording as Recording
    from rigwake.trajectory import Trajectory as Trajectory

__version__ = "0.1.0"
_VALUES = {"Calibration": "calibration", "Recording": "recording", "Trajectory": "trajectory"}
__all__ = ["__version__", *_VALUES, *FUNCTIONS]
_ALSO_PACKAGES = ("handeye", "intrinsics", "monitor", "odometry", "report")

speed_up_compilation()
provide_kernel_cache()  # before any module with compiled loops is imported


class _CallablePackage(ModuleType):
    """A package with the name of a verb: called, it does what the verb does (`rigwake.handeye(...)`)."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        return self._function()(*arguments, **options)

    def _function(self) -> Any:
        return getattr(import_module("rigwake.api"), self.__name__.rpartition(".")[2])

    @property
    def __signature__(self) -> Signature:
        return signature(self._function())


class _Package(ModuleType):
    def __setattr__(self, name: str, value: Any) -> None:
        if name in _ALSO_PACKAGES and isinstance(value, ModuleType):
            value.__class__ = _CallablePackage
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    """Functions and values of `__all__`, imported when they are first used."""
    if name in _ALSO_PACKAGES:
        return import_module(f"rigwake.{name}")
    if name in _VALUES:
        return getattr(import_module(f"rigwake.{_VALUES[name]}"), name)
    if name in __all__:
        return getattr(import_module("rigwake.api"), name)
    raise AttributeError(f"module 'rigwake' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
