"""``tensorsim evaluate pose``: how well a pose network finds the keypoints of people it has not seen."""

from dataclasses import dataclass
from pathlib import Path

from tensorsim.errors import TensorsimError


@dataclass(frozen=True)
class EvaluatePose:
    """Print mean OKS and PCK@0.1 (of the longer side of the box) on held-out people.

    Attributes:
        weights: HRNet's (.safetensors, .pth) or any heat-map network's (.onnx); the shipped ones if not given.
        data: folder of lspet-*.tar and coco_small-*.tar, whose held-out people are looked for.
        coco: folder with one COCO annotation file (*.json) and its pictures in images/.
        flip_test: average with the mirror image.
    """

    weights: Path | None = None
    data: Path | None = None
    coco: Path | None = None
    flip_test: bool = True

    def run(self) -> None:
        """Do it."""
        from torch import nn

        from tensorsim.training.pose import HELD_OUT_PERCENT
        from tensorsim.training.pose_data import Person, people, split, upright
        from tensorsim.training.pose_metrics import evaluate_pose
        from tensorsim.training.shards import Shards, find_shards, read_coco
        from tensorsim.vision.hrnet import HRNet
        from tensorsim.vision.onnx_heatmaps import OnnxHeatmaps

        groups: dict[str, list[Person]] = {}
        if self.data is not None:
            for name, percent in HELD_OUT_PERCENT.items():
                found = people(split(Shards(find_shards(self.data, name)), percent)[1])
                groups |= {f"{name}, held out": found, f"{name}, held out, upright": upright(found)}
        if self.coco is not None:
            files = sorted(self.coco.glob("*.json"))
            if len(files) != 1:
                raise TensorsimError(f"--coco: got {len(files)} json files in {self.coco}, expected one")
            found = people(read_coco(files[0], self.coco / "images"))
            groups |= {str(self.coco): found, f"{self.coco}, upright": upright(found)}
        if not groups:
            raise TensorsimError("evaluate pose: got no pictures, expected --data or --coco")

        onnx = self.weights is not None and self.weights.suffix == ".onnx"
        network: nn.Module = OnnxHeatmaps(self.weights) if onnx else HRNet.from_pretrained(self.weights)  # type: ignore[arg-type]
        print(f"{'people':40s} {'n':>5s} {'OKS':>7s} {'PCK@0.1':>8s} {'body':>7s}")
        for name, persons in groups.items():
            figure = evaluate_pose(network, persons, self.flip_test)
            row = f"{figure['oks']:7.3f} {figure['pck']:8.3f} {figure['pck_body']:7.3f}"
            print(f"{name:40s} {len(persons):5d} {row}")
