"""RTMPose's layout in an ONNX file of the test: the brightest column and row of a colour, in closed form."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.pipeline.networks import pretrained_pose
from tensorsim.vision import RtmPose, TopDownPose
from tensorsim.vision.engines import run_by
from tensorsim.vision.pose2d.hrnet import IMAGENET_MEAN, IMAGENET_STD
from tensorsim.vision.pose2d.rtmpose import OnnxSimcc, SimccDecoder
from tests.stage import StageTester

#: Colour that a keypoint looks for; left and right look for the same one.
COLOUR = [min(k, MIRRORED[k]) % 3 for k in range(17)]
SIZE = (64, 48)


def write_network(
    path: Path,
    batch: int | str = "n",
    points: int = 17,
    names: tuple[str, str] = ("simcc_x", "simcc_y"),
    stretch: float = 2.0,
) -> Path:
    """The largest value of each column and row of the colour of each keypoint, ``stretch`` bins a pixel."""
    height, width = SIZE
    nodes, outputs = [], []
    for name, axis, length in ((names[0], 2, width), (names[1], 3, height)):
        nodes += [
            helper.make_node("ReduceMax", ["input"], [f"{name}_all"], axes=[axis], keepdims=0),
            helper.make_node("Gather", [f"{name}_all", "colour"], [f"{name}_of"], axis=1),
            helper.make_node(
                "Resize", [f"{name}_of", "", "scales"], [name],
                mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor",
            ),
        ]  # fmt: skip
        shape = [batch, points, int(stretch * length)]
        outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
    constants = {"colour": np.array(COLOUR[:points]), "scales": np.array([1, 1, stretch], np.float32)}
    graph = helper.make_graph(
        nodes,
        "simcc",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, [batch, 3, height, width])],
        outputs,
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    return path


def picture(places: list[list[tuple[int, int]]]) -> Tensor:
    """Dark images (B, 3, 120, 160), one bright pixel (u, v) per colour."""
    images = torch.zeros(len(places), 3, 120, 160)
    for image, points in zip(images, places, strict=True):
        for colour, (u, v) in enumerate(points):
            image[colour, v, u] = 1.0
    return images


#: Boxes whose crops show the image one to one: 1.25 times as large they are the crop.
PLACES = [[(31, 40), (50, 41), (60, 77)], [(80, 50), (101, 90), (120, 60)]]
BOXES = torch.tensor(
    [[[24.0 + 4.8, 30 + 6.4, 24 + 43.2, 30 + 57.6]], [[76.0 + 4.8, 36 + 6.4, 76 + 43.2, 36 + 57.6]]]
)


class OnnxTester(StageTester):
    """Of stages that read an ONNX file."""

    gradient_arguments = ()  # ONNX Runtime has none
    scripts = False  # an edge
    exports = False

    @pytest.fixture(autouse=True)
    def _file(self, tmp_path: Path) -> None:
        self.path = write_network(tmp_path / "rtmpose.onnx")


class TestRtmPose(OnnxTester):
    batch_shapes = ((2,),)
    batched_arguments = (0, 1, 2)

    def make(self) -> nn.Module:
        return RtmPose(self.path, flip_test=True)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        count = batch[0]
        return (
            picture(PLACES)[:count].to(dtype),
            BOXES[:count].to(dtype),
            torch.ones(count, 1, dtype=torch.bool),
        )

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        images, boxes, valid = self.inputs((2,), torch.float32)
        return [
            ((images[0], boxes, valid), r"expected \(B, 3, H, W\)"),
            ((images, boxes[:1], valid), "boxes for 1 images"),
            ((images, boxes, valid.float()), "expected bool"),
            ((images, boxes * float("nan"), valid), "boxes"),
        ]


class TestOnnxSimcc(OnnxTester):
    batch_shapes = ((3,),)

    def make(self) -> nn.Module:
        return OnnxSimcc(self.path, flip_test=True)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 3, *SIZE, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(3, *SIZE),), r"OnnxSimcc crops: .* expected \(N, 3, H, W\)"),
            ((torch.zeros(1, 3, 32, 64),), r"expected \(N, 3, 64, 48\)"),
        ]


class TestSimccDecoder(StageTester):
    def make(self) -> nn.Module:
        return SimccDecoder(6, 2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 17, 14, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            (
                (torch.zeros(17, 6),),
                r"SimccDecoder scores: got shape \[17, 6\], expected more than 6 columns",
            ),
            ((torch.zeros(17, 14, dtype=torch.long),), "SimccDecoder scores"),
        ]


@pytest.mark.parametrize("batch", [1, "n"])
@pytest.mark.parametrize("flip_test", [False, True])
def test_peaks_are_where_the_pixels_are(tmp_path: Path, batch: int | str, flip_test: bool) -> None:
    pose = RtmPose(write_network(tmp_path / "rtmpose.onnx", batch), flip_test)
    keypoints, scores = pose(picture(PLACES), BOXES, torch.ones(2, 1, dtype=torch.bool))
    expected = torch.tensor([[image[colour] for colour in COLOUR] for image in PLACES]).float()
    torch.testing.assert_close(keypoints[:, 0], expected, rtol=0, atol=1e-4)
    heights = [(1 - IMAGENET_MEAN[colour]) / IMAGENET_STD[colour] for colour in COLOUR]
    torch.testing.assert_close(scores[:, 0], torch.tensor(heights).expand(2, 17), rtol=0, atol=1e-3)
    nobody = pose(picture(PLACES), BOXES, torch.zeros(2, 1, dtype=torch.bool))
    assert not any(part.any() for part in nobody)


def test_decoding_takes_the_lower_score_and_the_first_of_equals() -> None:
    scores = torch.full((3, 6 + 8), -1.0)
    scores[0, 5], scores[0, 6 + 2] = 0.9, 0.4
    scores[1, 2:4], scores[1, 6 + 7] = 0.3, 0.5
    points, heights = SimccDecoder(6, 2)(scores)
    assert points.tolist() == [[2.5, 1.0], [1.0, 3.5], [0.0, 0.0]]
    torch.testing.assert_close(heights, torch.tensor([0.4, 0.3, 0.0]))


def test_files_with_these_outputs_are_taken_for_rtmpose(tmp_path: Path) -> None:
    path = write_network(tmp_path / "any.onnx")
    pose = pretrained_pose(path, flip_test=True)
    assert isinstance(pose, RtmPose)
    assert isinstance(pose, TopDownPose)
    assert isinstance(pose.network, OnnxSimcc)
    assert pose.network.flip_test
    assert run_by("onnxruntime", nn.Identity(), pose)[1].network is pose.network, (
        "ONNX Runtime runs it already"
    )
    images, valid = picture(PLACES), torch.ones(2, 1, dtype=torch.bool)
    restored = pickle.loads(pickle.dumps(pose))
    assert torch.equal(restored(images, BOXES, valid)[0], pose(images, BOXES, valid)[0])
    with pytest.raises(TensorsimError, match="it is not part of the graph"):
        torch.jit.script(pose)


@pytest.mark.parametrize(
    "options", [{"points": 16}, {"stretch": 1.5}, {"names": ("simcc_x", "rows")}, {"batch": 4}]
)
def test_other_layouts_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write_network(tmp_path / "other.onnx", **options)
    with pytest.raises(
        TensorsimError, match=r"other\.onnx: got input .* -> .*, expected one float input .*simcc_x"
    ):
        RtmPose(path)
