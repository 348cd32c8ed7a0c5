"""``tensorsim evaluate pose``: how well a pose network finds the keypoints of people that it was not trained on."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.commands.arguments import Option
from tensorsim.commands.networks import Engine
from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class EvaluatePose:
    """Print mean OKS and PCK@0.1 (relative to the longer side of the box) on held-out people.

    The column "body" leaves out the face; "pairs" scores left/right pairs of the body in either order.

    The columns "seen" and "ghosts" are for the same people, cropped by the edge of the image: the share of keypoints
    with scores of 0.3 or more among those inside the image, and among those outside it, which are spurious.
    """

    weights: Option[Path] = None
    """Weights of HRNet (.safetensors, .pth) or of any heatmap network (.onnx). Default: the shipped ones."""
    data: Option[Path] = None
    """Folder of the shards coco_small, coco_more, coco_extra and lspet (NAME-*.tar), whose held-out people are used;
    "large" people have at least eight labelled keypoints and a quarter of the height of their image."""
    coco: Option[Path] = None
    """Folder with one COCO annotation file (*.json) and its images in images/."""
    flip_test: bool = True
    """Average with the output for the mirror image."""
    engine: Engine = "torch"
    """What runs the network, as in `tensorsim simulate`."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        from torch import nn

        from tensorsim.pipeline import pretrained_pose
        from tensorsim.training.pose import held_out_people
        from tensorsim.training.pose_data import Person, large, people, upright
        from tensorsim.training.pose_metrics import evaluate_cut, evaluate_pose
        from tensorsim.training.shards import read_coco_folder
        from tensorsim.vision.engines import run_by

        groups: dict[str, list[Person]] = {}
        if self.data is not None:
            groups |= {f"{name}, held out": found for name, found in held_out_people(self.data).items()}
        if self.coco is not None:
            found = people(read_coco_folder(self.coco))
            groups |= {
                str(self.coco): found,
                f"{self.coco}, large": large(found),
                f"{self.coco}, upright": upright(found),
            }
        if not groups:
            raise TensorsimError("evaluate pose: got no pictures, expected --data or --coco")

        _, pose = run_by(self.engine, nn.Identity(), pretrained_pose(self.weights, self.flip_test).eval())
        heads = "".join(f"{head:>8s}" for head in ("body", "pairs", "seen", "ghosts"))
        print(f"{'people':40s} {'n':>5s} {'OKS':>7s} {'PCK@0.1':>8s}{heads}")
        for name, persons in groups.items():
            figure = evaluate_pose(pose, persons, self.quiet) | evaluate_cut(pose, persons, quiet=self.quiet)
            row = f"{figure['oks']:7.3f} {figure['pck']:8.3f} {figure['pck_body']:7.3f}"
            row += f" {figure['pck_pairs']:7.3f} {figure['seen']:7.3f} {figure['ghosts']:7.3f}"
            print(f"{name:40s} {len(persons):5d} {row}")
