import pytest
import torch

from tensorsim.config import SimulationConfig
from tensorsim.enhance.choice import map_denoiser
from tensorsim.enhance.dncnn import MapDenoiser
from tensorsim.enhance.ksvd import KSVD, ksvd_denoise
from tensorsim.errors import TensorsimError
from tensorsim.pipeline import PoseToDoppler


def noisy_map() -> tuple[torch.Tensor, torch.Tensor]:
    clean = torch.zeros(16, 24)
    clean[6:9] = torch.linspace(2.0, 5.0, 24)
    noise = torch.randn(2, 16, 24, generator=torch.Generator().manual_seed(0))
    return torch.sqrt((clean + 0.3 * noise[0]).square() + (0.3 * noise[1]).square()), clean


@pytest.mark.parametrize("name", ["perona-malik", "ksvd", "dncnn", "dncnn-radar-maps"])
def test_every_choice_takes_noise_away(name: str) -> None:
    maps, clean = noisy_map()
    denoiser = map_denoiser(name)
    assert denoiser is not None
    with torch.no_grad():
        found = denoiser(maps)
    assert found.shape == maps.shape
    assert float((found - clean).square().mean()) < float((maps - clean).square().mean())


def test_none_and_unknown() -> None:
    assert map_denoiser("none") is None
    assert map_denoiser(None) is None
    with pytest.raises(TensorsimError, match="got 'dnccn'"):
        map_denoiser("dnccn")


def test_configuration_takes_the_names() -> None:
    for name, kind in (("perona-malik", MapDenoiser), ("ksvd", KSVD)):
        config = SimulationConfig.through_wall().replace(processing__denoiser=name)
        assert isinstance(PoseToDoppler.from_config(config).denoiser, kind)
    assert not PoseToDoppler.from_config(SimulationConfig().replace(processing__denoiser="none")).denoises


def test_ksvd_keeps_the_scale_and_each_map_apart() -> None:
    maps, _ = noisy_map()
    both = KSVD()(torch.stack([maps, 100 * maps + 7]))
    assert torch.allclose(both[1], 100 * both[0] + 7, atol=0.5)
    low, high = maps.min(), maps.max()
    expected = ksvd_denoise((maps - low) / (high - low)).clamp_min(0) * (high - low) + low
    assert torch.equal(both[0], expected)
    assert torch.equal(KSVD()(torch.ones(9, 9)), torch.ones(9, 9))
