"""Optional parts of the installation: what needs them says which extra to install."""

from __future__ import annotations

import importlib.util

from rigwake.errors import UsageError


def require_extra(package: str, extra: str, what: str) -> None:
    """Raises UsageError with the extra to install where `package` cannot be imported. what: `The simulator`."""
    if importlib.util.find_spec(package) is None:
        raise UsageError(
            f"{what} needs {package}, which is not installed.",
            consequence="The base installation leaves it out: few need it, and it is large.",
            remedy=f"pip install 'rigwake[{extra}]', then run this again.",
        )
