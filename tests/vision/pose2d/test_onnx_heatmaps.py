import copy
import pickle
import sys
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.pose2d.topdown import TopDownPose
from tests.stage import StageTester

WEIGHT = torch.randn(17, 3, 4, 4, generator=torch.Generator().manual_seed(0)) / 7


def write_network(
    path: Path,
    batch: int | str = 1,
    size: tuple[int | str, int | str] = (64, 32),
    weight: Tensor = WEIGHT,
    extra_input: bool = False,
) -> Path:
    """One convolution of stride 4 as an ONNX file, with a second output that is not the heat maps."""
    height, width = size
    maps = [batch, len(weight), *(n // 4 if isinstance(n, int) else f"{n}4" for n in size)]
    inputs = [helper.make_tensor_value_info("data", TensorProto.FLOAT, [batch, 3, height, width])]
    if extra_input:
        inputs.append(helper.make_tensor_value_info("scale", TensorProto.FLOAT, [1]))
    graph = helper.make_graph(
        [
            helper.make_node("Conv", ["data", "weight"], ["maps"], strides=[4, 4]),
            helper.make_node("Relu", ["maps"], ["other"]),
        ],
        "heat maps",
        inputs,
        [
            helper.make_tensor_value_info("maps", TensorProto.FLOAT, maps),
            helper.make_tensor_value_info("other", TensorProto.FLOAT, maps),
        ],
        [numpy_helper.from_array(weight.numpy(), "weight")],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    return path


def expected_maps(crops: Tensor) -> Tensor:
    rgb255 = crops * 255
    mean, std = torch.tensor([123.675, 116.28, 103.53]), torch.tensor([58.395, 57.12, 57.375])
    return F.conv2d((rgb255 - mean.view(3, 1, 1)) / std.view(3, 1, 1), WEIGHT, stride=4)


class TestOnnxHeatmaps(StageTester):
    batch_shapes = ((3,),)
    gradient_arguments = ()
    scripts = False
    exports = False

    @pytest.fixture(autouse=True)
    def _file(self, tmp_path: Path) -> None:
        self.path = write_network(tmp_path / "network.onnx")

    def make(self) -> nn.Module:
        return OnnxHeatmaps(self.path)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (torch.rand(*batch, 3, 64, 32, dtype=dtype, generator=torch.Generator().manual_seed(0)),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(3, 64, 32),), r"expected \(N, 3, H, W\)"),
            ((torch.zeros(1, 1, 64, 32),), r"expected \(N, 3, 64, 32\)"),
            ((torch.zeros(1, 3, 32, 64),), r"expected \(N, 3, 64, 32\)"),
            ((torch.zeros(1, 3, 64, 32, dtype=torch.uint8),), "floating"),
        ]


@pytest.mark.parametrize("batch", [1, "n"])
@pytest.mark.parametrize("count", [0, 1, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_runs_the_file_on_normalised_crops(
    tmp_path: Path, batch: int | str, count: int, dtype: torch.dtype
) -> None:
    network = OnnxHeatmaps(write_network(tmp_path / "network.onnx", batch))
    crops = torch.rand(count, 3, 64, 32).to(dtype)
    maps = network(crops)
    assert maps.dtype == dtype
    assert maps.shape == (count, 17, 16, 8)
    tolerance = 0.02 if dtype == torch.float16 else 1e-5
    torch.testing.assert_close(maps.float(), expected_maps(crops.float()), rtol=0, atol=tolerance)


def test_takes_any_size_that_the_file_leaves_open(tmp_path: Path) -> None:
    network = OnnxHeatmaps(write_network(tmp_path / "network.onnx", "n", ("h", "w")))
    assert network.input_size == (256, 192)
    crops = torch.rand(2, 3, 96, 64)
    torch.testing.assert_close(network(crops), expected_maps(crops), rtol=0, atol=1e-5)
    assert OnnxHeatmaps(write_network(tmp_path / "fixed.onnx")).input_size == (64, 32)


def test_pickles_and_copies(tmp_path: Path) -> None:
    network, crops = OnnxHeatmaps(write_network(tmp_path / "network.onnx")), torch.rand(1, 3, 64, 32)
    expected = network(crops)
    assert torch.equal(copy.deepcopy(network)(crops), expected)
    restored = pickle.loads(pickle.dumps(network))
    assert torch.equal(restored(crops), expected)
    assert not list(network.state_dict())


def test_gives_no_gradients(tmp_path: Path) -> None:
    crops = torch.rand(1, 3, 64, 32, requires_grad=True)
    assert not OnnxHeatmaps(write_network(tmp_path / "network.onnx"))(crops).requires_grad


def test_says_that_it_is_an_edge_when_scripted(tmp_path: Path) -> None:
    network = OnnxHeatmaps(write_network(tmp_path / "network.onnx"))
    for module in (network, TopDownPose(network), TopDownPose(network, flip_test=True)):
        with pytest.raises(TensorsimError, match="it is not part of the graph; expected an HRNet"):
            torch.jit.script(module)


def test_refuses_files_that_are_no_heatmap_network(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("not a network")
    whole = write_network(tmp_path / "whole.onnx").read_bytes()
    (tmp_path / "cut.onnx").write_bytes(whole[: len(whole) // 2])
    cases = [
        (tmp_path / "missing.onnx", "no such file"),
        (tmp_path, "no such file"),
        (text, "cannot read"),
        (tmp_path / "cut.onnx", "cannot read"),
        (write_network(tmp_path / "four.onnx", batch=4), "expected one float input"),
        (write_network(tmp_path / "mpii.onnx", weight=WEIGHT[:16]), "expected one float input"),
        (write_network(tmp_path / "two.onnx", extra_input=True), "expected one float input"),
    ]
    for path, message in cases:
        with pytest.raises(TensorsimError, match=message):
            OnnxHeatmaps(path)


def test_says_how_to_get_a_missing_runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_network(tmp_path / "network.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(TensorsimError, match="pip install onnxruntime"):
        OnnxHeatmaps(path)


def test_reads_a_published_network(shared_data: Path) -> None:
    network = OnnxHeatmaps(shared_data / "weights" / "simplepose_coco17_256x192.onnx")
    assert network.input_size == (256, 192)
    assert network(torch.rand(2, 3, 256, 192)).shape == (2, 17, 64, 48)
