"""The recipe of the presence head: its loss, what it trains and leaves alone, and a head that learns."""

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from tensorsim.errors import TensorsimError
from tensorsim.training.loop import LoopConfig, fit
from tensorsim.training.pose import PosePeople
from tensorsim.training.pose_data import Person
from tensorsim.training.presence import PresenceRecipe, presence_loss, with_presence_head
from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig, PresenceHead
from tests.networks import settled
from tests.training.test_pose_data import BOX, sample, standing
from tests.training.test_shards import jpg

TINY = HRNetConfig(4, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=4)


def test_loss_is_the_cross_entropy_of_a_logistic_function() -> None:
    scores = torch.full((1, 17), 0.34)
    scores[0, :3] = torch.tensor([0.6, 0.1, 0.9])
    known, gone = torch.zeros(1, 17, dtype=torch.bool), torch.zeros(1, 17, dtype=torch.bool)
    known[0, 0], gone[0, 1] = True, True

    def probability(score: float) -> float:
        return (score / 0.34) ** 4 / (1 + (score / 0.34) ** 4)

    expected = -(math.log(probability(0.6)) + math.log(1 - probability(0.1))) / 2
    assert float(presence_loss(scores, known, gone)) == pytest.approx(expected, rel=1e-5)
    assert float(presence_loss(scores, known & False, gone & False)) == 0.0


def recipe(folder: Path, net: HRNet) -> PresenceRecipe:
    (folder / "a.jpg").write_bytes(jpg(1, 280, 200))
    persons = [Person(sample(folder / "a.jpg"), BOX, standing(), 9000.0)]
    return PresenceRecipe(
        net, PosePeople(persons, persons, []), {"held_out": persons * 12}, learning_rate=1e-2
    )


def untrained() -> HRNet:
    torch.manual_seed(0)
    network = settled(HRNet(TINY, (64, 64)))
    nn.init.normal_(network.final_layer.weight)
    return network


def test_a_new_head_changes_nothing() -> None:
    network = untrained()
    other = with_presence_head(network, 8).eval()
    assert other.input_size == (64, 64)
    assert with_presence_head(other, 8) is other
    crops = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        torch.testing.assert_close(other(crops), network(crops))


def test_only_the_head_is_trained(tmp_path: Path) -> None:
    network = with_presence_head(untrained(), 8)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    figures = fit(
        recipe(tmp_path, network),
        LoopConfig(tmp_path / "out", 3, 4, workers=0, precision="float32", quiet=True, ema_decay=0.0),
    )
    assert figures.keys() == {"held_out_seen", "held_out_ghosts", "score", "step"}
    loaded = HRNet.from_pretrained(tmp_path / "out" / "best.safetensors")
    assert isinstance(loaded.presence, PresenceHead)
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name]) != name.startswith("presence."), name


def test_most_pictures_end_within_the_people(tmp_path: Path) -> None:
    samples = [recipe(tmp_path, with_presence_head(untrained(), 8)).sample(n) for n in range(40)]
    assert 0.5 < sum(sample["gone"].any() for sample in samples) / 40 < 0.95


def test_a_head_learns_what_is_missing() -> None:
    """Crops whose lower half is black have no legs, whatever their heat maps say."""
    torch.manual_seed(0)
    features, maps = torch.rand(64, 4, 16, 16), torch.rand(64, 17, 16, 16)
    cut = torch.arange(64) % 2 == 0
    features[cut, :, 8:] = 0.0
    gone = cut[:, None] & (torch.arange(17) > 12)
    head = PresenceHead(4, 16)
    optimiser = torch.optim.Adam(head.parameters(), lr=1e-2)
    for _ in range(100):
        loss = presence_loss(head(features, maps).amax((-2, -1)), ~gone, gone)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    scores = head(features, maps).amax((-2, -1))
    assert (scores[gone] < 0.34).float().mean() > 0.95
    assert (scores[~gone] >= 0.34).float().mean() > 0.95


def test_refuses_a_network_without_a_head(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="presence head"):
        recipe(tmp_path, untrained())
