"""Values in frames in which a person is absent do not matter, and the change leaves no echo."""

import pytest
import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.errors import TensorsimError
from tensorsim.motion.absence import continued

FPS, FRAMES = 30.0, 60


def approaching() -> tuple[Tensor, Tensor]:
    """A person (1, 1, T, 14, 3) who glides towards the radar at 0.5 m/s, present in frames 10 to 34 (1, 1, T)."""
    body = (
        ts.motion.ActivityGenerator().generate("rotating", seed=0, duration_s=0.1, rate_hz=FPS).joints[0, 0]
    )
    body = body.double() - body.double().mean(0)
    time_s = torch.arange(FRAMES).double() / FPS
    way = torch.stack([0 * time_s, 5 - 0.5 * time_s, 0 * time_s], dim=-1)
    valid = torch.zeros(1, 1, FRAMES, dtype=torch.bool)
    valid[..., 10:35] = True
    return (body + way[:, None])[None, None], valid


def test_motion_goes_on_at_its_velocity() -> None:
    joints, valid = approaching()
    found = continued(torch.where(valid[..., None, None], joints, torch.nan), valid)
    assert torch.equal(found[valid], joints[valid])
    step = found.diff(dim=2)[..., 1]
    there = torch.full_like(step[0, 0, 0], -0.5 / FPS)
    assert torch.allclose(step[0, 0, 9], there, rtol=0.1)
    assert torch.allclose(step[0, 0, 34], there, rtol=0.1)
    assert float(step.abs().max()) <= 0.5 / FPS + 1e-12, "nobody gets faster"
    assert float(found.diff(dim=2, n=2).abs().max()) < 0.2 * 0.5 / FPS


def test_a_gap_leads_from_one_run_into_the_next() -> None:
    joints, valid = approaching()
    valid[..., 18:27] = False
    found = continued(joints * valid[..., None, None], valid)
    assert torch.allclose(found[:, :, 10:35], joints[:, :, 10:35], atol=0.02)


def test_without_neighbours() -> None:
    joints, valid = approaching()
    nobody = torch.zeros_like(valid)
    assert torch.equal(continued(joints, nobody), torch.zeros_like(joints))
    nobody[..., 20] = True
    assert torch.equal(continued(joints, nobody), joints[:, :, 20:21].expand_as(joints))
    assert continued(joints, torch.ones_like(valid)) is joints


def test_scripted_and_batched() -> None:
    joints, valid = approaching()
    scripted = torch.jit.script(continued)
    assert torch.equal(scripted(joints, valid), continued(joints, valid))
    both = continued(torch.cat([joints, joints + 1]), torch.cat([valid, valid.roll(5, -1)]))
    assert torch.allclose(both[0], continued(joints, valid)[0])
    assert torch.allclose(both[1], continued(joints + 1, valid.roll(5, -1))[0])


def test_gradients() -> None:
    joints, valid = (x[:, :, 8:14] for x in approaching())
    assert torch.autograd.gradcheck(
        lambda x: continued(x, valid), (joints[..., :2, :].clone().requires_grad_(),)
    )


def test_wrong_validity_is_refused() -> None:
    joints, valid = approaching()
    with pytest.raises(TensorsimError, match=r"valid: got torch.int64 of shape \[1, 1, 60\], expected bool"):
        continued(joints, valid.long())


def test_maps_do_not_depend_on_absent_frames() -> None:
    """Zeros there, as in files, gave a flash over all Doppler bins while the person leaves."""
    joints, valid = approaching()
    chain = ts.PoseToDoppler.from_config(
        ts.SimulationConfig().replace(scene__snr_db=None, scene__radar__prf_hz=2048.0)
    )
    with torch.no_grad():
        maps = [
            chain.doppler_time(torch.where(valid[..., None, None], joints, x), valid, FPS) for x in (0.0, 9.0)
        ]
        truth = chain.doppler_time(joints, valid, FPS)
    assert torch.equal(*maps)
    assert torch.allclose(maps[0], truth, atol=2e-3 * float(truth.max()))
    radar = chain.simulator
    speed = radar.doppler.doppler_hz * radar.radar.doppler_wavelength_m / 2
    power = maps[0][0].double().square()
    assert float(power[speed.abs() > 1.0].sum()) < 1e-4 * float(power.sum())
