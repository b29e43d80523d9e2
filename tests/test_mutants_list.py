"""The list of one-line faults fits the code: `make mutants` would run every one of them."""

from pathlib import Path

from run_mutants import load


def test_every_fault_stands_in_its_file_once() -> None:
    faults = load(Path(__file__).parent / "mutants.yaml")
    assert len(faults) >= 60
    assert len({(fault["file"], fault["old"], fault["new"]) for fault in faults}) == len(faults)
