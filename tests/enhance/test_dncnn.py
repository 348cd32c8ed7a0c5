from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.enhance.dncnn import DnCNN, MapDenoiser
from tensorsim.errors import TensorsimError
from tensorsim.weights import save_weights
from tests.stage import StageTester, assert_same


def small(batch_norm: bool = True, depth: int = 4) -> DnCNN:
    """A network of random weights whose normalisation has seen data."""
    network = DnCNN(depth=depth, channels=5, batch_norm=batch_norm)
    generator = torch.Generator().manual_seed(7)
    for name, value in network.state_dict().items():
        if name.endswith("running_var"):
            value.copy_(torch.rand(value.shape, generator=generator) + 0.5)
        elif value.is_floating_point():
            value.copy_(torch.randn(value.shape, generator=generator) * 0.3)
    return network.eval()


@pytest.fixture(autouse=True)
def _inference(request: pytest.FixtureRequest) -> Iterator[None]:
    """Gradients only where a test is about them."""
    with torch.set_grad_enabled("gradients" in request.node.name):
        yield


class TestDnCNN(StageTester):
    def make(self) -> nn.Module:
        return small()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        return (torch.rand((*batch, 6, 9), generator=generator, dtype=torch.float64).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(9),), r"got shape \[9\], expected \(\.\.\., H, W\)"),
            ((torch.zeros(2, 0, 9),), r"got an empty tensor of shape \[2, 0, 9\]"),
            ((torch.zeros(6, 9, dtype=torch.uint8),), r"expected a real floating point tensor"),
            ((torch.zeros(6, 9, dtype=torch.complex64),), r"expected a real floating point tensor"),
        ]


class TestMapDenoiser(TestDnCNN):
    def make(self) -> nn.Module:
        return MapDenoiser(small(), tile=4)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (super().inputs(batch, dtype)[0] * 40 + 3,)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [*super().bad_inputs(), ((torch.full((6, 9), float("nan")),), "got NaN or infinite values")]


class TestMapDenoiserOnTheFloorScale(TestMapDenoiser):
    def make(self) -> nn.Module:
        return MapDenoiser(small(), tile=4, scale="floor")


@pytest.mark.parametrize(
    ("arguments", "count"),
    [
        ((20, 64, True), 668_225),
        ((20, 64, False), 665_921),
        ((17, 64, True), 557_057),
        ((17, 64, False), 555_137),
    ],
)
def test_number_of_parameters(arguments: tuple[int, int, bool], count: int) -> None:
    assert sum(p.numel() for p in DnCNN(*arguments).parameters()) == count


def test_output_is_the_image_less_its_noise() -> None:
    """Convention: ``y - Q(y)``; Q is the plain chain of layers, written out here with torch's functions."""
    network, image = small(), torch.rand(1, 1, 6, 9)
    weights = network.state_dict()
    x = image
    for i in range(4):
        key = f"model.{0 if i == 0 else 3 * i - 1}"
        x = nn.functional.conv2d(x, weights[f"{key}.weight"], weights[f"{key}.bias"], padding=1)
        if 0 < i < 3:
            mean, var = weights[f"model.{3 * i}.running_mean"], weights[f"model.{3 * i}.running_var"]
            scale, shift = weights[f"model.{3 * i}.weight"], weights[f"model.{3 * i}.bias"]
            x = (x - mean.view(-1, 1, 1)) / (var.view(-1, 1, 1) + 1e-4).sqrt()
            x = x * scale.view(-1, 1, 1) + shift.view(-1, 1, 1)
        if i < 3:
            x = x.clamp(min=0)
    assert_same(network.noise(image), x, atol=1e-5)
    assert_same(network(image), image - x, atol=1e-5)
    assert_same(network(image[0, 0]), (image - x)[0, 0], atol=1e-5)


def test_folded_network_gives_the_same_image() -> None:
    network, image = small().double(), torch.rand(2, 8, 7, dtype=torch.float64)
    folded = network.folded()
    assert not any(isinstance(layer, nn.BatchNorm2d) for layer in folded.modules())
    assert_same(folded(image), network(image), atol=1e-12)
    assert folded.folded() is folded
    assert not network.training


def test_folding_leaves_a_network_in_training_alone() -> None:
    network = small().train()
    network.folded()
    assert all(module.training for module in network.modules())


# ---- weights ---------------------------------------------------------------------------------------------


def test_loads_the_layouts_of_others(tmp_path: Path) -> None:
    image = torch.rand(2, 9, 8)
    for batch_norm in (True, False):
        network = small(batch_norm, depth=6)
        torch.save(network.state_dict(), tmp_path / "kair.pth")
        loaded = DnCNN.from_pretrained(tmp_path / "kair.pth")
        assert (loaded.depth, loaded.channels, loaded.batch_norm, loaded.training) == (
            6,
            5,
            batch_norm,
            False,
        )
        assert_same(loaded(image), network(image))
    # network is the folded one: convolution i is model.{2i} here and conv{i} in the other layout.
    renamed = {
        f"conv{int(k.split('.')[1]) // 2}.{k.split('.')[2]}": v for k, v in network.state_dict().items()
    }
    torch.save(renamed, tmp_path / "numbered.pth")
    assert_same(DnCNN.from_pretrained(str(tmp_path / "numbered.pth"))(image), network(image))


def test_own_weights_as_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    network, image = small(), torch.rand(2, 9, 8)
    save_file(network.state_dict(), tmp_path / "own.safetensors")
    assert_same(DnCNN.from_pretrained(tmp_path / "own.safetensors")(image), network(image))


def test_names_of_the_authors_code() -> None:
    keys = set(DnCNN().state_dict())
    assert {
        "model.0.weight",
        "model.2.bias",
        "model.3.running_var",
        "model.53.weight",
        "model.56.bias",
    } <= keys
    assert set(DnCNN(batch_norm=False).state_dict()) == {
        f"model.{2 * i}.{part}" for i in range(20) for part in ("weight", "bias")
    }


def test_refuses_weights_of_other_networks(tmp_path: Path) -> None:
    def refused(state: dict[str, Tensor], message: str) -> None:
        torch.save(state, tmp_path / "other.pth")
        with pytest.raises(TensorsimError, match=message):
            DnCNN.from_pretrained(tmp_path / "other.pth")

    refused({"head.weight": torch.zeros(3)}, "got the weights head.weight, .* expected those of a grey DnCNN")
    colour = small(batch_norm=False).state_dict() | {"model.0.weight": torch.zeros(5, 3, 3, 3)}
    refused(colour, "expected those of a grey DnCNN")
    cut = small().state_dict()
    del cut["model.5.bias"]
    refused(cut, r"model\.5\.bias")
    with pytest.raises(TensorsimError, match="no such file"):
        DnCNN.from_pretrained(tmp_path / "missing.pth")


def psnr_db(image: np.ndarray, clean: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - clean) ** 2)))


@pytest.mark.parametrize(
    ("picture", "expected_db"),
    [("01", {15: 32.02, 25: 29.94, 50: 27.09}), ("05", {15: 33.03, 25: 30.31, 50: 26.88})],
)
def test_figures_of_the_released_network(
    shared_data: Path, picture: str, expected_db: dict[int, float]
) -> None:
    check_figures(shared_data, picture, expected_db)


@pytest.mark.slow
def test_figures_of_the_released_network_on_a_large_picture(shared_data: Path) -> None:
    check_figures(shared_data, "08", {15: 34.58, 25: 32.46, 50: 29.40})


def check_figures(shared_data: Path, picture: str, expected_db: dict[int, float]) -> None:
    import cv2

    network = DnCNN.from_pretrained(shared_data / "weights" / "dncnn_gray_blind.pth")
    clean = cv2.imread(str(shared_data / "images" / f"Set12_{picture}.png"), cv2.IMREAD_GRAYSCALE) / 255
    noisy = [
        clean + np.random.default_rng(0).standard_normal(clean.shape) * sigma / 255 for sigma in expected_db
    ]
    with torch.no_grad():
        images = network(torch.from_numpy(np.stack(noisy)).float()).numpy()
    for image, figure in zip(images, expected_db.values(), strict=True):
        assert psnr_db(image, clean) == pytest.approx(figure, abs=0.05)


# ---- maps ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tile", [1, 3, 4, 16, 17, 50])
def test_tiles_equal_the_whole_map(tile: int) -> None:
    network, maps = small(depth=5).double(), torch.rand(2, 7, 17, dtype=torch.float64)
    assert_same(MapDenoiser(network, tile)(maps), MapDenoiser(network, tile=1000)(maps), atol=1e-13)


def test_a_shorter_overlap_would_show() -> None:
    denoiser = MapDenoiser(small(depth=5).double(), tile=4)
    maps = torch.rand(7, 17, dtype=torch.float64)
    whole = denoiser(maps)
    denoiser.reach -= 1
    assert not torch.allclose(denoiser(maps), whole, rtol=0, atol=1e-9)


def test_each_map_is_cleaned_on_its_own_scale() -> None:
    network = small()
    image = torch.rand(6, 9)
    image[0, 0], image[-1, -1] = 0.0, 1.0
    maps = torch.stack([image, 1e-9 * image, 500 * image + 20])
    clean = network(image).clamp(min=0)
    expected = torch.stack([clean, 1e-9 * clean, 500 * clean + 20])
    assert_same([*MapDenoiser(network)(maps)], [*expected], atol=1e-5)


def test_noise_counts_in_floors() -> None:
    """Convention: of the map over its median, what the network takes away from log(1 + map) is taken from the map."""
    network = small().double()
    maps = 3 + 40 * torch.rand(2, 7, 9, dtype=torch.float64)
    floor = np.median(maps.numpy(), axis=(1, 2), keepdims=True)
    ratio = torch.from_numpy(maps.numpy() / floor)
    expected = (ratio - network.noise(torch.log(1 + ratio))).clamp(min=0) * torch.from_numpy(floor)
    clean = MapDenoiser(network, scale="floor")(maps)
    assert_same(clean, expected, atol=1e-9)
    assert_same(MapDenoiser(network, scale="floor")(1e-6 * maps), 1e-6 * clean, atol=1e-15)


def test_a_map_in_decibels_is_refused_where_noise_counts_in_floors() -> None:
    with pytest.raises(TensorsimError, match="got negative values, expected linear magnitudes"):
        MapDenoiser(small(), scale="floor")(torch.full((6, 9), -40.0))


def test_a_map_without_a_floor_has_no_noise() -> None:
    maps = torch.zeros(6, 9)
    maps[2] = 5.0
    assert torch.equal(MapDenoiser(small(), scale="floor")(maps), maps)


def test_a_weight_file_says_its_scale(tmp_path: Path) -> None:
    for stated, scale in (({"scale": "floor"}, "floor"), ({}, "peak")):
        save_weights(small(), tmp_path / "w.safetensors", stated)
        denoiser = MapDenoiser.from_pretrained(tmp_path / "w.safetensors", tile=7)
        assert (denoiser.scale, denoiser.tile, denoiser.training) == (scale, 7, False)
    save_weights(small(), tmp_path / "w.safetensors", {"scale": "cubic"})
    with pytest.raises(TensorsimError, match="scale: got 'cubic', expected one of"):
        MapDenoiser.from_pretrained(tmp_path / "w.safetensors")


def test_magnitudes_stay_magnitudes() -> None:
    maps = torch.rand(4, 6, 9)
    clean = MapDenoiser(small())(maps)
    assert bool((small()(maps) < 0).any())
    assert bool((clean >= maps.amin(dim=(-2, -1), keepdim=True)).all())
    assert float(MapDenoiser(small(), scale="floor")(maps).min()) == 0.0


def test_an_even_map_stays_as_it_is() -> None:
    for value in (0.0, 3.0):
        maps = torch.full((2, 6, 9), value)
        assert torch.equal(MapDenoiser(small())(maps), maps)


def test_refuses_bad_settings() -> None:
    for arguments, message in (
        ((1, 64), "depth: got 1"),
        ((0, 64), "depth: got 0"),
        ((20, 0), "channels: got 0"),
    ):
        with pytest.raises(TensorsimError, match=f"DnCNN {message}, expected an integer from"):
            DnCNN(*arguments)
    with pytest.raises(TensorsimError, match="tile: got 0, expected an integer"):
        MapDenoiser(small(), tile=0)
    with pytest.raises(TensorsimError, match="scale: got 'sqrt', expected one of"):
        MapDenoiser(small(), scale="sqrt")


def test_normalisation_is_that_of_the_authors() -> None:
    """KAIR builds its networks with an epsilon of 1e-4, ten times that of torch."""
    norms = [module for module in DnCNN(depth=5).modules() if isinstance(module, nn.BatchNorm2d)]
    assert [norm.eps for norm in norms] == [1e-4] * 3


def test_mixed_precision_casts_what_another_layer_gives() -> None:
    images = torch.rand(1, 6, 9)
    with torch.autocast("cpu", torch.bfloat16):
        found = small()(images.bfloat16())
    assert torch.allclose(found.float(), small()(images), atol=0.1)
    with pytest.raises(TensorsimError, match=r"expected torch\.float32 on cpu like the weights"):
        small()(images.bfloat16())
