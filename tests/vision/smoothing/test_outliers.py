"""Jumps are taken out, fast limbs are not; nothing leaves faster than a body can move."""

import itertools

import pytest
import torch

from tensorsim.vision.smoothing.outliers import limit_speed, reachable_chain, without_jumps

FPS = 30.0


def test_a_jump_is_taken_out_and_a_kick_stays() -> None:
    t = torch.arange(60) / FPS
    kick = torch.stack([0 * t, 0.5 * (2 * torch.pi * 3.0 * t).sin(), 0 * t], dim=-1)[:, None]  # up to 9.4 m/s
    valid = torch.ones(60, 1, dtype=torch.bool)
    assert bool(without_jumps(kick, valid, FPS, 12.0).all())
    jumped = kick.clone()
    jumped[20:23, 0, 0] += 2.0
    jumped[40, 0, 1] = 34000.0
    expected = valid.clone()
    expected[20:23] = expected[40] = False
    assert torch.equal(without_jumps(jumped, valid, FPS, 12.0), expected)


def test_after_a_long_gap_a_joint_may_be_anywhere() -> None:
    x = torch.zeros(60, 1, 3)
    x[40:, 0, 1] = 30.0
    valid = torch.ones(60, 1, dtype=torch.bool)
    kept = without_jumps(x, valid, FPS, 12.0)
    assert torch.equal(torch.nonzero(~kept)[:, 0], torch.arange(40, 55)), (
        "at once it may not: that takes half a second"
    )
    valid[22:40] = False
    assert torch.equal(without_jumps(x, valid, FPS, 12.0), valid)


def test_the_chain_is_the_longest_of_all() -> None:
    """Against every subset of the frames."""
    generator = torch.Generator().manual_seed(0)
    positions = 0.6 * torch.randn(6, 8, 3, generator=generator)
    valid = torch.rand(6, 8, generator=generator) < 0.8
    chain = reachable_chain(positions, valid, FPS, 12.0, reach_s=8 / FPS)
    for n in range(6):
        seen = [int(t) for t in torch.nonzero(valid[n])]

        def possible(frames: tuple[int, ...], n: int = n) -> bool:
            steps = itertools.pairwise(frames)
            return all(float((positions[n, b] - positions[n, a]).norm()) <= 0.4 * (b - a) for a, b in steps)

        longest = max(k for k in range(9) for c in itertools.combinations(seen, k) if possible(c))
        kept = tuple(int(t) for t in torch.nonzero(chain[n]))
        assert possible(kept)
        assert len(kept) == longest
    assert not bool((chain & ~valid).any())


def test_a_point_at_just_the_top_speed_is_believed() -> None:
    positions = torch.zeros(1, 12, 3)
    positions[..., 1] = 2.0 * torch.arange(12)  # exactly 2 m a frame
    valid = torch.ones(1, 12, dtype=torch.bool)
    assert reachable_chain(positions, valid, 1.0, 2.0, reach_s=20.0).all()
    assert reachable_chain(positions, valid, 1.0, 1.99, reach_s=20.0).sum() == 1


def test_nobody_and_nothing_seen() -> None:
    assert (
        without_jumps(torch.zeros(0, 5, 14, 3), torch.zeros(0, 5, 14, dtype=torch.bool), FPS, 12.0).shape[0]
        == 0
    )
    assert not bool(without_jumps(torch.zeros(5, 2, 3), torch.zeros(5, 2, dtype=torch.bool), FPS, 12.0).any())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_speed_limit(dtype: torch.dtype) -> None:
    joints = torch.randn(2, 40, 3, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)
    limited = limit_speed(joints, FPS, 12.0)
    assert float(limited.diff(dim=1).norm(dim=-1).max()) * FPS <= 12.0 * (1 + 1e-5)
    slow = 0.1 * joints
    torch.testing.assert_close(limit_speed(slow, FPS, 100.0), slow)


def test_both_script() -> None:
    joints = torch.randn(2, 20, 3, 3, generator=torch.Generator().manual_seed(2))
    valid = torch.ones(2, 20, 3, dtype=torch.bool)
    assert torch.equal(
        torch.jit.script(without_jumps)(joints, valid, FPS, 12.0), without_jumps(joints, valid, FPS, 12.0)
    )
    torch.testing.assert_close(
        torch.jit.script(limit_speed)(joints, FPS, 12.0), limit_speed(joints, FPS, 12.0)
    )
