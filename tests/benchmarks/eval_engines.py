"""Keypoints and maps of ``simulate`` by engine, against torch: ``python -m tests.benchmarks.eval_engines [FILM ...]``.

On a rendered film of somebody who walks, and on the films given. Prints by how many pixels keypoints with a score of
0.3 or more are off, and by how many decibels the energy of the Doppler-time map and its cells within 40 dB of the peak.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from tensorsim import cli
from tensorsim.commands.demo import FILM_FPS, film_person
from tensorsim.data.video_writer import write_video

Arrays = dict[str, np.ndarray]


def simulated(film: Path, engine: str, out: Path) -> tuple[Arrays, Arrays]:
    """Arrays of ``pose.npz`` and ``maps.npz``."""
    options = ["--engine", engine, "--device", "cpu", "--classifier", "none", "--quiet"]
    cli.main(["simulate", str(film), "--out", str(out), *options])
    return dict(np.load(out / "pose.npz")), dict(np.load(out / "maps.npz"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("films", type=Path, nargs="*")
    parser.add_argument("--engines", nargs="+", default=["onnxruntime", "openvino", "int8"])
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        walk = Path(folder) / "rendered_walk.mp4"
        write_video(walk, film_person(7, 60, seed=3).film.frames.permute(0, 2, 3, 1).numpy(), FILM_FPS)
        for number, film in enumerate([walk, *options.films]):
            people, truth = simulated(film, "torch", Path(folder) / f"{number} torch")
            seen = (people["keypoint_scores"] >= 0.3) & people["valid"][..., None]
            shown = truth["doppler_time"] > 1e-2 * truth["doppler_time"].max()
            for engine in options.engines:
                found, maps = simulated(film, engine, Path(folder) / f"{number} {engine}")
                away = np.linalg.norm(found["keypoints_px"] - people["keypoints_px"], axis=-1)[seen]
                ratio = maps["doppler_time"][shown] / truth["doppler_time"][shown]
                cells = np.abs(20 * np.log10(np.maximum(ratio, 1e-6))).mean()
                energy = [np.square(m["doppler_time"], dtype=np.float64).sum() for m in (maps, truth)]
                decibels = abs(10 * np.log10(energy[0] / energy[1]))
                pixels = " | ".join(f"{np.quantile(away, share):.3f}" for share in (0.5, 0.95, 0.98))
                rows.append(f"| {film.stem} | {engine} | {pixels} | {decibels:.3f} | {cells:.2f} |")
    print("| film | engine | median px | 95 % below | 98 % below | energy dB | cells dB |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
