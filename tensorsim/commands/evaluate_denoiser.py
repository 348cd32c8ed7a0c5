"""``tensorsim evaluate denoiser``: the gain of a denoiser on maps of unseen people, compared with other methods."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensorsim.commands.arguments import Option, Several
from tensorsim.exceptions import TensorsimError, check_count, check_distinct, check_seed
from tensorsim.files import write_text


@dataclass(frozen=True)
class EvaluateDenoiser:
    """Print PSNR and the errors of ridges and envelope, before and after denoising, for each kind of map and each
    denoiser."""

    weights: Path
    """DnCNN weights (.safetensors, .pth)."""
    against: Several[Path] = ()
    """Further DnCNN weights to compare with, such as dncnn_gray_blind.pth."""
    clips: int = 11
    """Clips per scene, cycling through the activities from S2."""
    scenes: tuple[Literal["free-space", "through-wall"], ...] = ("free-space", "through-wall")
    """Scenes to evaluate on."""
    snr: tuple[float, ...] = (10.0,)
    """Signal-to-noise ratios in dB."""
    seed: int = 1
    """Random seed for people, motion and noise; use one that was not trained on."""
    ksvd: bool = True
    """Include K-SVD, which takes about a minute per map."""
    out: Option[Path] = None
    """CSV file for the table."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.enhance.dncnn import MapDenoiser
        from tensorsim.enhance.ksvd import KSVD
        from tensorsim.enhance.perona_malik import PeronaMalik
        from tensorsim.training.classifier import check_ratios
        from tensorsim.training.denoiser_scores import COLUMNS, Denoisers, compare

        check_seed(self.seed, "--seed")
        check_count(self.clips, "--clips")
        check_count(len(self.scenes), "--scenes")
        check_distinct(self.scenes, "--scenes")
        check_ratios(self.snr, "--snr")
        if self.out is not None and (self.out.is_dir() or not self.out.parent.is_dir()):
            raise TensorsimError(f"--out: got {self.out}, expected a file name in an existing folder")
        rivals: Denoisers = {"none": None}
        rivals |= {str(path): MapDenoiser.from_pretrained(path) for path in (self.weights, *self.against)}
        rivals["Perona-Malik"] = MapDenoiser(PeronaMalik())
        if self.ksvd:
            rivals["K-SVD"] = KSVD()
        rows = compare(rivals, self.scenes, self.snr, self.clips, self.seed, self.quiet)
        print(
            f"{'scene':13s} {'map':30s} {'SNR':>4s} {'denoiser':24s}" + "".join(f"{c:>18s}" for c in COLUMNS)
        )
        for (scene, view, ratio, name), figures in rows.items():
            numbers = "".join(f"{x:18.3f}" for x in figures)
            print(f"{scene:13s} {view:30s} {ratio:4.0f} {name:24s}{numbers}")
        if self.out is not None:
            lines = [",".join(["scene", "map", "snr_db", "denoiser", *COLUMNS])]
            lines += [
                ",".join([*map(str, key), *(f"{x:.4f}" for x in figures)]) for key, figures in rows.items()
            ]
            write_text(self.out, "\n".join(lines) + "\n")
