"""Hand-made labels of real frames (`river/polygons.json`): the water line, the sky, and what is not scored."""

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = (512, 384)
CHOOSING = ("00005.jpg", "00025.jpg", "00045.jpg", "00065.jpg")  # a model may be chosen by these
UNTOUCHED = ("00015.jpg", "00035.jpg", "00055.jpg", "00075.jpg")
HORIZON_ROW = 196.0  # by eye: the vanishing line of the far bank
_SOFT_PX = 2  # on both sides of the outline of foliage against the sky: not scored


def river_truth(name: str) -> NDArray[np.uint8]:
    """(384, 512): 0 water, 1 obstacle, 2 sky, 255 not scored."""
    polygons = json.loads((Path(__file__).parent / "river" / "polygons.json").read_text())[name]
    truth = np.full(SIZE[::-1], 1, np.uint8)
    sky = np.zeros(SIZE[::-1], np.uint8)
    for outline in polygons["sky"]:
        cv2.fillPoly(sky, [np.array(outline)], 1)
    truth[sky > 0] = 2
    size = 2 * _SOFT_PX + 1
    truth[cv2.morphologyEx(sky, cv2.MORPH_GRADIENT, np.ones((size, size), np.uint8)) > 0] = 255
    line = polygons["waterline"]
    water = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillPoly(water, [np.array([*line, [511, line[-1][1]], [511, 383], [0, 383], [0, line[0][1]]])], 1)
    truth[water > 0] = 0
    for outline in polygons["not_scored"]:
        cv2.fillPoly(truth, [np.array(outline)], 255)
    return truth
