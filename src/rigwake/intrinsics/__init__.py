"""Intrinsic calibration from chessboards, AprilGrids and ChArUco boards."""
