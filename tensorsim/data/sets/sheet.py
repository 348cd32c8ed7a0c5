"""The contact sheet of a data set: a row of samples for every class."""

from pathlib import Path

import numpy as np

from tensorsim.data.sets.recipe import DatasetRecipe
from tensorsim.data.sets.stored import StoredArrays

#: Samples per class and largest number of classes shown; then outputs that are pictures, the best first.
_SAMPLES, _CLASSES = 6, 24
_SHOWN = ("doppler_time", "picture", "range_time_mti", "range_time")


def draw_sheet(out: Path, recipe: DatasetRecipe) -> bool:
    """Write ``contact_sheet.png``: maps of the first radar, if there are any; returns whether there are."""
    from tensorsim.data.sets.manifest import rows_of
    from tensorsim.plot.figure import new_figure, save_figure

    kind = next((kind for kind in _SHOWN if kind in recipe.outputs.kinds), None)
    if kind is None:
        return False
    chosen: dict[str, list[dict[str, object]]] = {}
    for row in rows_of(out):
        of_class = chosen.setdefault(row["label"], [])
        if len(of_class) < _SAMPLES:
            of_class.append(row)
    labels = sorted(chosen)[:_CLASSES]
    read, name = StoredArrays(out, recipe), f"{recipe.radars[0].name}.{kind}"
    figure = new_figure(2.0 * _SAMPLES, 1.6 * len(labels) + 0.5)
    grid = figure.subplots(len(labels), _SAMPLES, squeeze=False)
    for axes in grid.flat:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_frame_on(False)
    for label, line in zip(labels, grid, strict=True):
        line[0].set_ylabel(label, fontsize=8, parse_math=False)
        for row, axes in zip(chosen[label], line, strict=False):
            axes.imshow(
                read(row, name).astype(np.float32),
                origin="lower",
                aspect="auto",
                cmap="turbo",
                interpolation="none",
            )
            axes.set_title(f"{row['id']} {row['person']}", fontsize=6, parse_math=False)
    figure.suptitle(f"{recipe.name}: {name}", fontsize=9, parse_math=False)
    save_figure(figure, out / "contact_sheet.png")
    return True
