"""The page of the app: controls, progress, and the results of one or two runs."""

import html
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import gradio as gr

from tensorsim.app.form import GROUPS, Control, controls, for_demo, options_of
from tensorsim.app.runs import ARCHIVE, Run, Runs
from tensorsim.commands.demo import LONGEST_S, Demo
from tensorsim.commands.simulate import Simulate
from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import PRESETS

#: File types that can be dropped.
FILE_TYPES = [".mp4", ".mov", ".avi", ".mkv", ".webm", ".gif", ".m4v", ".bvh", ".npz", ".json"]
_SCENES = ("free-space", "through-wall")
_EXAMPLES = {
    "Walking": ("walking", "free-space", "4"),
    "Walking behind a wall": ("walking", "through-wall", "4"),
    "Falling": ("walking to falling", "free-space", "6"),
}
CSS = """
.result iframe { width: 100%; height: 1500px; border: 1px solid #8886; border-radius: 4px; }
.result { display: flex; flex-wrap: wrap; gap: 0.75rem; }
.result > section { flex: 1 1 360px; min-width: 0; }
.result a { margin-right: 0.8rem; }
.failed { color: #c0261d; font-weight: 600; }
"""
#: Scrolls to the progress, if it is out of sight.
_SHOW_STATUS = "() => document.querySelector('#status').scrollIntoView({behavior: 'smooth', block: 'center'})"


def build(runs: Runs, longest_s: float) -> gr.Blocks:
    """The page.

    Args:
        runs: where simulations run.
        longest_s: longest film, motion capture or keypoints in seconds.
    """
    # Long because it declares the page from top to bottom, in reading order.
    made = controls()
    with gr.Blocks(title="tensorsim", analytics_enabled=False, delete_cache=(600, 3600)) as page:
        gr.Markdown("# tensorsim\nWhat a radar would have seen of the people in a film.")
        with gr.Row():
            with gr.Column(scale=1, min_width=300):
                film = gr.File(
                    label=f"Film, motion or keypoints, up to {longest_s:g} s", file_types=FILE_TYPES
                )
                activity = gr.Dropdown(
                    _activities(), value="walking", label="Or the activity of a generated person"
                )
                duration = gr.Number(
                    4.0,
                    label="Length of the generated film (s)",
                    minimum=0.5,
                    maximum=min(longest_s, LONGEST_S),
                )
                scene = gr.Radio(_SCENES, value="free-space", label="Scene")
                radar = gr.Dropdown(["", *PRESETS], value="", label="Radar preset")
                paper = gr.Checkbox(label="Use the paper's formulas as printed")
                with gr.Row():
                    start = gr.Button("Simulate", variant="primary", elem_id="simulate")
                    compare = gr.Button("Compare", elem_id="compare")
                    cancel = gr.Button("Cancel", elem_id="cancel")
                gr.Markdown("Compare runs the current settings and shows the result beside the previous one.")
                _examples(activity, scene, duration)
                inputs = {film, activity, duration, scene, radar, paper}
                components = {}
                for group in GROUPS:
                    with gr.Accordion(group.capitalize(), open=False):
                        for control in (c for c in made if c.group == group):
                            components[control.option] = component = _component(control)
                            inputs.add(component)
            with gr.Column(scale=3, min_width=360):
                status = gr.HTML("Ready.", elem_id="status")
                with gr.Row(visible=False) as working:
                    flat = gr.Image(label="Film", interactive=False, buttons=[])
                    world = gr.Image(label="Scene around the radar", interactive=False, buttons=[])
                result = gr.HTML(elem_id="result")
        running, shown = gr.State(None), gr.State(())
        outputs = [status, working, flat, world, result, running, shown]

        def simulation(keep: bool) -> Callable[[dict[Any, Any]], Iterator[dict[Any, Any]]]:
            def simulate(values: dict[Any, Any]) -> Iterator[dict[Any, Any]]:
                given = {option: values[component] for option, component in components.items()}
                given |= {"scene": values[scene], "radar": values[radar] or None, "paper": values[paper]}
                run = runs.start(_command(values[film], values[activity], values[duration], given, longest_s))
                for update in _followed(run):
                    yield {
                        status: update["status"],
                        working: gr.update(visible=update["running"]),
                        flat: update["film"],
                        world: update["world"],
                        running: run.token,
                    }
                if run.error is None:
                    together = (*(values[shown][-1:] if keep else ()), run.token)
                    yield {result: _results(runs, together), shown: together}

            return simulate

        for button, keep in ((start, False), (compare, True)):
            button.click(None, js=_SHOW_STATUS)
            button.click(
                simulation(keep),
                inputs | {shown},
                outputs,
                concurrency_limit=2,
                api_visibility="private",
                show_progress="hidden",
            )
        cancel.click(
            runs.cancel, running, None, concurrency_limit=None, api_visibility="private", queue=False
        )
    return page


def _activities() -> list[str]:
    """Names of the activities as accepted by ``demo``."""
    return [name.split(" ", 1)[1].lower() for name in ACTIVITIES]


def _examples(activity: gr.Dropdown, scene: gr.Radio, duration: gr.Number) -> None:
    """Buttons that set activity, scene and length."""
    gr.Markdown("Examples that need no file:")
    with gr.Row():
        for name, values in _EXAMPLES.items():
            gr.Button(name, size="sm").click(
                lambda chosen=values: chosen,
                None,
                [activity, scene, duration],
                api_visibility="private",
                queue=False,
            )


def _component(control: Control) -> Any:
    """The control as a Gradio component."""
    common: dict[str, Any] = {
        "label": control.label,
        "info": control.help,
        "elem_id": control.option.replace("_", "-"),
    }
    if control.kind == "switch":
        return gr.Checkbox(value=bool(control.default), **common)
    if control.kind == "choice":
        return gr.Dropdown(list(control.choices), value=control.default or control.choices[0], **common)
    # Not a gr.Number: that cannot be left empty, and empty means the default of the scene.
    shown = (
        ""
        if control.default is None
        else f"{control.default:g}"
        if control.kind == "number"
        else control.default
    )
    return gr.Textbox(value=str(shown), placeholder="default", **common)


def _command(
    film: str | None, activity: str, duration: str, values: dict[str, Any], longest_s: float
) -> Callable[[Path], Any]:
    """A function that builds the command of a run for its folder; it raises if the values are invalid."""

    def command(folder: Path) -> Any:
        given = options_of(values) | {
            "scene": values["scene"],
            "radar": values["radar"],
            "paper": values["paper"],
        }
        given |= {"out": folder, "quiet": True, "save": "mat"}
        given["multipath"] = {"on": True, "off": False}.get(given.get("multipath", ""))
        if film is None:
            return Demo(
                activity=activity, duration=_length(duration, min(longest_s, LONGEST_S)), **for_demo(given)
            )
        check_length(Path(film), longest_s, given)
        return Simulate(source=Path(film), **given)

    return command


def _length(given: str, longest_s: float) -> float:
    """Length of a generated film in seconds."""
    try:
        seconds = float(given)
    except ValueError:
        raise TensorsimError(f"Length of the generated film: got {given!r}, expected seconds") from None
    if not 0.5 <= seconds <= longest_s:
        raise TensorsimError(
            f"Length of the generated film: got {seconds:g} s, expected 0.5 to {longest_s:g} s"
        )
    return seconds


def check_length(film: Path, longest_s: float, given: dict[str, Any]) -> None:
    """Refuse sources that would take too long, unless a short enough part of them is chosen."""
    seconds, fps = _part(film, given)
    if seconds is not None and given.get("fps") is not None:
        # Computing time depends on the number of frames: a rate above the file's own does not reduce it.
        with suppress(TensorsimError):  # the file states no rate
            own_fps = _part(film, {"clip": given.get("clip")})[1]
            seconds *= max(1.0, fps / own_fps)
    if seconds is None or seconds > longest_s:
        length = "an unknown length" if seconds is None else f"{seconds:.1f} s"
        raise TensorsimError(
            f"{film.name}: got {length}, expected at most {longest_s:g} s; set Start and End in the Camera group"
        )


def _part(film: Path, given: dict[str, Any]) -> tuple[float | None, float]:
    """Length of the chosen part of a file in seconds, None if unknown, and its frames per second."""
    from tensorsim.data.blazepose import load_keypoints
    from tensorsim.data.motion_files import load_motion
    from tensorsim.data.video import VideoReader
    from tensorsim.sources import Cut, kind_of

    kind, fps, cut = kind_of(film), given.get("fps"), Cut(given.get("start"), given.get("end"))
    if kind == "video":
        reader = VideoReader(film, fps=fps, start_s=cut.start_s, end_s=cut.end_s)
        seconds = reader.duration_s
        if seconds is None and cut.end_s is not None:
            seconds = cut.end_s - (cut.start_s or 0.0)
        return seconds, reader.fps
    if kind == "motion":
        motion = load_motion(film, given.get("clip"), fps)
        count, fps = motion.valid.shape[1], motion.fps
    elif fps is None:
        raise TensorsimError(f"{film.name}: the file has no frame rate; set Fps in the Camera group")
    else:
        size = given.get("image_size")
        count = load_keypoints(film, None if size is None else size[::-1]).valid.shape[0]
    kept = cut.frames(count, fps, film)
    return (kept.stop - kept.start) / fps, fps


def _followed(run: Run) -> Iterator[dict[str, Any]]:
    """The state of a run to display, a few times a second until it ends."""
    while True:
        ended = run.finished.wait(0.4)
        yield {
            "status": _status(run),
            "running": not ended,
            "film": run.pictures.get("film"),
            "world": run.pictures.get("world"),
        }
        if ended:
            return


def _status(run: Run) -> str:
    """The status of a run in one line."""
    if run.error is not None:
        return f'<p class="failed" role="alert">{html.escape(run.error)}</p>'
    if run.finished.is_set():
        return f"<p>Done at {time.strftime('%H:%M:%S')}.</p>"
    share = f"{run.done} of {run.total}" if run.total else str(run.done or "")
    bar = (
        f'<progress max="{run.total}" value="{run.done}"></progress>'
        if run.total
        else "<progress></progress>"
    )
    return f"<p>{html.escape(run.stage)} {share} {bar}</p>"


def _results(runs: Runs, tokens: tuple[str, ...]) -> str:
    """The reports of one or two runs, side by side, with links to download all their files."""
    parts = []
    for token in tokens:
        run = runs.known.get(token)
        if run is None:
            continue
        links = [
            f'<a href="/runs/{token}/{html.escape(path.name)}" download="{html.escape(path.name)}">'
            f"{html.escape('all files' if path.name == ARCHIVE else path.name)}</a>"
            for path in run.files()
        ]
        parts.append(
            f'<section><iframe src="/runs/{token}/report.html" title="report" sandbox="allow-scripts"></iframe>'
            f"<p>Download: {' '.join(links)}</p></section>"
        )
    return f'<div class="result">{"".join(parts)}</div>'
