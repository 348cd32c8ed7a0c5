"""The command line: the list of commands in ``tensorsim.commands``."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, NoReturn, Union

import tyro

from tensorsim import __version__, process
from tensorsim.commands.app import App
from tensorsim.commands.arguments import describe_options, paragraphs
from tensorsim.commands.check import Check
from tensorsim.commands.clip_options import ClipOptions
from tensorsim.commands.dataset import DatasetBuild, DatasetExample, DatasetSample, DatasetVerify
from tensorsim.commands.demo import Demo
from tensorsim.commands.evaluate_camera import EvaluateCamera
from tensorsim.commands.evaluate_classifier import EvaluateClassifier
from tensorsim.commands.evaluate_denoiser import EvaluateDenoiser
from tensorsim.commands.evaluate_detector import EvaluateDetector
from tensorsim.commands.evaluate_films import EvaluateFilms
from tensorsim.commands.evaluate_lifter import EvaluateLifter
from tensorsim.commands.evaluate_measured import EvaluateMeasured
from tensorsim.commands.evaluate_pose import EvaluatePose
from tensorsim.commands.evaluate_truth import EvaluateTruth
from tensorsim.commands.experiment import RunExperiment
from tensorsim.commands.library import BuildLibrary
from tensorsim.commands.live import Live
from tensorsim.commands.models import FetchModels, ListModels, VerifyModels
from tensorsim.commands.simulate import Simulate
from tensorsim.commands.train_acf import TrainAcf
from tensorsim.commands.train_classifier import TrainClassifier
from tensorsim.commands.train_denoiser import TrainDenoiser
from tensorsim.commands.train_detector import TrainDetector
from tensorsim.commands.train_everyday import TrainEveryday
from tensorsim.commands.train_lifter import TrainLifter
from tensorsim.commands.train_pose import TrainPose
from tensorsim.commands.train_range_rate import TrainRangeRate
from tensorsim.exceptions import TensorsimError

EXAMPLES = """
examples:
  tensorsim simulate clip.mp4 --out out/
  tensorsim simulate clip.mp4 --out out/ --detector rtmdet-m-person --pose hrnet-w32-coco
  tensorsim simulate clip.mp4 --out out/ --scene through-wall --person-height 1.75
  tensorsim simulate clip.mp4 --out out/ --start 2 --end 6 --initial-distance 4.0 --seed 7
  tensorsim simulate clip.mp4 --out out/ --radar ti-iwr6843
  tensorsim simulate walk.bvh --out out/ --initial-distance 4
  tensorsim demo --activity kicking --out demo/
  tensorsim live --camera 0
  tensorsim app
  tensorsim evaluate truth --out truth/ --clips 2
  tensorsim experiment networks --out networks/ --quick
  tensorsim simulate clip.mp4 --out out/ --radar my_radar.yaml
  tensorsim dataset example > recipe.yaml
  tensorsim dataset build recipe.yaml --out data/ --workers 2
  tensorsim check

Networks come with tensorsim; others can be named once for all runs: set TENSORSIM_DETECTOR and TENSORSIM_POSE.
"""

#: Commands by name; a group is its description and a table of its commands.
COMMANDS: dict[str, Any] = {
    "simulate": Simulate,
    "demo": Demo,
    "live": Live,
    "app": App,
    "evaluate": (
        "Measure the pipeline against the truth, or a network on held-out data.",
        {
            "truth": EvaluateTruth,
            "detector": EvaluateDetector,
            "pose": EvaluatePose,
            "films": EvaluateFilms,
            "camera": EvaluateCamera,
            "lifter": EvaluateLifter,
            "denoiser": EvaluateDenoiser,
            "classifier": EvaluateClassifier,
            "measured": EvaluateMeasured,
        },
    ),
    "train": (
        "Train a network by the recipe of the shipped one.",
        {
            "detector": TrainDetector,
            "pose": TrainPose,
            "lifter": TrainLifter,
            "range-rate": TrainRangeRate,
            "denoiser": TrainDenoiser,
            "classifier": TrainClassifier,
            "everyday": TrainEveryday,
            "acf": TrainAcf,
        },
    ),
    "dataset": (
        "Labelled data sets of radar maps from a recipe.",
        {
            "build": DatasetBuild,
            "example": DatasetExample,
            "sample": DatasetSample,
            "verify": DatasetVerify,
        },
    ),
    "experiment": RunExperiment,
    "library": ("Pools of poses for nearest-match lifting.", {"build": BuildLibrary}),
    "models": (
        "Weights by name: shipped ones and published ones.",
        {"list": ListModels, "fetch": FetchModels, "verify": VerifyModels},
    ),
    "check": Check,
}


def _choice(commands: Mapping[str, Any]) -> Any:
    """The union type from which tyro makes subcommands."""
    return Union[  # noqa: UP007  # the members are known at run time
        tuple(
            Annotated[
                Any,
                tyro.conf.subcommand(name, description=command[0], constructor=_group(command[1]))
                if isinstance(command, tuple)
                else tyro.conf.subcommand(name, description=paragraphs(command.__doc__), constructor=command),
            ]
            for name, command in commands.items()
        )
        + ((Annotated[None, tyro.conf.Suppress],) if len(commands) == 1 else ())  # one type is no union
    ]


def _group(commands: Mapping[str, Any]) -> Callable[..., Any]:
    def choose(command: Any) -> Any:
        return command

    choose.__annotations__["command"] = _choice(commands)
    return choose


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Report bad input, a file error or an interrupt in one line, and exit with a status."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has closed the pipe, as `| head` does.
        _drop_output()
        sys.exit(141)
    except TensorsimError as error:
        _stop(2, f"error: {error}")
    except OSError as error:
        _stop(2, f"error: {f'{error.filename}: {error.strerror}' if error.filename else error}")
    except KeyboardInterrupt:
        _stop(130, "interrupted")


def _drop_output() -> None:
    """Discard unprinted output: Python would try to flush it again on exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _stop(status: int, message: str) -> NoReturn:
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    print(f"tensorsim: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(status)


def _named(words: list[str]) -> type | None:
    """The command that the first of these words name, if any."""
    commands: Mapping[str, Any] = COMMANDS
    for word in words:
        found = commands.get(word)
        if not isinstance(found, tuple):
            return found
        commands = found[1]
    return None


def parse(arguments: list[str] | None = None) -> Any:
    """The command named by the arguments (default: the command line's); exits if there is none."""
    command = _named(sys.argv[1:] if arguments is None else arguments)
    if command is not None:
        describe_options(command)
    return tyro.cli(
        _choice(COMMANDS),
        prog="tensorsim",
        description=f"What a radar would have seen of the people in a video.\n{EXAMPLES}",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )


def command() -> None:
    """The ``tensorsim`` command: :func:`main` in a process of its own."""
    main()
    process.leave()


def main(arguments: list[str] | None = None) -> None:
    """Run the command that the arguments (default: the command line's) name.

    Exit status: 0 done, 2 bad input or a file that cannot be read or written, 129 and 143 ended by SIGHUP and SIGTERM,
    130 interrupted, 141 output pipe closed.
    """
    with process.ending_cleanly(), _one_line_errors():
        if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
            print(f"tensorsim {__version__}")
            return
        command = parse(arguments)
        if not isinstance(command, ClipOptions):  # these check their options first
            process.load_torch()
        command.run()
