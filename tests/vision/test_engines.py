"""Engines run the networks of this package and no others."""

from typing import get_args

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.commands.networks import Engine
from tensorsim.errors import TensorsimError
from tensorsim.vision import engines
from tensorsim.vision.engines import ENGINES, chosen_engine, run_by
from tensorsim.vision.onnx_engine import OnnxPose
from tensorsim.vision.pose2d.crops import OpenCVBoxCrop
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
    assert isinstance(pose.crop, OpenCVBoxCrop)
    assert isinstance(pose.wide_crop, OpenCVBoxCrop)
    assert (pose.wide_crop.height, pose.wide_crop.width) == (pose.crop.width, pose.crop.height)
    run_by(engine, other, pose)
    assert pose.network.network is inside, "it is run by the engine already"


def test_commands_offer_the_engines_that_there_are() -> None:
    assert get_args(Engine) == ENGINES


@pytest.mark.parametrize("installed", [True, False])
@pytest.mark.parametrize("bfloat16", [True, False])
def test_the_fastest_engine_is_taken_by_itself(
    monkeypatch: pytest.MonkeyPatch, installed: bool, bfloat16: bool
) -> None:
    monkeypatch.setattr(engines, "import_failure", lambda _: None if installed else "no such package")
    monkeypatch.setattr(engines, "multiplies_bfloat16", lambda device: bfloat16)
    expected = "openvino" if installed and bfloat16 else "onnxruntime"
    cpu = torch.device("cpu")
    assert chosen_engine("auto", cpu) == expected
    assert chosen_engine("int8", cpu) == "int8"
    assert chosen_engine("auto", torch.device("cuda")) == "torch"


def test_the_chosen_engine_runs_the_networks(network: ts.vision.HRNet) -> None:
    pose = TopDownPose(network, flip_test=False)
    run_by("auto", nn.Identity(), pose)
    assert isinstance(pose.network, OnnxPose)
    assert pose.network.engine.runtime.startswith(chosen_engine("auto", torch.device("cpu")))


def test_torch_leaves_them_alone_and_other_names_are_refused(network: ts.vision.HRNet) -> None:
    pose = TopDownPose(network, flip_test=False)
    assert run_by("torch", nn.Identity(), pose)[1] is pose
    assert pose.network is network
    with pytest.raises(
        TensorsimError, match="engine: got 'fast', expected one of auto, onnxruntime, openvino, int8, torch"
    ):
        run_by("fast", nn.Identity(), pose)
