"""The command line: the list of commands in ``tensorsim.commands``."""

import sys
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Union

import tyro

from tensorsim.commands.check import Check
from tensorsim.commands.demo import Demo
from tensorsim.commands.evaluate_classifier import EvaluateClassifier
from tensorsim.commands.evaluate_denoiser import EvaluateDenoiser
from tensorsim.commands.evaluate_detector import EvaluateDetector
from tensorsim.commands.evaluate_pose import EvaluatePose
from tensorsim.commands.evaluate_truth import EvaluateTruth
from tensorsim.commands.library import BuildLibrary
from tensorsim.commands.models import FetchModels, ListModels, VerifyModels
from tensorsim.commands.simulate import Simulate
from tensorsim.commands.train_classifier import TrainClassifier
from tensorsim.commands.train_denoiser import TrainDenoiser
from tensorsim.commands.train_detector import TrainDetector
from tensorsim.commands.train_pose import TrainPose
from tensorsim.errors import TensorsimError

EXAMPLES = """
examples:
  tensorsim simulate clip.mp4 --out out/
  tensorsim simulate clip.mp4 --out out/ --detector rtmdet-m-person --pose hrnet-w32-coco
  tensorsim simulate clip.mp4 --out out/ --scene through-wall --person-height 1.75
  tensorsim simulate clip.mp4 --out out/ --start 2 --end 6 --initial-distance 4.0 --seed 7
  tensorsim simulate clip.mp4 --out out/ --radar ti-iwr6843
  tensorsim simulate walk.bvh --out out/ --initial-distance 4
  tensorsim demo --activity kicking --out demo/
  tensorsim evaluate truth --out truth/ --clips 2
  tensorsim simulate clip.mp4 --out out/ --radar my_radar.yaml
  tensorsim check

Networks come with tensorsim; others can be named once for all runs: set TENSORSIM_DETECTOR and TENSORSIM_POSE.
"""

#: Commands by name; a command that has commands of its own is a table of them after its description.
COMMANDS: dict[str, Any] = {
    "simulate": Simulate,
    "demo": Demo,
    "evaluate": (
        "Measure the pipeline against the truth, or a network on held-out data.",
        {
            "truth": EvaluateTruth,
            "detector": EvaluateDetector,
            "pose": EvaluatePose,
            "denoiser": EvaluateDenoiser,
            "classifier": EvaluateClassifier,
        },
    ),
    "train": (
        "Train a network by the recipe of the shipped one.",
        {
            "detector": TrainDetector,
            "pose": TrainPose,
            "denoiser": TrainDenoiser,
            "classifier": TrainClassifier,
        },
    ),
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
                tyro.conf.subcommand(
                    name, constructor=_group(*command) if isinstance(command, tuple) else command
                ),
            ]
            for name, command in commands.items()
        )
    ]


def _group(description: str, commands: Mapping[str, Any]) -> Callable[..., Any]:
    def choose(command: Any) -> Any:
        return command

    choose.__doc__ = description
    choose.__annotations__["command"] = _choice(commands)
    return choose


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the ``tensorsim`` command. Exit status: 0 done, 2 bad input, 130 interrupted."""
    command = tyro.cli(
        _choice(COMMANDS),
        prog="tensorsim",
        description=f"What a radar would have seen of the people in a video.\n{EXAMPLES}",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes),
    )
    try:
        command.run()
    except TensorsimError as error:
        print(f"tensorsim: error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("tensorsim: interrupted, nothing written", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
