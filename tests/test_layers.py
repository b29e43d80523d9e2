"""Modules import only from those to their left in the way of the data."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "src" / "rigwake"

# left to right; a module may import from its own layer or from any layer further left
LAYERS = [
    ["errors", "atomic", "fingerprint", "threads"],
    ["geometry"],
    ["cameras"],
    ["trajectory", "rig"],
    ["recording", "tracks", "calibration"],
    ["evaluate"],
    ["readers", "writers"],
    ["inspection"],
    ["intrinsics"],
    ["tracking"],
    ["bundle"],  # least squares over states, landmarks and shared parameters: for one camera and for a rig
    ["sync"],
    ["odometry"],
    ["handeye"],
    ["adjustment"],  # the rig problem: initial values, cross-camera landmarks, outlier rounds
    ["simulate"],
    ["exporters"],
    ["report"],
    ["config"],
    ["pipeline"],
    ["cli"],
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def imported_layers(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "rigwake":
            parts = node.module.split(".")
            found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("rigwake.")}
    return found & RANK.keys()


MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_left(path: Path) -> None:
    layer = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    assert layer in RANK, f"{layer} is not in the list of layers: say where it stands in the way of the data"
    wrong = {other for other in imported_layers(path) if RANK[other] > RANK[layer]}
    assert not wrong, f"{layer} imports from its right: {sorted(wrong)}"
