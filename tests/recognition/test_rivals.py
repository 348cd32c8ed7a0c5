from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.recognition.adfe_net import ADFENet, DopplerEnhancement, fuse_doppler
from tensorsim.recognition.ccln import CCLN
from tensorsim.recognition.diat_radharnet import DIATRadHARNet
from tensorsim.recognition.fourier_net import FourierBlock, FourierNet, GlobalFilterBlock, GlobalFilterNet
from tensorsim.recognition.mc_gclu import MCGCLU
from tensorsim.recognition.mrw_cn import MRWCN, ResidualLayer
from tensorsim.recognition.networks import CLASSIFIERS, find_classifier
from tensorsim.recognition.spnet_dense import SPNetDense
from tests.networks import settled
from tests.stage import StageTester, assert_same


class TestMRWCN(StageTester):
    batch_shapes = ((2,), (2, 1))
    kind: ClassVar[Any] = MRWCN
    arguments: ClassVar[dict[str, Any]] = {}
    height, width = 33, 20

    def make(self) -> nn.Module:
        torch.manual_seed(0)
        network = self.kind(num_classes=3, in_channels=2, **self.arguments)
        network.mean.fill_(0.3)
        return settled(network)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        shape = (*batch, 2, self.height, self.width)
        return (torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype),)

    # Nine networks of the same few layers: what takes seconds each is for the slow suite.
    @pytest.mark.slow
    def test_exports(self) -> None:
        super().test_exports()

    @pytest.mark.slow
    def test_scripted_equals_eager(self) -> None:
        super().test_scripted_equals_eager()

    @pytest.mark.slow
    def test_gradients_against_finite_differences(self) -> None:
        super().test_gradients_against_finite_differences()

    def test_channels_last(self) -> None:
        """The layout that the training loop gives networks changes nothing."""
        x = self.inputs((2,), torch.float32)[0]
        with torch.no_grad():
            expected = self.make()(x)
            moved = self.make().to(memory_format=torch.channels_last)
            assert_same(moved(x.to(memory_format=torch.channels_last)), expected, atol=1e-5)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        name = self.kind.__name__
        return [
            (
                (torch.zeros(1, 3, 32, 32),),
                rf"{name}: got shape \[1, 3, 32, 32\], expected \(\.\.\., 2 channels",
            ),
            ((torch.zeros(0, 2, 32, 32),), "got an empty tensor"),
            ((torch.full((2, 32, 32), float("nan")),), "NaN or infinite"),
        ]


class TestMCGCLU(TestMRWCN):
    kind = MCGCLU


class TestDIATRadHARNet(TestMRWCN):
    kind = DIATRadHARNet


class TestSPNetDense(TestMRWCN):
    kind = SPNetDense


class TestADFENet(TestMRWCN):
    kind = ADFENet

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [*super().bad_inputs(), ((torch.zeros(2, 6, 9),), "got images of 6x9, expected at least 7x7")]


class TestCCLN(TestMRWCN):
    kind = CCLN

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [*super().bad_inputs(), ((torch.zeros(2, 15, 32),), "expected at least 16x16")]


class TestFourierNet(TestMRWCN):
    kind = FourierNet
    arguments: ClassVar[dict[str, Any]] = {"size": 32}
    height = width = 32

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [*super().bad_inputs(), ((torch.zeros(2, 32, 48),), "got images of 32x48, expected 32x32")]


class TestGlobalFilterNet(TestFourierNet):
    kind = GlobalFilterNet


class TestDopplerEnhancement(StageTester):
    def make(self) -> nn.Module:
        return DopplerEnhancement(RadarConfig.through_wall(), window_s=0.2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        parts = torch.randn((*batch, 40, 3, 2), generator=generator, dtype=torch.float64)
        return (
            torch.view_as_complex(parts).to(torch.complex128 if dtype == torch.float64 else torch.complex64),
        )

    def test_float32_near_float64(self) -> None:
        single = self.make()(*self.inputs((2,), torch.float32))
        assert_same(single, self.make()(*self.inputs((2,), torch.float64)), atol=1e-5)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(40, 3),), "expected a complex tensor"),
            ((torch.zeros(20, 3, dtype=torch.complex64),), "expected at least the 26"),
        ]


def test_enhanced_map_is_the_formula() -> None:
    """Against NumPy: both maps by explicit sums, then the weights."""
    radar = RadarConfig.through_wall()
    stage = DopplerEnhancement(radar, window_s=0.2)
    generator = np.random.default_rng(0)
    profiles = generator.standard_normal((60, 3)) + 1j * generator.standard_normal((60, 3)) + 2.0

    def magnitudes(series: np.ndarray) -> np.ndarray:
        length, hop = stage.length, stage.hop
        window = 0.54 - 0.46 * np.cos(2 * np.pi * np.arange(length) / length)
        frames = []
        for start in range(0, len(series) - length + 1, hop):
            cut = np.conj(series[start : start + length]) * window[:, None]
            frames.append(np.abs(np.fft.fftshift(np.fft.fft(cut, stage.bins, axis=0), 0)).sum(1))
        return np.stack(frames, 1)

    cancelled, centred = magnitudes(np.diff(profiles, axis=0)), magnitudes((profiles - profiles.mean(0))[1:])
    frequency = np.fft.fftshift(np.fft.fftfreq(stage.bins, 1 / radar.prf_hz))
    slow = np.exp(-(frequency**2) / (2 * (radar.prf_hz / 20) ** 2))[:, None]
    expected = (1 - slow) * cancelled / cancelled.max() + slow * centred / centred.max()
    found = stage(torch.from_numpy(profiles))
    assert_same(found, torch.from_numpy(expected / expected.max()), atol=1e-10)
    assert float(fuse_doppler(torch.zeros(4, 2), torch.zeros(4, 2), torch.zeros(4), 1.0).max()) == 0.0


@pytest.mark.parametrize(
    ("name", "channels", "classes", "size", "count"),
    [
        ("spnet", 3, 12, None, 11_055_660),
        ("spnet-literal", 3, 12, None, 11_055_660),
        ("spgnet", 3, 12, None, 3_268_052),
        ("spgnet-s2p7", 3, 12, None, 3_870_266),
        ("spgnet-s2p8", 3, 12, None, 4_539_632),
        ("spgnet-s2p9", 3, 12, None, 5_276_150),
        ("fourier-net", 3, 12, None, 6_496_012),
        ("global-filter-net", 3, 12, None, 7_257_868),
        ("adfe-net", 1, 12, None, 983_564),
        ("adfe-net", 3, 12, None, 1_008_652),
        ("mrw-cn", 3, 12, None, 2_777_689),
        ("mc-gclu", 3, 12, None, 2_483_404),
        ("diat-radharnet", 3, 6, None, 213_783),
        ("diat-radharnet", 3, 12, None, 214_941),
        ("ccln", 3, 12, None, 247_004),
    ],
)
def test_number_of_parameters(name: str, channels: int, classes: int, size: int | None, count: int) -> None:
    with torch.device("meta"):
        network = find_classifier(name).make(classes, channels)
    assert sum(p.numel() for p in network.parameters()) == count


@pytest.mark.parametrize(("version", "count"), [("xs", 15_605_388), ("s", 24_489_228), ("b", 42_613_772)])
def test_number_of_parameters_of_the_larger_versions(version: str, count: int) -> None:
    with torch.device("meta"):
        network = GlobalFilterNet(12, 3, version)
    assert sum(p.numel() for p in network.parameters()) == count


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_every_classifier_takes_small_pictures_of_any_channels(name: str) -> None:
    entry = CLASSIFIERS[name]
    network = entry.build(5, 3, 32).eval()
    with torch.no_grad():
        assert network(torch.rand(2, 3, 32, 32)).shape == (2, 5)


def test_unknown_classifier() -> None:
    with pytest.raises(TensorsimError, match=r"got 'spgnett', expected one of spnet, .*perhaps 'spgnet'"):
        find_classifier("spgnett")


def test_fourier_filter_is_a_circular_convolution() -> None:
    """The real part of the filtered spectrum is the circular convolution with the filter's kernel."""
    torch.manual_seed(0)
    block = FourierBlock(1, 6).eval().double()
    kernel = torch.randn(6, 6, dtype=torch.float64)
    spectrum = torch.fft.fft2(kernel)
    block.real.data, block.imag.data = spectrum.real[None], spectrum.imag[None]
    x = torch.rand(1, 1, 6, 6, dtype=torch.float64)
    filtered = torch.zeros(6, 6, dtype=torch.float64)
    for u in range(6):
        for v in range(6):
            filtered += kernel[u, v] * x[0, 0].roll((u, v), (0, 1))
    expected = torch.relu(x + block.a(x) * block.b(x) + filtered)
    assert_same(block(x), expected, atol=1e-12)


def test_global_filter_without_weights_leaves_the_bias_of_its_layers() -> None:
    torch.manual_seed(0)
    block = GlobalFilterBlock(4, 3).eval()
    block.filter.data.zero_()
    x = torch.randn(2, 3, 3, 4)
    bias = block.narrow(nn.functional.gelu(block.wide(block.norm2(torch.zeros(4)))))
    assert_same(block(x), x + bias, atol=1e-6)


def test_shortcut_of_a_residual_layer_of_stride_two_is_a_product_at_every_second_place() -> None:
    torch.manual_seed(0)
    layer = ResidualLayer(4, 4, 3, 2).eval()
    norm = next(m for m in layer.second.modules() if isinstance(m, nn.BatchNorm2d))
    nn.init.zeros_(norm.weight)  # the shortcut alone is left
    x = torch.randn(2, 4, 9, 6)
    product = next(layer.skip.parameters())[..., 0, 0]
    expected = torch.relu(torch.einsum("oi,bihw->bohw", product, x[..., ::2, ::2]))
    with torch.no_grad():
        assert_same(layer(x), expected, atol=1e-4)


def test_masks_in_training_alone() -> None:
    network = MCGCLU(2)
    x = torch.rand(64, 1, 40, 24)
    assert bool((network.eval().mask(x) == 1).all())
    torch.manual_seed(0)
    mask = network.train().mask(x)
    assert mask.shape == (64, 1, 40, 24)
    assert set(mask.unique().tolist()) == {0.0, 1.0}
    assert float(mask.mean()) == pytest.approx(0.7, abs=0.05)
    assert bool((mask[:, :, :16, :16] == mask[:, :, :1, :1]).all()), "whole patches"


def test_order_of_events_reaches_the_lstm_alone() -> None:
    torch.manual_seed(0)
    network = settled(CCLN(3, in_channels=128))
    network.body = nn.Identity()  # type: ignore[assignment]
    x = torch.rand(1, 128, 16, 16)
    with torch.no_grad():
        assert float((network(x) - network(x.flip(-1))).abs().max()) > 1e-4
        network.hidden.weight[:, 128:] = 0.0
        assert_same(network(x.flip(-1)), network(x), atol=1e-6)


@pytest.mark.parametrize(
    "kind", [ADFENet, CCLN, DIATRadHARNet, MCGCLU, MRWCN, SPNetDense, FourierNet, GlobalFilterNet]
)
def test_weights_survive_a_file(kind: Any, tmp_path: Path) -> None:
    from tensorsim.weights import save_weights

    torch.manual_seed(0)
    sized = {"size": 32} if kind in (FourierNet, GlobalFilterNet) else {}
    network = settled(kind(num_classes=5, in_channels=2, **sized))
    save_weights(network, tmp_path / "own.safetensors", {})
    loaded = kind.from_pretrained(tmp_path / "own.safetensors")
    assert (loaded.num_classes, loaded.in_channels, loaded.training) == (5, 2, False)
    x = torch.rand(1, 2, 32, 32)
    with torch.no_grad():
        assert_same(loaded(x), network(x), atol=1e-2)  # parameters are stored in float16
    other = CCLN if kind is not CCLN else MRWCN
    with pytest.raises(TensorsimError, match=rf"{other.__name__}|fit"):
        other.from_pretrained(tmp_path / "own.safetensors")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CCLN(0), "CCLN.num_classes: got 0"),
        (lambda: MRWCN(3, 0), "in_channels: got 0"),
        (lambda: FourierNet(size=40), "got 40, expected a multiple of 16"),
        (lambda: GlobalFilterNet(version="l"), "got 'l', expected one of tiny, xs, s, b"),
        (lambda: GlobalFilterNet(size=8), "got 8, expected a multiple of 16"),
        (lambda: DopplerEnhancement(RadarConfig.through_wall(), sigma_hz=0.0), "expected a positive number"),
    ],
)
def test_refuses_bad_settings(make: Any, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        make()
