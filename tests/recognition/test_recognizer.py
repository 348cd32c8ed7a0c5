from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.errors import TensorsimError
from tensorsim.recognition import ActivityRecognizer, LabelSet, MapToImage, SPGNet, SPNet
from tensorsim.types import RadarMaps
from tensorsim.weights import save_weights
from tests.stage import StageTester

RADAR = ts.RadarConfig.through_wall()
BINS, RANGES = 256, RADAR.samples_per_chirp // 2


def maps(batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> RadarMaps:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand((*batch, *shape), generator=generator, dtype=dtype) + 0.1

    ridges = torch.randint(BINS, (*batch, 2, 20), generator=generator)
    return RadarMaps(draw(RANGES, 30), draw(RANGES, 29), draw(BINS, 20), ridges, draw(2, 20), draw())


class FromTensors(nn.Module):
    """The recognizer with the maps it looks at as arguments of their own."""

    def __init__(self, recognizer: ActivityRecognizer) -> None:
        super().__init__()
        self.recognizer = recognizer

    def forward(self, mti: Tensor, doppler: Tensor, ridges: Tensor, magnitudes: Tensor) -> Tensor:
        return self.recognizer(RadarMaps(mti, mti, doppler, ridges, magnitudes, doppler))


class Tester(StageTester):
    inputs_of = "doppler"
    batched_arguments = (0, 1, 2, 3)

    def make(self) -> nn.Module:
        torch.manual_seed(0)
        channels = 2 if self.inputs_of == "merged" else 1
        return FromTensors(ActivityRecognizer(RADAR, SPGNet(12, channels), self.inputs_of, size=16)).eval()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        m = maps(batch, dtype)
        return m.range_time_mti, m.doppler_time, m.ridges, m.ridge_magnitudes

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        m = maps((1,))
        return [((m.range_time_mti, -m.doppler_time, m.ridges, -m.ridge_magnitudes), "negative")]


class TestDoppler(Tester):
    gradient_arguments = (1,)
    gradient_atol = 1e-4


class TestRidges(Tester):
    inputs_of = "ridges"
    gradient_arguments = (3,)
    gradient_atol = 1e-4

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        m = maps((1,))
        return [((m.range_time_mti, m.doppler_time, m.ridges + BINS, m.ridge_magnitudes), "bins outside")]


class TestMerged(Tester):
    inputs_of = "merged"
    gradient_arguments = (0, 1)
    gradient_atol = 1e-4


def test_pictures_are_those_of_the_maps() -> None:
    m = maps((2,))
    doppler = MapToImage.doppler(RADAR, size=16)(m.doppler_time)
    of_range = MapToImage.range(RADAR, size=16)(m.range_time_mti)
    assert torch.equal(ActivityRecognizer(RADAR, SPNet(), size=16).picture(m), doppler)
    merged = ActivityRecognizer(RADAR, SPNet(in_channels=2), "merged", size=16).picture(m)
    assert torch.equal(merged, torch.cat([of_range, doppler], 1))


@pytest.mark.parametrize("network", [SPNet(3), SPGNet(3)])
def test_weights_say_what_they_were_trained_on(tmp_path: Path, network: nn.Module) -> None:
    path = tmp_path / "net.safetensors"
    metadata = {"network": type(network).__name__, "size": "32", "speed_m_s": "2.5", "range_db": "30"}
    save_weights(network.eval(), path, metadata)
    with pytest.raises(TensorsimError, match="a network of 3 classes, expected 12, one per class name"):
        ActivityRecognizer.from_pretrained(RADAR, path)
    save_weights(network, path, {**metadata, "class_names": '["a", "b", "c"]'})
    loaded = ActivityRecognizer.from_pretrained(RADAR, path)
    expected = ActivityRecognizer(
        RADAR, network, size=32, speed_m_s=2.5, range_db=30.0, class_names=("a", "b", "c")
    )
    assert loaded.class_names == ("a", "b", "c")
    m = maps((2,))
    torch.testing.assert_close(loaded(m), expected(m), rtol=0.01, atol=0.01)
    save_weights(network, path, {"size": "32"})
    with pytest.raises(TensorsimError, match=r"got the metadata .*expected network"):
        ActivityRecognizer.from_pretrained(RADAR, path)


def test_networks_come_back_with_their_activation_and_padding(tmp_path: Path) -> None:
    network = SPNet(2, activation="none", padding="torch").eval()
    path = tmp_path / "literal.safetensors"
    ActivityRecognizer(RADAR, network, size=32, class_names=("a", "b")).save_pretrained(path)
    pictures = torch.rand(2, 1, 32, 32)
    with torch.no_grad():
        loaded = ActivityRecognizer.from_pretrained(RADAR, path).network(pictures)
        torch.testing.assert_close(loaded, network(pictures), rtol=0.01, atol=1e-3)
        network.act = nn.ReLU()
        assert float((loaded - network(pictures)).abs().max()) > 0.05


def test_bad_arguments() -> None:
    with pytest.raises(
        TensorsimError, match="inputs: got 'picture', expected one of doppler, ridges, merged"
    ):
        ActivityRecognizer(RADAR, SPNet(), "picture")
    with pytest.raises(TensorsimError, match="network: got the class SPNet, expected an instance of Module"):
        ActivityRecognizer(RADAR, SPNet)
    with pytest.raises(TensorsimError, match="maps: got a Tensor, expected an instance of RadarMaps"):
        ActivityRecognizer(RADAR, SPNet())(torch.zeros(256, 20))
    with pytest.raises(TensorsimError, match="1 input channels, expected 2 for inputs 'merged'"):
        ActivityRecognizer(RADAR, SPNet(), "merged")


def test_the_shipped_network_is_the_small_one() -> None:
    """Of the two that are shipped it does better on films that networks watched; the other goes by its name."""
    recognise = ActivityRecognizer.from_pretrained(RADAR)
    assert isinstance(recognise.network, SPGNet)
    assert recognise.doppler_picture.size == 32
    named = ActivityRecognizer.from_pretrained(RADAR, "spnet-activities")
    assert isinstance(named.network, SPNet)
    assert named.doppler_picture.size == 64


def test_own_classifiers_are_saved_with_their_class_names(tmp_path: Path) -> None:
    own = ActivityRecognizer(
        RADAR, SPGNet(2, 2).eval(), "merged", 16, 2.5, 30.0, class_names=["waving", "walking"]
    )
    own.save_pretrained(tmp_path / "own.safetensors")
    loaded = ActivityRecognizer.from_pretrained(RADAR, tmp_path / "own.safetensors")
    assert loaded.class_names == ("waving", "walking")
    m = maps((2,))
    torch.testing.assert_close(loaded.picture(m), own.picture(m))
    torch.testing.assert_close(loaded(m), own(m), rtol=0.01, atol=0.01)
    own.save_pretrained(tmp_path / "own.safetensors", class_names=("a", "b"))
    assert ActivityRecognizer.from_pretrained(RADAR, tmp_path / "own.safetensors").class_names == ("a", "b")
    with pytest.raises(TensorsimError, match="class_names: got 1, expected 2"):
        own.save_pretrained(tmp_path / "own.safetensors", class_names=("a",))
    with pytest.raises(TensorsimError, match=r"expected \.safetensors"):
        own.save_pretrained(tmp_path / "own.pth")
    own.network = nn.Flatten()
    with pytest.raises(TensorsimError, match="got a network of class Flatten"):
        own.save_pretrained(tmp_path / "own.safetensors")


def test_label_sets_refuse_what_is_not_one_name_per_class() -> None:
    assert LabelSet().names == ts.ACTIVITIES
    for names in ((), ("a", "a"), ("a", ""), "walking"):
        with pytest.raises(TensorsimError, match="class_names: got"):
            LabelSet(names)  # type: ignore[arg-type]
    with pytest.raises(TensorsimError, match="expected a JSON list"):
        LabelSet.from_text("waving")
