"""Gait parameters in noise, measured beside simulated: ``python -m tests.benchmarks.eval_gait [--walks N]``.

:class:`~tensorsim.radar.GaitEstimator` reads torso speed, limbs over torso and strides per second from 24 GHz
continuous-wave signals to which white noise is added at 0 to 40 dB below their mean power: recordings of a walk and a
run, and generated walks towards the radar with the scatterers of ``--body surface`` and ``joints``. Last come
bursts (``kmkim_cw24_iq``), too few per second for steps: the speed of 95 % of the power over that of the torso.
"""

import argparse

import numpy as np
import torch
from torch import Tensor

from tensorsim.radar import DopplerTimeMap, GaitEstimator
from tests.benchmarks import eval_bodies

SNR_DB = (None, 40.0, 30.0, 20.0, 10.0, 0.0)


def recording(name: str) -> tuple[Tensor, float]:
    """Signal (M,) complex128 and samples per second of a recording."""
    from scipy.io import wavfile
    from scipy.signal import decimate

    rate, signal = wavfile.read(eval_bodies.DATA / "radar" / f"cw24ghz_{name}.wav")
    signal = decimate(decimate(signal - signal.mean(), 3, ftype="fir"), 5, ftype="fir")
    return torch.from_numpy(signal + 0j), rate / 15


def gait(signal: Tensor, rate_hz: float, snr_db: float | None) -> list[float]:
    """Torso m/s, limbs over torso and strides per second of a signal (M,) with noise."""
    signal = signal.to(torch.complex128)
    if snr_db is not None:
        power = float(signal.abs().square().mean()) * 10 ** (-snr_db / 10)
        signal = signal + power**0.5 * torch.randn(
            len(signal), dtype=torch.complex128, generator=torch.Generator().manual_seed(0)
        )
    radar = eval_bodies.RadarConfig(carrier_hz=eval_bodies.CW.carrier_hz, bandwidth_hz=1e6, prf_hz=rate_hz)
    doppler = DopplerTimeMap(radar, window_s=0.15)
    speed = doppler.doppler_hz * radar.doppler_wavelength_m / 2
    found = GaitEstimator(speed, doppler.frame_rate_hz)(doppler(signal[:, None]))
    torso = max(float(found.torso_m_s), 1e-9)
    return [torso, float(found.limb_m_s) / torso, float(found.step_hz) / 2]


def walks(body: str, count: int) -> list[Tensor]:
    """Signals of generated walks towards the radar."""
    scatterers = eval_bodies.make_body(body, eval_bodies.CW)
    joints = eval_bodies.generated_walks(count, 0, 3.5)
    return [eval_bodies.simulated_wave(scatterers, motion) for motion in joints]


def line(name: str, rows: list[list[float]]) -> str:
    """Means over signals."""
    return f"  {name:28s}" + "".join(f"{x:10.2f}" for x in np.mean(rows, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--walks", type=int, default=6, help="generated walks of each body")
    count = parser.parse_args().walks
    torch.set_grad_enabled(False)
    rate_hz = eval_bodies.CW.prf_hz
    signals = {
        "measured walking": [recording("walking")],
        "measured running": [recording("running")],
        "simulated walking, surface": [(wave, rate_hz) for wave in walks("surface", count)],
        "simulated walking, joints": [(wave, rate_hz) for wave in walks("joints", count)],
    }
    print(f"  {'':28s}{'torso m/s':>10s}{'limbs':>10s}{'strides':>10s}")
    for snr_db in SNR_DB:
        print("no noise added" if snr_db is None else f"{snr_db:g} dB")
        for name, pairs in signals.items():
            print(line(name, [gait(*pair, snr_db) for pair in pairs]), flush=True)
    print("bursts, speed of 95 % of the power over the torso's")
    for style in ("walk", "run"):
        print(f"  {'measured ' + style:28s}{eval_bodies.measured_bursts(style).speed_95:20.2f}")
    bursts = [wave.unfold(0, 128, round(eval_bodies.BURST_S * rate_hz)) for wave in walks("surface", count)]
    found = [eval_bodies.speed_shares(*eval_bodies.burst_map(b), noisy=False).speed_95 for b in bursts]
    print(f"  {'simulated walk, surface':28s}{np.mean(found):20.2f}")


if __name__ == "__main__":
    main()
