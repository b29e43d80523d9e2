"""Modules import only from those to their left in the way of the data."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "src" / "rigwake"

# left to right; a module may import from its own layer or from any layer further left
LAYERS = [
    [
        "errors",
        "_progress",
        "_tables",
        "_types",
        "atomic",
        "fingerprint",
        "host_faults",
        "parallel",
        "_robust",
        "workers",
        "_kernels",
        "kernel_cache",
        "text_files",
        "extras",
        "yaml_input",
    ],
    ["geometry"],
    ["cameras"],
    ["trajectory", "rig"],
    ["recording", "excerpt", "tracks", "calibration"],
    ["evaluation"],
    ["readers", "writers"],
    ["inspection"],
    ["intrinsics"],
    ["tracking"],
    ["ba.solver"],  # least squares over states, landmarks and shared parameters: for one camera and for a rig
    ["sync"],
    ["odometry"],
    ["handeye"],
    ["ba.rig"],  # the rig problem: initial values, cross-camera association, rounds of outlier rejection
    ["plausibility"],  # does a sensor agree with the others?
    ["sections"],  # which parts of a long recording are worth calibrating from
    ["simulation"],
    ["exporters"],
    ["report"],
    ["logbook"],  # the history of a vessel
    ["monitor"],
    ["config"],
    ["pipeline"],
    ["views"],
    ["fleet"],  # many recordings, on one machine or a cluster
    ["ros"],  # a node on board; imported by the command line alone
    ["_api_inputs", "_api_results", "api"],
    ["cli", "__main__"],
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


def layer_of(parts: list[str]) -> str | None:
    """The layer of a module by its path below the package: `ba.solver` for `ba/solver/schur.py`."""
    if parts[:1] == ["ba"]:
        return ".".join(parts[:2]) if len(parts) > 1 else None
    return parts[0] if parts else None


def imported_layers(path: Path) -> set[str]:
    found: set[str | None] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "rigwake":
            parts = node.module.split(".")[1:]
            found |= {layer_of(parts)} if parts else {layer_of([alias.name]) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {layer_of(a.name.split(".")[1:]) for a in node.names if a.name.startswith("rigwake.")}
    return {layer for layer in found if layer in RANK}


MODULES = sorted(
    p for p in PACKAGE.rglob("*.py") if p not in {PACKAGE / "__init__.py", PACKAGE / "ba" / "__init__.py"}
)


def test_imports_point_left() -> None:
    wrong = []
    for path in MODULES:
        layer = layer_of(list(path.relative_to(PACKAGE).with_suffix("").parts))
        assert layer in RANK, (
            f"{layer} is not in the list of layers: say where it stands in the way of the data"
        )
        right = {other for other in imported_layers(path) if RANK[other] > RANK[layer]}
        wrong += [f"{path.relative_to(PACKAGE)} imports from its right: {sorted(right)}"] if right else []
    assert not wrong, "\n".join(wrong)
