"""Engines run the networks of this package and no others; in bfloat16 people have the key points of float32."""

import copy
import pickle
from typing import get_args

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.commands.networks import Engine
from tensorsim.errors import TensorsimError
from tensorsim.render.crops import rendered_crops
from tensorsim.vision.bfloat16 import Bfloat16Pose, fold_batch_norm
from tensorsim.vision.engines import ENGINES, run_by
from tensorsim.vision.onnx_engine import OnnxPose
from tensorsim.vision.pose2d.heatmaps import HeatmapDecoder
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose


@pytest.fixture(scope="module")
def network() -> ts.vision.HRNet:
    return ts.vision.HRNet.from_pretrained()


@pytest.mark.parametrize(
    ("engine", "kind"), [("onnxruntime", OnnxPose), ("int8", OnnxPose), ("bfloat16", Bfloat16Pose)]
)
def test_only_networks_of_this_package_are_replaced(
    network: ts.vision.HRNet, engine: str, kind: type[nn.Module]
) -> None:
    other = nn.Identity()
    pose = TopDownPose(network, flip_test=True)
    detector, same = run_by(engine, other, pose)
    assert detector is other
    assert same is pose
    assert isinstance(pose.network, FlipTest)
    assert isinstance(pose.network.network, kind)
    inside = pose.network.network
    run_by(engine, other, pose)
    assert pose.network.network is inside, "it is run by the engine already"


def test_commands_offer_the_engines_that_there_are() -> None:
    assert get_args(Engine) == ENGINES


def test_torch_leaves_them_alone_and_other_names_are_refused(network: ts.vision.HRNet) -> None:
    pose = TopDownPose(network, flip_test=False)
    assert run_by("torch", nn.Identity(), pose)[1] is pose
    assert pose.network is network
    with pytest.raises(
        TensorsimError, match="engine: got 'fast', expected one of onnxruntime, bfloat16, int8, torch"
    ):
        run_by("fast", nn.Identity(), pose)


@pytest.mark.parametrize("kind", [ts.vision.HRNet, ts.vision.CPM])
@torch.no_grad()
def test_batch_normalisations_are_folded_into_convolutions(kind: type[nn.Module]) -> None:
    network = kind.from_pretrained().double()  # type: ignore[attr-defined]
    crops = torch.rand(2, 3, *network.input_size, dtype=torch.float64)
    folded = fold_batch_norm(network)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in folded.modules())
    assert torch.allclose(folded(crops), network(crops), atol=1e-9)
    trained = fold_batch_norm(kind().train())
    assert not trained.training


@torch.no_grad()
def test_in_bfloat16_key_points_stay_where_they_are(network: ts.vision.HRNet) -> None:
    crops = rendered_crops(network.input_size, people=3, seed=100)
    small = Bfloat16Pose(network)
    plain, found = network(crops), small(crops)
    assert found.dtype == torch.float32
    assert 0 < float((found - plain).abs().max()) < 0.03 * float(plain.abs().max())
    decode = HeatmapDecoder()
    (expected, scores), (points, _) = decode(plain), decode(found)
    away = (points - expected).norm(dim=-1)[scores > 0.3]
    assert away.median() < 0.1
    assert away.quantile(0.98) < 0.5
    # One by one as all at once, without crops, and in float64, where the network is as it was.
    assert torch.equal(torch.cat([small(crop[None]) for crop in crops[:2]]), small(crops[:2]))
    assert small(crops[:0]).shape[0] == 0
    again = pickle.loads(pickle.dumps(small))
    assert torch.equal(again(crops[:2]), found[:2])
    exact = copy.deepcopy(small).double()
    assert torch.equal(exact(crops[:1].double()), exact.network(crops[:1].double()))
