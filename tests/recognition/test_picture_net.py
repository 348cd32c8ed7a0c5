"""The small network of pictures along time."""

import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.recognition import PictureNet
from tensorsim.weights import save_weights
from tests.networks import settled
from tests.stage import StageTester


class TestPictureNet(StageTester):
    batch_shapes = ((3,),)
    batch_atol = 1e-4
    float32_atol = 1e-3
    gradient_arguments = ()  # differentiable but for the kinks of ReLU and maxima, where finite differences fail

    def make(self):
        torch.manual_seed(0)
        return settled(PictureNet(4, 16, width=4))

    def inputs(self, batch, dtype):
        return (torch.rand(*batch, 1, 16, 24, dtype=dtype, generator=torch.Generator().manual_seed(1)),)

    def bad_inputs(self):
        x = torch.rand(2, 1, 16, 24)
        return [
            ((x[0],), "pictures: got shape"),
            ((x[:, :, :12],), "expected"),
            ((x[..., :7],), "at least 8"),
        ]


def test_equals_its_layers_one_by_one():
    net = TestPictureNet().make().double()
    (x,) = TestPictureNet().inputs((2,), torch.float64)
    y = x
    for k in range(4):
        conv, norm = (net.features[i] for i in (0 + 4 * k, 1 + 4 * k))
        y = torch.nn.functional.conv2d(y, conv.weight, padding=1)
        scale = norm.weight / (norm.running_var + norm.eps).sqrt()
        y = (y - norm.running_mean.view(-1, 1, 1)) * scale.view(-1, 1, 1) + norm.bias.view(-1, 1, 1)
        y = y.clamp(min=0)
        if k < 3:
            y = y.unflatten(-1, (-1, 2)).amax(-1).unflatten(-2, (-1, 2)).amax(-2)
    features = torch.cat([y.mean(-1), y.max(-1).values], dim=1).reshape(2, -1)
    torch.testing.assert_close(net(x), features @ net.head.weight.T + net.head.bias)


def test_any_length_of_time():
    net = TestPictureNet().make()
    assert net(torch.rand(2, 1, 16, 8)).shape == net(torch.rand(2, 1, 16, 100)).shape == (2, 4)


def test_weights_come_back(tmp_path):
    net = TestPictureNet().make()
    save_weights(net, tmp_path / "net.safetensors", {})
    back = PictureNet.from_pretrained(tmp_path / "net.safetensors")
    (x,) = TestPictureNet().inputs((3,), torch.float32)
    torch.testing.assert_close(back(x), net(x), rtol=0.02, atol=0.02)


def test_other_weights_are_refused(tmp_path):
    save_weights(torch.nn.Linear(2, 2), tmp_path / "net.safetensors", {})
    with pytest.raises(TensorsimError, match="expected those of a PictureNet"):
        PictureNet.from_pretrained(tmp_path / "net.safetensors")


@pytest.mark.parametrize("sizes", [(0, 16), (4, 7)])
def test_sizes_that_are_too_small_are_refused(sizes):
    with pytest.raises(TensorsimError, match="PictureNet: got"):
        PictureNet(*sizes)
