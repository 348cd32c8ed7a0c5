"""The shipped classifier on maps of other pulse rates: ``python -m tests.benchmarks.eval_prf [--people N]``.

Generated people do eleven activities (all but that of an empty room) behind the wall, seen at several pulse rates, and
at 128 Hz with both signs of Doppler folded into one, as a radar without range and with one channel sees them, and
while another radar is heard. Prints the accuracy on their true motion at 50 dB.
"""

import argparse

import torch
from torch import Tensor
from tqdm import tqdm

from tensorsim import ACTIVITIES, PoseToDoppler, SimulationConfig
from tensorsim.config import InterferenceConfig
from tensorsim.motion import ActivityGenerator
from tensorsim.recognition import ActivityRecognizer
from tensorsim.types import RadarMaps

PRF_HZ = (128.0, 192.0, 256.0, 512.0)
HZ, SECONDS, SEED = 30.0, 4.0, 7000


def folded(doppler_time: Tensor) -> Tensor:
    """Maps (..., F, K) in which each Doppler frequency has the power of both signs."""
    power = doppler_time.square()
    # The first bin is -PRF / 2, which has no other sign.
    other = torch.cat([power[..., :1, :], power[..., 1:, :].flip(-2)], -2)
    return (power + other).sqrt()


def accuracy(config: SimulationConfig, people: dict[int, Tensor], fold: bool = False) -> float:
    """Share of people (N, T, 14, 3) by index of activity whose maps get the right label."""
    chain = PoseToDoppler.from_config(config)
    recognizer = ActivityRecognizer.from_pretrained(config.scene.radar).eval()
    right = []
    for label, joints in tqdm(people.items(), f"{config.scene.radar.prf_hz:g} Hz", leave=False):
        out = chain(joints[:, None], torch.ones(len(joints), 1, joints.shape[1], dtype=torch.bool), HZ)
        maps = RadarMaps(*(getattr(out, name) for name in RadarMaps._fields))
        if fold:
            maps = maps._replace(doppler_time=folded(maps.doppler_time))
        right.append((recognizer(maps).argmax(-1) == label).float().mean())
    return float(torch.stack(right).mean())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--people", type=int, default=4, help="people for each activity")
    count = parser.parse_args().people
    torch.set_grad_enabled(False)
    generator = ActivityGenerator()
    people = {
        label: generator.generate(name, count, SEED, SECONDS, HZ).joints.float()
        for label, name in enumerate(ACTIVITIES)
        if label > 0
    }
    base = SimulationConfig.through_wall()
    for prf_hz in PRF_HZ:
        config = base.replace(scene__radar__prf_hz=prf_hz)
        limit = config.scene.radar.unambiguous_speed_m_s
        print(f"{prf_hz:g} Hz, to {limit:.1f} m/s: {100 * accuracy(config, people):.1f} %", flush=True)
    print(f"128 Hz, folded: {100 * accuracy(base, people, fold=True):.1f} %")
    heard = base.replace(scene__interference=InterferenceConfig())
    print(f"128 Hz, another radar heard: {100 * accuracy(heard, people):.1f} %")


if __name__ == "__main__":
    main()
