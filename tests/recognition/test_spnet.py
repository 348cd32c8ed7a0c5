from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError
from tensorsim.recognition.spgnet import SPGNet, TwoLevelLayer
from tensorsim.recognition.spnet import ParallelBlock, SameConv, SPNet
from tests.networks import settled
from tests.stage import StageTester, assert_same


def lively(network: nn.Module) -> nn.Module:
    """Normalisation and a mean that do something, in evaluation."""
    network.get_buffer("mean").fill_(0.3)
    return settled(network)


def make(kind: type[nn.Module], **arguments: Any) -> nn.Module:
    torch.manual_seed(0)
    return lively(kind(**arguments))


class TestSPNet(StageTester):
    batch_shapes = ((2,), (2, 1))
    kind: type[nn.Module] = SPNet

    def make(self) -> nn.Module:
        return make(self.kind, num_classes=3, in_channels=2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        return (torch.rand((*batch, 2, 33, 20), generator=generator, dtype=torch.float64).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        name = self.kind.__name__
        return [
            ((torch.zeros(1, 3, 8, 8),), rf"{name}: got shape \[1, 3, 8, 8\], expected \(\.\.\., 2 channels"),
            ((torch.zeros(8, 8),), r"expected \(\.\.\., 2 channels, height, width\)"),
            ((torch.zeros(0, 2, 8, 8),), "got an empty tensor"),
            ((torch.full((2, 8, 8), float("inf")),), "NaN or infinite"),
            ((torch.zeros(2, 8, 8, dtype=torch.uint8),), "expected a real floating point tensor"),
            (
                (torch.zeros(2, 8, 8, dtype=torch.float64),),
                f"{name}: got torch.float64 on cpu, expected torch.float32",
            ),
        ]


class TestSPGNet(TestSPNet):
    kind = SPGNet


@pytest.mark.parametrize(
    ("network", "count"),
    [
        (lambda: SPNet(12, 3), 11_055_660),
        (lambda: SPNet(12, 3, activation="none", padding="torch"), 11_055_660),
        (lambda: SPGNet(12, 3), 3_268_052),
        (lambda: SPGNet(12, 3, "s2p7"), 3_870_266),
        (lambda: SPGNet(12, 3, "s2p8"), 4_539_632),
        (lambda: SPGNet(12, 3, "s2p9"), 5_276_150),
    ],
)
def test_number_of_parameters(network: Any, count: int) -> None:
    assert sum(p.numel() for p in network().parameters()) == count


def test_without_activation_it_is_affine_and_with_it_is_not() -> None:
    generator = torch.Generator().manual_seed(2)
    a, b = torch.rand(2, 1, 1, 64, 64, generator=generator, dtype=torch.float64).unbind(0)

    def departure(activation: str) -> float:
        f = make(SPNet, activation=activation).double()
        with torch.no_grad():
            zero = f(torch.zeros_like(a))
            left = f(2 * a - 3 * b) - zero
            right = 2 * (f(a) - zero) - 3 * (f(b) - zero)
        return float((left - right).abs().max() / right.abs().max())

    assert departure("none") < 1e-12
    assert departure("relu") > 1e-3


@pytest.mark.parametrize("size", [(8, 6), (7, 4), (5, 5), (1, 2)])
def test_matlab_same_padding(size: tuple[int, int]) -> None:
    """Output ceil(in / 2), the odd padding after: written out pixel by pixel."""
    height, width = size
    torch.manual_seed(0)
    layer = SameConv(1, 1, stride=2).double()
    image = torch.rand(1, 1, height, width, dtype=torch.float64)
    kernel, pixels = layer.conv.weight[0, 0].detach().numpy(), image[0, 0].numpy()
    rows, columns = -(-height // 2), -(-width // 2)
    before = [max(2 * (out - 1) + 3 - length, 0) // 2 for out, length in ((rows, height), (columns, width))]
    expected = np.full((rows, columns), float(layer.conv.bias.detach()))  # type: ignore[union-attr]
    for i in range(rows):
        for j in range(columns):
            for u in range(3):
                for v in range(3):
                    y, x = 2 * i + u - before[0], 2 * j + v - before[1]
                    if 0 <= y < height and 0 <= x < width:
                        expected[i, j] += kernel[u, v] * pixels[y, x]
    assert_same(layer(image)[0, 0], torch.from_numpy(expected), atol=1e-12)
    if height % 2 == 0:
        assert before[0] == 0, "even sizes are padded after only"


def test_six_branches_side_by_side() -> None:
    """One convolution in six groups is six branches p = conv(conv(y)), q = conv(p), concatenated p1..p6, q1..q6."""
    torch.manual_seed(0)
    block = ParallelBlock(4, 8, "relu", "torch").eval().double()
    x = torch.randn(2, 4, 9, 8, dtype=torch.float64)
    y = F.relu(block.enter(F.relu(block.norm(x))))

    def branch(layer: SameConv, i: int, inputs: Tensor, stride: int) -> Tensor:
        part = slice(4 * i, 4 * i + 4)
        return F.relu(F.conv2d(inputs, layer.conv.weight[part], layer.conv.bias[part], stride, 1))  # type: ignore[index]

    p = [branch(block.first, i, branch(block.halve, i, y, 2), 1) for i in range(6)]
    q = [branch(block.second, i, p[i], 1) for i in range(6)]
    expected = block.fuse(torch.cat([*p, *q], dim=1)) + block.shortcut(F.relu(block.norm(x)))
    assert_same(block(x), expected, atol=1e-12)


def test_shapes_of_the_paper() -> None:
    network, shapes = SPNet().eval(), []
    for layer in (
        network.conv1,
        network.conv2,
        network.block1,
        network.block2,
        network.block3,
        network.conv6,
    ):
        layer.register_forward_hook(lambda _m, _i, output: shapes.append(tuple(output.shape[1:])))
    with torch.no_grad():
        network(torch.rand(1, 224, 224))
    sides = (112, 56, 28, 14, 7, 7)
    assert shapes == [(c, s, s) for c, s in zip((12, 24, 96, 192, 384, 1024), sides, strict=True)]


def test_groups_of_the_small_sibling_are_independent() -> None:
    """A pixel of one group does not reach the channels of another in the grouped convolutions."""
    layer = SPGNet(version="s2p6").body[2].first.eval()  # type: ignore[union-attr, operator]
    x = torch.zeros(1, 48, 5, 5)
    quiet = layer(x)
    x[0, 0] = 1.0
    touched = torch.nonzero((layer(x) != quiet).flatten(2).any(-1)[0])[:, 0].tolist()
    assert touched
    assert max(touched) < 8


@pytest.mark.parametrize("kind", [SPNet, SPGNet])
def test_weights_survive_a_file(kind: Any, tmp_path: Path) -> None:
    from tensorsim.weights import save_weights

    network = make(kind, num_classes=5, in_channels=2)
    save_weights(network, tmp_path / "own.safetensors", {})
    loaded = kind.from_pretrained(tmp_path / "own.safetensors")
    assert (loaded.num_classes, loaded.in_channels, loaded.training) == (5, 2, False)
    x = torch.rand(1, 2, 32, 32)
    with torch.no_grad():
        assert_same(loaded(x), network(x), atol=1e-2)  # parameters are stored in float16
    other = SPGNet if kind is SPNet else SPNet
    with pytest.raises(TensorsimError, match=f"expected those of an {other.__name__}"):
        other.from_pretrained(tmp_path / "own.safetensors")


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (lambda: SPNet(0), "num_classes: got 0"),
        (lambda: SPNet(in_channels=0), "in_channels: got 0"),
        (lambda: SPNet(activation="gelu"), "got 'gelu', expected one of relu, none"),
        (lambda: SPNet(padding="same"), "got 'same', expected one of matlab, torch"),
        (lambda: SPGNet(0), "num_classes: got 0"),
        (lambda: SPGNet(version="s3"), "got 's3', expected one of s2p6"),
    ],
)
def test_refuses_bad_settings(network: Any, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        network()


@pytest.mark.parametrize("kind", [SPNet, SPGNet])
def test_the_mean_of_each_channel_is_subtracted(kind: type[nn.Module]) -> None:
    network = make(kind, num_classes=3, in_channels=2)
    x, mean = torch.rand(2, 2, 32, 32), torch.tensor([0.1, 0.7])
    with torch.no_grad():
        network.get_buffer("mean").zero_()
        expected = network(x - mean[:, None, None])
        network.get_buffer("mean").copy_(mean)
        assert_same(network(x), expected, atol=1e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_layer_of_two_levels_written_out(stride: int) -> None:
    """First the channels of the first level, then those of the second; ReLU after the sum, none before it."""
    torch.manual_seed(0)
    layer = settled(TwoLevelLayer(4, 8, stride, 2)).double()
    x = torch.randn(2, 4, 6, 6, dtype=torch.float64)

    def norm(module: Any, y: Tensor) -> Tensor:
        scale = module.weight / (module.running_var + module.eps).sqrt()
        return (y - module.running_mean[:, None, None]) * scale[:, None, None] + module.bias[:, None, None]

    def conv(module: Any, y: Tensor, stride: int, padding: int, groups: int = 1) -> Tensor:
        return norm(module[1], F.conv2d(y, module[0].weight, None, stride, padding, 1, groups))

    o1 = conv(layer.first, conv(layer.enter, x, 1, 0).relu(), stride, 1, 2).relu()
    o2 = conv(layer.second, o1, 1, 1, 2).relu()
    fused = conv(layer.fuse, torch.cat([o1, o2], dim=1), 1, 0)
    skip: Any = layer.skip
    beside = conv(skip, x, 1, 0) if stride == 1 else conv(skip[1], conv(skip[0], x, 2, 1, 4), 1, 0)
    with torch.no_grad():
        assert_same(layer(x), (beside + fused).relu(), atol=1e-12)


def test_the_heads_written_out() -> None:
    """From the last convolution on: mean over the picture, then linear layers with ReLU between them."""
    x = torch.rand(2, 1, 64, 48)
    with torch.no_grad():
        small = make(SPGNet)
        features = small.body(x - 0.3).mean(dim=(2, 3)) @ small.fc1.weight.T
        scale = small.norm.weight / (small.norm.running_var + small.norm.eps).sqrt()
        features = ((features - small.norm.running_mean) * scale + small.norm.bias).relu()
        assert_same(small(x), features @ small.fc2.weight.T, atol=1e-5)
        large = make(SPNet)
        y = large.conv2(large.conv1(x - 0.3).relu())
        y = large.conv6(large.block3(large.block2(large.block1(y))).relu()).relu().mean(dim=(2, 3))
        y = (y @ large.fc1.weight.T + large.fc1.bias).relu() @ large.fc2.weight.T + large.fc2.bias
        assert_same(large(x), y, atol=1e-5)


def test_layers_of_the_small_sibling() -> None:
    """Channels and sizes of a 32x32 image through 4, 8 and 3 layers of 16, 32 and 64 times the groups."""
    network, shapes = SPGNet(version="s2p6").eval(), []
    for layer in network.body:
        layer.register_forward_hook(lambda _m, _i, output: shapes.append(tuple(output.shape[1:3])))
    with torch.no_grad():
        network(torch.rand(1, 32, 32))
    layers = [(96, 16)] * 4 + [(192, 8)] * 8 + [(384, 4)] * 3
    assert shapes == [(12, 32), (24, 32), *layers, (1024, 4)]
    torch.manual_seed(0)
    network = SPGNet()
    assert float(network.fc1.weight.detach().std()) == pytest.approx(0.01, rel=0.01)
    last: Any = network.body[-1]
    assert float(last[0].weight.detach().std()) == pytest.approx((2 / 1024) ** 0.5, rel=0.01), "fan out, 1x1"
    assert network.dropout.p == 0.2
