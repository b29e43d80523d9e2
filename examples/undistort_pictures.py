"""Undistorted copies of pictures: undistort_pictures.py CAMERA_FILE OUT PICTURE..."""

import sys

import rigwake

camera_file, out, *pictures = sys.argv[1:]
for to in ("pinhole", "cylinder"):
    written = rigwake.undistort(pictures, f"{out}/{to}", camera_file=camera_file, to=to)
    print(to, *written, sep="\n  ")
