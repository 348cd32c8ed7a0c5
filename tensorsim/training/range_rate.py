"""The recipe of the network that corrects speeds along the line of sight, from people as films show them."""

from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.body.skeleton import MIRRORED_JOINTS, mid_hips
from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.motions import Draw
from tensorsim.files import complete_file
from tensorsim.training.everyday import RANGE_M, SIDE_M, at_rate, everyday_motion
from tensorsim.training.keypoint_errors import FilmedMotion, draw_camera, find_keypoints
from tensorsim.training.lifter_motion import KINDS, MotionPool, build_pool
from tensorsim.training.lifter_views import Draw as PoolDraw
from tensorsim.training.lifter_views import windows_of
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.vision.lifting.range_rate import (
    FEATURES,
    RATE_HZ,
    RangeRateNet,
    mirrored,
    movement,
    sampled,
)

#: People of one activity before one camera, seconds of each clip, and frame rates of films.
_PEOPLE, SECONDS, FILM_HZ = 4, 4.0, (15.0, 18.0, 20.0, 24.0, 25.0, 30.0)
#: Motions other than everyday ones per group of clips.
_MOTIONS = 10
#: Intervals of RATE_HZ in a clip.
STEPS = round(SECONDS * RATE_HZ) - 1
OTHER_JOINT = torch.tensor(MIRRORED_JOINTS)
#: From this error on, in m/s, the loss grows linearly.
_FAR_M_S = 0.3


class Clips(NamedTuple):
    """Filmed people.

    Attributes:
        features: (N, STEPS, FEATURES) float16, see :func:`~tensorsim.vision.lifting.range_rate.movement`.
        missing: (N, STEPS) what must be added to their speed away from the camera, m/s.
        weight: (N, STEPS) 1 where they are tracked, else 0.
    """

    features: Tensor
    missing: Tensor
    weight: Tensor


class _Recorder(nn.Module):
    """In the place of the stage: keeps what it is given."""

    def __init__(self) -> None:
        super().__init__()
        self.given: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []

    def forward(self, joints: Tensor, seen: Tensor, valid: Tensor, camera_m: Tensor, fps: float) -> Tensor:
        """The joints as they are."""
        self.given.append((joints[0], seen[0], valid[0], camera_m))
        return joints


def missing_speed(
    true: Tensor, found: Tensor, valid: Tensor, cameras_m: tuple[Tensor, Tensor], fps: float
) -> Tensor:
    """What is missing in the speed of found hips (N, T, 3) away from the camera, at ``RATE_HZ``: (N, K) m/s.

    Scales are left alone: true distances are multiplied so that the medians agree.

    Args:
        true: (N, T, 3) m.
        found: (N, T, 3) m.
        valid: (N, T) bool, frames whose distances are compared.
        cameras_m: the true position of the camera and that which the pipeline assumes, (3,) each.
        fps: frames per second.
    """
    distances = [
        (hips[..., :2] - camera[:2]).norm(dim=-1)
        for hips, camera in zip((true, found), cameras_m, strict=True)
    ]
    ratio = torch.where(valid, distances[1] / distances[0].clamp(min=0.1), torch.nan).nanmedian(dim=1)[0]
    ratio = ratio.nan_to_num(1.0).clamp(0.5, 2.0)
    missing = ratio[:, None] * distances[0] - distances[1]
    return sampled(missing, fps).diff(dim=1) * RATE_HZ


def filmed(true: Tensor, heights_m: Tensor, fps: float, draw: Draw, films: FilmedMotion) -> Clips:
    """People with true joints (N, T, 14, 3) m, all before one camera."""
    filming = draw_camera(mid_hips(true).mean(0), draw)
    seen = [
        find_keypoints(joints, height, fps, filming, draw)
        for joints, height in zip(true, heights_m.tolist(), strict=True)
    ]
    recorder = _Recorder()
    films.stage.range_rate = recorder  # type: ignore[assignment]
    films.lifted(seen, filming, fps)
    if not recorder.given:  # nobody was found
        return Clips(torch.zeros(0, STEPS, FEATURES).half(), torch.zeros(0, STEPS), torch.zeros(0, STEPS))
    joints, shown, valid, camera = recorder.given[-1]
    features = movement(joints, shown, valid, camera, fps)
    cameras = (torch.tensor(filming.camera.position_m, dtype=torch.float64), camera.double())
    missing = missing_speed(mid_hips(true), mid_hips(joints).double(), valid, cameras, fps)
    short = STEPS - missing.shape[1]
    return Clips(
        F.pad(features, [0, 0, 0, short]).half(),
        F.pad(missing, [0, short]).float(),
        F.pad((features[..., -1] > 0.99).float(), [0, short]),
    )


def everyday_clips(seed: int, films: FilmedMotion) -> list[Clips]:
    """Four people of each activity, each activity before its own camera."""
    generator = torch.Generator().manual_seed(seed)
    made: list[Clips] = []
    for activity in range(1, len(ACTIVITIES)):
        draw = Draw(1, generator)
        fps = FILM_HZ[int(draw(0.0, len(FILM_HZ)))]
        motion, heights = everyday_motion(activity, _PEOPLE, torch.full((_PEOPLE,), SECONDS), generator)
        true = torch.stack([at_rate(joints, round(SECONDS * fps), fps) for joints in motion])
        made.append(filmed(true, heights, fps, draw, films))
    return made


def other_clips(seed: int, pool: MotionPool, films: FilmedMotion) -> list[Clips]:
    """As many people as of everyday motion who move in other ways, two in five of them as captured people do."""
    generator = torch.Generator().manual_seed(seed)
    captured = pool.kind == list(KINDS).index("captures")
    chance = torch.where(captured, 0.4 / captured.sum().clamp(min=1), 0.6 / (~captured).sum().clamp(min=1))
    made: list[Clips] = []
    for _ in range(1, len(ACTIVITIES)):
        draw = Draw(1, generator)
        fps = FILM_HZ[int(draw(0.0, len(FILM_HZ)))]
        which = torch.multinomial(chance, _PEOPLE, generator=generator)
        some = MotionPool(*(field[which] for field in pool))
        joints, heights, _ = windows_of(some, round(SECONDS * fps), PoolDraw(_PEOPLE, generator), fps)
        far, aside = draw(*RANGE_M, _PEOPLE)[0], draw(-SIDE_M, SIDE_M, _PEOPLE)[0]
        place = torch.stack([aside, far, torch.zeros_like(far)], dim=-1)
        made.append(filmed(joints.double() + place[:, None, None], heights, fps, draw, films))
    return made


def build_clips(
    path: Path,
    groups: int,
    motions: tuple[Path, ...] = (),
    seed: int = 0,
    held_out: bool = False,
    quiet: bool = False,
) -> Clips:
    """Clips of ``groups`` calls of :func:`everyday_clips` and of :func:`other_clips`, from a file, or made for it.

    Args:
        path: ``.safetensors`` file.
        groups: number of groups of 88 people.
        motions: motion capture files.
        seed: seed of everything random.
        held_out: use the captures that are not trained on.
        quiet: no progress bar.

    Raises:
        TensorsimError: the file holds other clips.
    """
    from safetensors import safe_open
    from safetensors.torch import load_file, save_file

    names = ", ".join(file.name for file in motions)
    settings = {"groups": str(groups), "motions": names, "seed": str(seed), "held out": str(held_out)}
    if path.is_file():
        with safe_open(path, "pt") as file:
            stated = file.metadata()
        if stated != settings:
            raise TensorsimError(f"{path}: got clips of {stated}, expected those of {settings}")
        return Clips(**load_file(path))
    films = FilmedMotion()
    pool = build_pool(None, _MOTIONS * groups, motions, seed, held_out, quiet)
    made: list[Clips] = []
    for group in tqdm(range(groups), desc=path.stem, unit="group", disable=quiet):
        made += everyday_clips(seed * 1_000_003 + group, films)
        made += other_clips(seed * 1_000_003 + group, pool, films)
    clips = Clips(*(torch.cat(fields) for fields in zip(*made, strict=True)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with complete_file(path) as scratch:
        save_file(clips._asdict(), scratch, settings)
    return clips


class RangeRateRecipe(Recipe):
    """The recipe of the network of :class:`~tensorsim.vision.RangeRate`, for :func:`tensorsim.training.loop.fit`.

    Args:
        net: network to train; means and deviations of its features are set here unless it starts from weights.
        clips: to train on.
        judged: to validate on.
        learning_rate: peak learning rate.
        seed: seed of the order of the clips and of which are mirrored.
        fresh: whether the network is untrained.
    """

    def __init__(
        self,
        net: RangeRateNet,
        clips: Clips,
        judged: Clips,
        learning_rate: float = 2e-3,
        seed: int = 0,
        fresh: bool = True,
    ) -> None:
        settings = {"learning_rate": learning_rate, "seed": seed, "clips": len(clips.features)}
        super().__init__(net, settings, {"network": "RangeRate"})
        self.clips, self.judged, self.learning_rate, self.seed = clips, judged, learning_rate, seed
        if fresh:
            features = clips.features[clips.weight > 0].float()
            net.mean.copy_(features.mean(dim=0))
            net.deviation.copy_(features.std(dim=0).clamp(min=1e-3))

    def sample(self, index: int) -> dict[str, Any]:
        """A clip, or its mirror image, at random."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003_139 + index)
        clip = int(torch.randint(len(self.clips.features), (1,), generator=generator))
        features = self.clips.features[clip].float()
        if int(torch.randint(2, (1,), generator=generator)):
            features = mirrored(features, OTHER_JOINT)
        return {"features": features, "missing": self.clips.missing[clip], "weight": self.clips.weight[clip]}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Huber's loss of the speed in tracked frames."""
        error = F.huber_loss(
            net(batch["features"]).float(), batch["missing"], delta=_FAR_M_S, reduction="none"
        )
        return {"loss": (batch["weight"] * error).sum() / batch["weight"].sum().clamp(min=1.0)}

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; no decay of offsets and norms."""
        return torch.optim.AdamW(decay_groups(self.net, 0.02), lr=self.learning_rate, betas=(0.9, 0.98))

    def rate(self, step: int, steps: int) -> float:
        """Rises over 300 steps, then falls linearly."""
        return min(1.0, (step + 1) / 300) * (1.0 - 0.99 * step / steps)

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Root mean square errors of the speed in the clips to validate on, m/s, before and after the correction."""
        features, missing, weight = self.judged.features.float(), self.judged.missing, self.judged.weight
        rest = missing - (net(features) + net(mirrored(features, OTHER_JOINT))).float() / 2
        before, after = (
            float(((error.square() * weight).sum() / weight.sum().clamp(min=1.0)).sqrt())
            for error in (missing, rest)
        )
        return {"score": -after, "before_m_s": before, "after_m_s": after}
