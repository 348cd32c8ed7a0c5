"""Each person of a run alone in the scene: maps, label and picture, from the same poses."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tensorsim.array_files import array_formats

if TYPE_CHECKING:
    from tensorsim.commands.clip_options import ClipOptions, Run


class Alone(NamedTuple):
    """One person alone in the scene.

    Attributes:
        number: of the person, from 1, as in the overlay.
        label: what ``summary.json`` says of the activity.
        map: the Doppler-time map as the report has it.
    """

    number: int
    label: dict[str, Any]
    map: dict[str, Any]


def write_each_person(folder: Path, run: "Run", options: "ClipOptions") -> list[Alone]:
    """If there are several people, simulate and label each as if nobody else were present.

    Writes ``maps_person_N`` and a picture of the Doppler-time map for person N. Noise is relative to the person's own
    echo. Only one person's maps are in memory at a time; poses are not estimated again.

    Args:
        folder: folder of the results.
        run: the simulated run.
        options: how the maps are drawn and stored.
    """
    import torch

    from tensorsim import results
    from tensorsim.report.page import map_contents
    from tensorsim.streaming import maps_of_pose
    from tensorsim.summary import label_of

    people = [int(person) for person in torch.nonzero(run.pose.valid[0].any(dim=-1)).flatten()]
    if len(people) < 2:
        return []
    written = []
    duration_s = run.pose.valid.shape[2] / run.fps
    for person in people:
        number = person + 1
        there = torch.zeros_like(run.pose.valid)
        there[:, person] = run.pose.valid[:, person]
        torch.manual_seed(run.config.seed)
        pose = run.pose._replace(valid=there)
        maps = maps_of_pose(run.stage, pose, run.fps, run.device, options.quiet)
        axes = results.axes_of(run.stage, maps)
        label = label_of(run.recognizer, maps, duration_s, options.least_probability)
        pictures = options.pictures(run.stage, label["label"], f"{run.film}, person {number}")
        results.save_maps(folder / f"maps_person_{number}", maps, axes, array_formats(options.save))
        name = f"doppler_time_person_{number}"
        run.drawing.draw(results.doppler_figure(maps, axes, pictures), folder / f"{name}.{pictures.suffix}")
        shown = map_contents(maps, axes, pictures, f" of person {number}")[0] | {"name": name}
        written.append(Alone(number, label, shown))
    return written
