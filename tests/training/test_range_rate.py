"""Training of the network that corrects speeds along the line of sight: what is missing, clips, a run."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import mid_hips
from tensorsim.cli import main
from tensorsim.commands.train_range_rate import TrainRangeRate
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.training.range_rate import (
    STEPS,
    Clips,
    RangeRateRecipe,
    build_clips,
    missing_speed,
)
from tensorsim.vision.lifting.range_rate import FEATURES, RATE_HZ, RangeRate, RangeRateNet

FPS = 30.0
CAMERAS = (
    torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64),
    torch.tensor([0.3, 0.2, 1.0], dtype=torch.float64),
)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of one group of clips."""
    path = tmp_path_factory.mktemp("range_rate") / "one" / "clips.safetensors"
    build_clips(path, 1, seed=3, quiet=True)
    return path


def walker() -> Tensor:
    """Joints (T, 14, 3) of a generated person who walks away."""
    joints = ActivityGenerator().generate("walking", seed=3, duration_s=4.0, rate_hz=FPS).joints[0].double()
    return joints + torch.tensor([1.0, 3.0, 0.0], dtype=torch.float64)


def test_missing_speed_is_that_of_the_error_whatever_the_scale() -> None:
    """Hips found at 1.1 times the distance from another camera, with an error whose rate is known."""
    time = torch.arange(120, dtype=torch.float64) / FPS
    distance = 4.0 + 0.5 * time
    error = 0.1 * torch.sin(3 * time)
    ahead = F.normalize(torch.tensor([0.6, 0.8], dtype=torch.float64), dim=0)
    true, found = (
        F.pad(camera[:2] + how_far[:, None] * ahead, [0, 1])[None]
        for camera, how_far in zip(CAMERAS, (distance, 1.1 * distance + error - error.median()), strict=True)
    )
    valid = torch.ones(1, 120, dtype=torch.bool)
    missing = missing_speed(true, found, valid, CAMERAS, FPS)
    between = (torch.arange(missing.shape[1], dtype=torch.float64) + 0.5) / RATE_HZ
    torch.testing.assert_close(missing[0], -0.3 * torch.cos(3 * between), atol=0.02, rtol=0)


def test_who_adds_what_is_missing_gets_the_true_speed() -> None:
    """The stage with a network that knows the answer: signs and times of both fit together."""

    class Answer(nn.Module):
        def __init__(self, missing: Tensor) -> None:
            super().__init__()
            self.register_buffer("mean", torch.zeros(FEATURES))
            self.missing, self.reach = missing, 0

        def forward(self, features: Tensor) -> Tensor:
            return self.missing

    true = walker()
    time = torch.arange(len(true), dtype=torch.float64) / FPS
    ahead = F.normalize(mid_hips(true)[:, :2] - CAMERAS[0][:2], dim=-1)
    wrong = true + F.pad(0.1 * torch.sin(4 * time)[:, None] * ahead, [0, 1])[:, None]
    there = torch.ones(len(true), dtype=torch.bool)
    seen = there[:, None].expand(-1, 14)
    cameras = (CAMERAS[0], CAMERAS[0])
    missing = missing_speed(mid_hips(true)[None], mid_hips(wrong)[None], there[None], cameras, FPS)
    stage = RangeRate(Answer(missing), level_s=100.0)  # type: ignore[arg-type]
    right = stage(wrong, seen, there, CAMERAS[0], FPS)
    before, after = (
        float((mid_hips(joints) - mid_hips(true)).norm(dim=-1).diff().square().mean().sqrt()) * FPS
        for joints in (wrong, right)
    )
    assert before > 0.2
    assert after < 0.1 * before


def test_clips_are_kept_in_a_file(file: Path) -> None:
    clips = build_clips(file, 1, seed=3, quiet=True)
    assert clips.features.shape == (88, STEPS, FEATURES)
    assert bool(clips.features.isfinite().all())
    tracked = clips.weight > 0
    assert 0.5 < float(tracked.float().mean()) < 1.0
    # The pipeline is right to some tenths of a metre per second.
    assert 0.05 < float(clips.missing[tracked].square().mean().sqrt()) < 0.5
    # A frame in which somebody is tracked is one in which the network is told so.
    assert bool((clips.features[..., -1][tracked] > 0.98).all())
    with pytest.raises(TensorsimError, match="got clips of"):
        build_clips(file, 1, seed=3, held_out=True, quiet=True)


def test_a_network_learns_what_can_be_known() -> None:
    """Of an error that is half of a speed that the network sees, most disappears."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(40, STEPS, FEATURES, generator=generator)
    missing = -0.5 * features[..., 85]
    clips = Clips(features.half(), missing, torch.ones(40, STEPS))
    torch.manual_seed(0)
    recipe = RangeRateRecipe(RangeRateNet(16, (1, 2)), clips, clips, learning_rate=1e-2)
    optimiser = recipe.optimiser()
    for step in range(150):
        batch = recipe.collate([recipe.sample(8 * step + k) for k in range(8)])
        loss = recipe.loss(recipe.net, batch)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        scores = recipe.validate(recipe.net)
    assert scores["before_m_s"] == pytest.approx(0.5, abs=0.05)
    assert scores["after_m_s"] < 0.4 * scores["before_m_s"]
    assert scores["score"] == -scores["after_m_s"]
    assert recipe.rate(0, 1000) < recipe.rate(300, 1000) > recipe.rate(999, 1000) > 0


def test_untracked_frames_do_not_count() -> None:
    generator = torch.Generator().manual_seed(0)
    weight = (torch.rand(20, STEPS, generator=generator) > 0.5).float()
    missing = torch.where(weight > 0, 0.2, 1e3)
    clips = Clips(torch.randn(20, STEPS, FEATURES, generator=generator).half(), missing, weight)
    recipe = RangeRateRecipe(RangeRateNet(8, (1,)), clips, clips)
    loss = recipe.loss(recipe.net, recipe.collate([recipe.sample(k) for k in range(4)]))["loss"]
    assert float(loss.detach()) == pytest.approx(0.2**2 / 2)
    with torch.no_grad():
        assert recipe.validate(recipe.net)["before_m_s"] == pytest.approx(0.2)


def test_a_run_from_the_command_line(file: Path) -> None:
    out = file.parent
    arguments = [
        "train",
        "range-rate",
        "--out",
        str(out),
        "--groups",
        "1",
        "--clips-seed",
        "3",
        "--steps",
        "2",
    ]
    arguments += ["--batch", "4", "--channels", "8", "--workers", "0", "--quiet"]
    main(arguments)
    stage = RangeRate.from_pretrained(out / "best.safetensors")
    assert stage.network.deviation.min() > 0
    main(arguments)  # nothing is left to train
    torch.testing.assert_close(
        RangeRate.from_pretrained(out / "best.safetensors").network.mean, stage.network.mean
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"groups": 0}, "--groups: got 0, expected at least 1"),
        ({"channels": 4}, "--channels: got 4, expected at least 8"),
        ({"clips_seed": -1}, "--clips-seed"),
        ({"steps": 0}, "steps: got 0"),
        ({"learning_rate": 0.0}, "--learning-rate: got 0.0"),
    ],
)
def test_the_command_refuses_before_anything_is_made(options: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=message):
        TrainRangeRate(out=tmp_path / "out", quiet=True, **options).run()
    assert not list(tmp_path.iterdir())
