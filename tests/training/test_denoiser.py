import json
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from tensorsim.commands.train_denoiser import TrainDenoiser
from tensorsim.enhance.dncnn import DnCNN, MapDenoiser
from tensorsim.errors import TensorsimError
from tensorsim.training.denoiser import (
    STORED,
    TRAINED,
    DenoiserRecipe,
    build_pairs,
    cut_patches,
    on_scale,
    simulate_pair,
    untrained,
    views,
)
from tensorsim.training.denoiser_scores import COLUMNS, compare, ridge_error, scores
from tensorsim.training.loop import LoopConfig, fit

pytest.importorskip("tensorboard")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pairs")
    build_pairs(folder, 10, per_map=6, scenes=("through-wall",), quiet=True)
    return folder


def test_a_pair_differs_by_its_noise() -> None:
    noisy, clean = simulate_pair("through-wall", 7, 3, 10.0)
    assert float(noisy.snr_db) == pytest.approx(10.0, abs=0.5)
    assert float(clean.snr_db) == pytest.approx(50.0, abs=0.5)
    again = simulate_pair("through-wall", 7, 3, 20.0)
    # One draw of the noise: at another ratio the same pattern, weaker.
    torch.testing.assert_close(again[1].doppler_time, clean.doppler_time)
    patterns = [pair.range_time - clean.range_time for pair in (noisy, again[0])]
    correlation = torch.corrcoef(torch.stack([x.flatten() for x in patterns]))[0, 1]
    assert float(correlation) > 0.8


def test_the_scale_is_that_of_the_map_denoiser() -> None:
    """A network that took the stored noise away would make MapDenoiser return the clean map."""
    noisy, clean = simulate_pair("through-wall", 7, 3, 10.0)
    image, noise = on_scale(noisy.doppler_time, clean.doppler_time)

    class Oracle(nn.Module):
        reach = 1

        def forward(self, images: Tensor) -> Tensor:
            torch.testing.assert_close(images, image)
            return images - noise

    whole = MapDenoiser(Oracle(), tile=10_000, scale="floor")(noisy.doppler_time)  # type: ignore[arg-type]
    expected = clean.doppler_time
    torch.testing.assert_close(whole, expected, rtol=1e-4, atol=1e-5 * float(expected.max()))


@pytest.mark.parametrize("scene", ["through-wall", "free-space"])
def test_noise_is_alike_at_all_ratios(scene: str) -> None:
    """What the floor scale is for: between 0 and 20 dB its deviation on the peak scale changes tenfold."""
    for view in ("doppler_time", "range_time_mti"):
        rms = []
        for ratio in (0.0, 20.0):
            noisy, clean = (getattr(maps, view) for maps in simulate_pair(scene, 7, 3, ratio))
            rms.append(float(on_scale(noisy, clean)[1].square().mean().sqrt()))
        assert all(0.5 < x < 1.5 for x in rms)


def test_views_of_maps() -> None:
    noisy, _ = simulate_pair("through-wall", 7, 3, 10.0)
    assert set(views(noisy, 128.0)) == {"doppler_time", "range_time_mti"}
    display = views(noisy, 8192.0)["range_time_mti, display rate"]
    first = noisy.range_time_mti[:, :32].square().mean(1).sqrt()
    torch.testing.assert_close(display[:, 0], first)


@pytest.mark.parametrize("shape", [(100, 300), (40, 500), (200, 50)])
def test_patches_lie_at_one_place_in_both_maps(shape: tuple[int, int]) -> None:
    """Half of them where the echo is: of a single bright point every such patch shows it."""
    noise = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    clean = torch.zeros(shape)
    clean[shape[0] // 2, shape[1] // 2] = 100.0
    image = torch.log1p(clean + noise)
    images, noises = cut_patches(image, noise, 10, torch.Generator().manual_seed(0))
    assert images.shape == noises.shape == (10, STORED, STORED)
    left = images.expm1() - noises
    assert bool((left[:5].amax((1, 2)) > 99).all())
    torch.testing.assert_close(left[left < 50], torch.zeros_like(left[left < 50]), rtol=0, atol=1e-5)


def test_learns_to_predict_the_noise(folder: Path, tmp_path: Path) -> None:
    recipe = DenoiserRecipe(untrained(3), folder, 10)
    assert (len(recipe.training["image"]), len(recipe.held_out["image"])) == (9 * 12, 12)
    config = LoopConfig(
        tmp_path, 60, 8, workers=0, validate_every=60, ema_decay=0.0, quiet=True, log_every=10
    )
    fit(recipe, config)
    network = DnCNN.from_pretrained(tmp_path / "best.safetensors")
    assert (network.depth, network.training) == (3, False)
    noisy, clean = simulate_pair("through-wall", 7, 3, 15.0)
    denoiser = MapDenoiser.from_pretrained(tmp_path / "best.safetensors")
    assert denoiser.scale == "floor"
    with torch.no_grad():
        found = denoiser(noisy.range_time_mti.float())
    error, before = ((x - clean.range_time_mti).square().mean() for x in (found, noisy.range_time_mti))
    assert float(error) < 0.3 * float(before)


def test_begins_by_doing_nothing(folder: Path) -> None:
    recipe = DenoiserRecipe(untrained(3), folder, 10)
    image = torch.rand(1, 1, 9, 9)
    assert torch.equal(recipe.net(image), image)
    with torch.no_grad():
        assert recipe.validate(recipe.net.eval())["gain_db"] == pytest.approx(0.0, abs=1e-6)


def test_a_sample_depends_on_its_number_only(folder: Path) -> None:
    one, other = DenoiserRecipe(untrained(2), folder, 10), DenoiserRecipe(untrained(2), folder, 10)
    other.sample(3)
    for name, patch in one.sample(99).items():
        assert patch.shape == (1, TRAINED, TRAINED)
        assert torch.equal(patch, other.sample(99)[name])


def test_patch_and_noise_are_cut_and_mirrored_alike(folder: Path) -> None:
    recipe = DenoiserRecipe(untrained(2), folder, 10)
    recipe.training["noise"] = recipe.training["image"]
    turned = 0
    for index in range(20):
        image, noise = recipe.sample(index).values()
        assert torch.equal(image, noise)
        windows = recipe.training["image"].unfold(1, TRAINED, 1).unfold(2, TRAINED, 1)
        turned += not bool((windows == image[0]).flatten(-2).all(-1).any())
    assert turned > 5


def test_a_training_does_not_go_on_with_other_patches(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "pairs"
    shutil.copytree(folder, other)
    same = DenoiserRecipe(untrained(2), other, 10).settings
    assert same == DenoiserRecipe(untrained(2), folder, 10).settings
    for made in ({"seed": 1, "per_map": 6}, {"seed": 0, "per_map": 7}):
        (other / "settings.json").write_text(json.dumps(made))
        assert DenoiserRecipe(untrained(2), other, 10).settings != same
    (other / "settings.json").unlink()
    with pytest.raises(TensorsimError, match=r"settings.json: got a file that cannot be read as settings"):
        DenoiserRecipe(untrained(2), other, 10)


def test_every_activity_is_held_out(tmp_path: Path) -> None:
    for clip in range(12 * 11):
        patch = torch.full((1, 2, 2), float(clip % 12))
        save_file({"image": patch, "noise": patch.clone()}, tmp_path / f"free-space-{clip:05d}.safetensors")
    (tmp_path / "settings.json").write_text('{"seed": 0}')
    recipe = DenoiserRecipe(untrained(2), tmp_path, 12 * 11)
    assert recipe.held_out["image"][:, 0, 0].sort().values.tolist() == list(range(12))
    assert recipe.training["image"][:, 0, 0].unique().tolist() == list(range(12))


def test_validation_is_in_single_precision(folder: Path) -> None:
    recipe = DenoiserRecipe(untrained(3), folder, 10)
    nn.init.normal_(recipe.net.model[-1].weight, std=0.1)  # type: ignore[index,union-attr]
    image, noise = (recipe.held_out[name][::4].float().unsqueeze(1) for name in ("image", "noise"))
    with torch.no_grad():
        error = image - recipe.net.eval()(image) - noise
        figures = recipe.validate(recipe.net)
    expected = -10 * float((error.square().sum() / noise.square().sum()).log10())
    assert figures["gain_db"] == pytest.approx(expected, abs=1e-5)


def test_loss_is_half_the_error_of_the_residual(folder: Path) -> None:
    recipe = DenoiserRecipe(untrained(2), folder, 10)
    nn.init.normal_(recipe.net.model[-1].weight)  # type: ignore[index,union-attr]
    sample = {name: patch[None] for name, patch in recipe.sample(0).items()}
    residual = recipe.net.noise(sample["image"]) - sample["noise"]  # type: ignore[operator]
    losses = recipe.loss(recipe.net, sample)
    torch.testing.assert_close(losses["loss"], residual.square().mean() / 2)
    expected = -10 * (residual.square().mean() / sample["noise"].square().mean()).log10()
    torch.testing.assert_close(losses["gain_db"], expected)


def test_goes_on_and_refuses(folder: Path, tmp_path: Path) -> None:
    path = folder / "through-wall-00003.safetensors"
    before, content = path.stat().st_mtime_ns, path.read_bytes()
    build_pairs(folder, 10, per_map=6, scenes=("through-wall",), quiet=True)
    assert path.stat().st_mtime_ns == before
    path.unlink()
    build_pairs(folder, 10, per_map=6, scenes=("through-wall",), quiet=True)
    assert path.read_bytes() == content
    with pytest.raises(TensorsimError, match=r"got maps of .*'seed': 0.*expected .*'seed': 1"):
        build_pairs(folder, 10, seed=1, per_map=6, scenes=("through-wall",), quiet=True)
    with pytest.raises(TensorsimError, match="got 9 files of patches"):
        DenoiserRecipe(untrained(2), folder, 9)
    with pytest.raises(TensorsimError, match="got 0 files of patches, expected at least 10"):
        DenoiserRecipe(untrained(2), tmp_path, 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clips": 9}, "--clips: got 9, expected at least 10"),
        ({"depth": 1}, "depth: got 1"),
        ({"init": Path("none.safetensors")}, "none.safetensors: no such file"),
        ({"maps_seed": -1}, "--maps-seed: got -1"),
    ],
)
def test_bad_options_are_refused_before_maps_are_made(
    options: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(TensorsimError, match=message):
        TrainDenoiser(tmp_path / "maps", out=tmp_path / "out", quiet=True, **options).run()  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


# ---- scores ----------------------------------------------------------------------------------------------


def test_ridge_error_is_a_speed() -> None:
    clean = torch.full((32, 6), 0.001)
    clean[10] = 1.0
    clean[10, 5] = 0.01  # too weak to count
    moved = clean.roll(3, 0)
    speed = torch.arange(32) * 0.25
    assert ridge_error(moved, clean, speed) == pytest.approx(0.75)
    assert ridge_error(clean, clean, speed) == 0


def test_scores_of_a_perfect_map() -> None:
    clean = torch.rand(16, 9) + 0.01
    perfect = scores(clean, clean, torch.arange(16.0))
    assert perfect == [float("inf"), float("inf"), 0.0, 0.0]
    assert torch.tensor(scores(clean, clean, None)).isnan().tolist() == [False, False, True, True]


def test_comparison_tells_a_good_denoiser_from_a_bad_one() -> None:
    kept: list[Tensor] = []

    def spoil(maps: Tensor) -> Tensor:
        kept.append(maps)
        return torch.ones_like(maps)

    rows = compare({"none": None, "spoil": spoil}, ("through-wall",), (10.0,), clips=1, seed=1, quiet=True)
    assert set(rows) == {
        ("through-wall", view, 10.0, name)
        for view in ("range_time_mti", "doppler_time")
        for name in ("none", "spoil")
    }
    assert all(len(figures) == len(COLUMNS) for figures in rows.values())
    for view in ("range_time_mti", "doppler_time"):
        good, bad = (rows["through-wall", view, 10.0, name][0] for name in ("none", "spoil"))
        assert good > bad + 10
    assert len(kept) == 2
