from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.config import JOINT_RCS_M2, RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.motion.scatterers import JointScatterers, visibility_fade
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.stage import StageTester, assert_same


class TestJointScatterers(StageTester):
    gradient_arguments = (0, 1)
    batched_arguments = (0, 1)

    def make(self) -> nn.Module:
        return JointScatterers((0.5, 1.0, 0.2))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        positions = torch.randn((*batch, 2, 5, 3, 3), generator=generator, dtype=torch.float64)
        fade = torch.rand((*batch, 2, 5), generator=generator, dtype=torch.float64)
        return positions.to(dtype), fade.to(dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        positions, fade = torch.zeros(2, 5, 3, 3), torch.ones(2, 5)
        return [
            ((positions, fade[:1]), r"fade: got shape \[1, 5\], expected \(\.\.\., P, M\) \[2, 5\]"),
            ((positions[:, :4], fade), r"fade: got shape \[2, 5\]"),
            ((positions[..., :2, :], fade), r"positions: got shape \[2, 5, 2, 3\], expected .* 3, 3\)"),
            ((positions[..., :2], fade), r"positions: got shape \[2, 5, 3, 2\]"),
            ((positions[0], fade[0]), r"positions: got shape \[5, 3, 3\]"),
            ((positions, fade > 0), r"fade: got dtype"),
            ((positions.int(), fade), r"positions: got dtype"),
        ]


class TestLearnableJointScatterers(TestJointScatterers):
    def make(self) -> nn.Module:
        return JointScatterers((0.5, 1.0, 0.2), learnable=True)


def test_people_of_a_clip_are_one_scene() -> None:
    """Convention: person after person; the cross section goes with the square of the amplitude."""
    positions = torch.arange(2 * 4 * 14 * 3, dtype=torch.float64).reshape(1, 2, 4, 14, 3)
    fade = torch.tensor([1.0, 0.5], dtype=torch.float64).reshape(1, 2, 1).expand(1, 2, 4)
    scene, rcs = JointScatterers()(positions, fade)
    assert scene.shape == (1, 4, 28, 3)
    assert rcs.shape == (1, 4, 28)
    for person in range(2):
        for pulse in range(4):
            for joint in (0, 5, 13):
                assert torch.equal(scene[0, pulse, 14 * person + joint], positions[0, person, pulse, joint])
                expected = JOINT_RCS_M2[joint] * (1.0, 0.25)[person]
                assert float(rcs[0, pulse, 14 * person + joint]) == pytest.approx(expected)


def test_rcs_has_the_dtype_of_the_positions() -> None:
    fade = torch.ones(1, 3, dtype=torch.float64)
    for dtype in (torch.float32, torch.float64):
        assert JointScatterers()(torch.zeros(1, 3, 14, 3, dtype=dtype), fade)[1].dtype == dtype


def test_no_people_are_no_scatterers() -> None:
    scene, rcs = JointScatterers()(torch.zeros(2, 0, 7, 14, 3), torch.zeros(2, 0, 7))
    assert scene.shape == (2, 7, 0, 3)
    assert rcs.shape == (2, 7, 0)
    assert visibility_fade(torch.zeros(2, 0, 30, dtype=torch.bool), 30.0, 100.0, 0, 7).shape == (2, 0, 7)


@pytest.mark.parametrize("rcs", [(), (1.0, -0.1), (float("nan"),), (float("inf"),)])
def test_refuses_impossible_cross_sections(rcs: tuple[float, ...]) -> None:
    with pytest.raises(TensorsimError, match=r"rcs_m2: got .*, expected finite numbers >= 0, one per joint"):
        JointScatterers(rcs)


# ---- the learnable table -------------------------------------------------------------------------------


def test_a_learnable_table_starts_as_given_and_a_fixed_one_has_no_parameter() -> None:
    learnable = JointScatterers(learnable=True)
    torch.testing.assert_close(learnable.table(), torch.tensor(JOINT_RCS_M2, dtype=torch.float64))
    assert list(learnable.state_dict()) == ["log_rcs_m2"]
    assert not JointScatterers().state_dict()
    with pytest.raises(TensorsimError, match="expected numbers > 0 if they are learned"):
        JointScatterers((1.0, 0.0), learnable=True)


def test_gradient_of_the_learnable_table() -> None:
    """sigma = exp(l): the derivative of fade^2 sigma by l is fade^2 sigma, against finite differences too."""
    model = JointScatterers((0.5, 1.0, 0.2), learnable=True)
    positions, fade = torch.zeros(1, 2, 3, 3, dtype=torch.float64), torch.tensor([[1.0, 0.5]]).double()
    rcs = model(positions, fade)[1]
    (gradient,) = torch.autograd.grad(rcs.sum(), model.log_rcs_m2)
    torch.testing.assert_close(gradient, 1.25 * torch.tensor([0.5, 1.0, 0.2]).double())

    def of_table(log_rcs: Tensor) -> Tensor:
        return torch.func.functional_call(model, {"log_rcs_m2": log_rcs}, (positions, fade))[1]

    assert torch.autograd.gradcheck(of_table, (model.log_rcs_m2.detach().clone().requires_grad_(True),))


def test_a_table_is_found_from_its_echo() -> None:
    """Three joints at distances that a small radar resolves; from equal cross sections to the true ones."""
    radar = RadarConfig(carrier_hz=2e9, bandwidth_hz=0.6e9, sample_rate_hz=0.6e6, prf_hz=256.0)
    echo = EchoSynthesizer(radar)
    time = torch.arange(16, dtype=torch.float64).reshape(1, 16, 1) / 16
    distance = torch.tensor([2.0, 3.0, 4.5], dtype=torch.float64) + time * torch.tensor([0.1, -0.2, 0.3])
    positions = torch.stack((0 * distance, distance, 1.0 + 0 * distance), -1)
    fade = torch.ones(1, 16, dtype=torch.float64)
    truth = (0.5, 1.0, 0.1)
    with torch.no_grad():
        target = echo(*JointScatterers(truth)(positions, fade))
    model = JointScatterers((0.3, 0.3, 0.3), learnable=True)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    for _ in range(150):
        optimizer.zero_grad()
        error = (echo(*model(positions, fade)) - target).abs().square().sum() / target.abs().square().sum()
        error.backward()
        optimizer.step()
    np.testing.assert_allclose(model.table().detach().numpy(), truth, rtol=0.01)


# ---- visibility_fade -------------------------------------------------------------------------------------


def mask(text: str) -> Tensor:
    return torch.tensor([c == "#" for c in text])


def reference(valid: Tensor, fps: float, prf: float, pulses: int, fade_s: float) -> np.ndarray:
    """Pulse by pulse, run by run."""
    frames = len(valid)
    runs, start = [], None
    for k in range(frames + 1):
        present = k < frames and bool(valid[k])
        if present and start is None:
            start = k
        if not present and start is not None:
            runs.append((start, k - 1))
            start = None
    out = np.zeros(pulses)
    for first, last in runs:
        begin = -np.inf if first == 0 else first / fps
        end = np.inf if last == frames - 1 else last / fps
        for m in range(pulses):
            t = m / prf
            if begin <= t <= end:
                rise = 0.5 - 0.5 * np.cos(np.pi * min((t - begin) / fade_s, 1))
                fall = 0.5 - 0.5 * np.cos(np.pi * min((end - t) / fade_s, 1))
                out[m] = rise * fall
    return out


@pytest.mark.parametrize(
    "text",
    [
        "##########",
        "..........",
        "...#######",
        "#######...",
        "...####...",
        "####..####",
        "#...#....#",
        ".#.###.#..",
        ".........#",
        "#",
        ".",
    ],
)
def test_fade_equals_the_reference(text: str) -> None:
    valid, fps, prf = mask(text), 10.0, 77.0
    pulses = round(len(text) / fps * prf)
    actual = visibility_fade(valid, fps, prf, 0, pulses, fade_s=0.15)
    np.testing.assert_allclose(actual.numpy(), reference(valid, fps, prf, pulses, 0.15), rtol=0, atol=1e-12)


def test_fade_of_many_people_pieces_and_script() -> None:
    generator = torch.Generator().manual_seed(2)
    valid = torch.rand((2, 3, 40), generator=generator) > 0.3
    whole = visibility_fade(valid, 30.0, 500.0, 0, 660)
    assert whole.shape == (2, 3, 660)
    assert whole.dtype == torch.float64
    pieces = [visibility_fade(valid, 30.0, 500.0, a, b) for a, b in ((0, 1), (1, 300), (300, 660))]
    assert_same(torch.cat(pieces, dim=-1), whole)
    assert_same(visibility_fade(valid[1, 2], 30.0, 500.0, 0, 660), whole[1, 2])
    assert_same(torch.jit.script(visibility_fade)(valid, 30.0, 500.0, 0, 660), whole)


def test_fade_does_not_splash_over_doppler() -> None:
    """The spectrum of a person who appears is 60 dB below the line beyond 150 Hz; a switched one is not."""
    valid = torch.arange(60).ge(20) & torch.arange(60).le(45)
    fps, prf = 30.0, 4096.0
    pulses = round(60 / fps * prf)
    faded = visibility_fade(valid, fps, prf, 0, pulses)
    switched = valid[(torch.arange(pulses) * fps / prf).long()].double()

    def far_from_the_line(envelope: Tensor) -> float:
        spectrum = torch.fft.rfft(envelope).abs()
        frequency = torch.fft.rfftfreq(pulses, 1 / prf)
        return float(20 * torch.log10(spectrum[frequency > 150].max() / spectrum.max()))

    assert far_from_the_line(faded) < -80
    assert far_from_the_line(switched) > -60


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.ones(5), 30.0, 100.0, 0, 5), "valid: got dtype .*, expected bool"),
        ((torch.ones(2, 0, dtype=torch.bool), 30.0, 100.0, 0, 5), "expected .* at least one frame"),
        ((torch.tensor(True), 30.0, 100.0, 0, 5), r"valid: got shape \[\]"),
        ((mask("##"), 0.0, 100.0, 0, 5), "fps: got 0.0"),
        ((mask("##"), 30.0, -1.0, 0, 5), "prf_hz: got -1.0"),
        ((mask("##"), 30.0, 100.0, 3, 2), "got pulses 3 to 2"),
        ((mask("##"), 30.0, 100.0, -3, 2), "got pulses -3 to 2"),
        ((mask("##"), 30.0, 100.0, 0, 2, 0.0), "fade_s: got 0.0"),
    ],
)
def test_fade_refuses(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        visibility_fade(*arguments)
