"""The rig problem: from initial values to the adjusted rig, with verdicts."""
