"""Engines run the networks of this package and no others."""

from typing import get_args

import pytest
from torch import nn

import tensorsim as ts
from tensorsim.commands.networks import Engine
from tensorsim.errors import TensorsimError
from tensorsim.vision.engines import ENGINES, run_by
from tensorsim.vision.onnx_engine import OnnxPose
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose


@pytest.fixture(scope="module")
def network() -> ts.vision.HRNet:
    return ts.vision.HRNet.from_pretrained()


@pytest.mark.parametrize(
    ("engine", "runtime"),
    [("onnxruntime", "onnxruntime"), ("openvino", "openvino-bfloat16"), ("int8", "int8")],
)
def test_only_networks_of_this_package_are_replaced(
    network: ts.vision.HRNet, engine: str, runtime: str
) -> None:
    other = nn.Identity()
    pose = TopDownPose(network, flip_test=True)
    detector, same = run_by(engine, other, pose)
    assert detector is other
    assert same is pose
    assert isinstance(pose.network, FlipTest)
    inside = pose.network.network
    assert isinstance(inside, OnnxPose)
    assert inside.engine.runtime == runtime
    run_by(engine, other, pose)
    assert pose.network.network is inside, "it is run by the engine already"


def test_commands_offer_the_engines_that_there_are() -> None:
    assert get_args(Engine) == ENGINES


def test_torch_leaves_them_alone_and_other_names_are_refused(network: ts.vision.HRNet) -> None:
    pose = TopDownPose(network, flip_test=False)
    assert run_by("torch", nn.Identity(), pose)[1] is pose
    assert pose.network is network
    with pytest.raises(
        TensorsimError, match="engine: got 'fast', expected one of onnxruntime, openvino, int8, torch"
    ):
        run_by("fast", nn.Identity(), pose)
