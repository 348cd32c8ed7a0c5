"""Pictures of maps, skeletons and people. Needs matplotlib and OpenCV, imported on use."""

from tensorsim.plot.figure import FIGURE_FORMATS, save_figure
from tensorsim.plot.floor import draw_floor, draw_lines, floor_lines, through
from tensorsim.plot.maps import (
    DYNAMIC_RANGE_DB,
    RIDGE_COLOURS,
    MapStyle,
    caption,
    clear_ridges,
    colormap,
    confusion_figure,
    decibels,
    doppler_span,
    drawn_ridges,
    map_figure,
    person_peaks,
)
from tensorsim.plot.people import BODY_BONES, COCO_BONES, PERSON_COLOURS, draw_people, skeleton_figure

__all__ = [
    "BODY_BONES",
    "COCO_BONES",
    "DYNAMIC_RANGE_DB",
    "FIGURE_FORMATS",
    "PERSON_COLOURS",
    "RIDGE_COLOURS",
    "MapStyle",
    "caption",
    "clear_ridges",
    "colormap",
    "confusion_figure",
    "decibels",
    "doppler_span",
    "draw_floor",
    "draw_lines",
    "draw_people",
    "drawn_ridges",
    "floor_lines",
    "map_figure",
    "person_peaks",
    "save_figure",
    "skeleton_figure",
    "through",
]
