"""``tensorsim library build``: a pool of poses for nearest-match lifting."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tensorsim.commands.arguments import Option, Several
from tensorsim.exceptions import TensorsimError, check_count, check_seed

#: Suffixes of motion files.
SUFFIXES = (".bvh", ".npz")


@dataclass(frozen=True)
class BuildLibrary:
    """Build a library of poses for lifting, from motion files or from tensorsim's own generator.

    Poses are scaled to one body height and turned to one heading (the lifter turns them to all headings), and the
    mirror image of each is added; of nearly identical poses only one is kept.
    """

    sources: tyro.conf.Positional[Several[Path]] = ()
    """Motion files (.bvh, .npz), folders to search for them, or patterns such as 'mocap/**/*.bvh'."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("pose_library.safetensors")
    """File to write."""
    generate: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Number of generated poses to add, from the activities and the pose sampler."""
    most: Annotated[Option[int], tyro.conf.arg(metavar="N")] = None
    """Maximum number of poses, chosen at random; the lifter needs about 2 KB of memory per pose."""
    tolerance: float = 0.015
    """Poses closer than this are duplicates: root-mean-square distance over the joints, in body heights."""
    seed: int = 0
    """Random seed for the generator and the choice of poses."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> None:
        """Run the command."""
        files = _files(self.sources)
        if not files and self.generate == 0:
            raise TensorsimError("library build: got nothing to build from, expected SOURCES or --generate N")
        check_seed(self.seed, "--seed")
        if self.generate < 0:
            raise TensorsimError(f"--generate: got {self.generate}, expected a number of poses")
        if self.most is not None:
            check_count(self.most, "--most")
        if self.out.suffix != ".safetensors" or self.out.is_dir():
            raise TensorsimError(f"--out: got {self.out}, expected the name of a .safetensors file")

        import torch
        from safetensors.torch import save_file
        from tqdm import tqdm

        from tensorsim.files import complete_file
        from tensorsim.training import pose_pool

        generator = torch.Generator().manual_seed(self.seed)
        parts = []
        for file in tqdm(files, desc="read", unit="file", disable=self.quiet or not files):
            parts.append(pose_pool.with_mirror_images(pose_pool.recorded_poses(file)))
        if self.generate:
            parts.append(pose_pool.generated_poses(self.generate, self.seed))
        poses = torch.cat(parts)
        given = len(poses)
        poses = poses[torch.randperm(given, generator=generator)]
        poses = pose_pool.without_near_duplicates(
            poses, self.tolerance, lambda blocks: tqdm(blocks, desc="compare", disable=self.quiet)
        )
        different = len(poses)
        poses = poses[: self.most]

        with complete_file(self.out) as scratch:
            save_file({"poses": poses.half().contiguous()}, scratch)
        print(f"{self.out}: kept {len(poses)} of {given} poses ({different} differ)")


def _files(sources: tuple[Path, ...]) -> list[Path]:
    """Files of paths, folders and patterns, each once, in the order given."""
    import glob

    found: dict[Path, None] = {}
    for source in sources:
        if source.is_dir():
            files = sorted(f for f in source.rglob("*") if f.suffix.lower() in SUFFIXES)
        elif source.is_file():
            files = [source]
        else:
            files = sorted(Path(f) for f in glob.glob(str(source), recursive=True))
        if not files:
            raise TensorsimError(
                f"library build: got {source}, expected motion files ({', '.join(SUFFIXES)})"
            )
        found.update(dict.fromkeys(files))
    return list(found)
