"""The recipes of the lifters: windows of motion, seen by random cameras with keypoint errors, to joints."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import BONES, bone_lengths, coco_to_body, mid_hips
from tensorsim.training.lifter_motion import MotionPool
from tensorsim.training.lifter_views import THRESHOLD, Windows, film
from tensorsim.training.loop import Batch, Recipe, decay_groups
from tensorsim.vision.lifting.sight import Sight, turned
from tensorsim.vision.lifting.temporal_net import Located, TemporalNet
from tensorsim.vision.lifting.videopose3d import body_to_h36m, h36m_to_body
from tensorsim.vision.smoothing.along_time import nearest_valid

#: Weights of the terms of the loss.
_VELOCITY, _BONES, _RANGE, _SPREAD = 0.2, 0.3, 0.5, 0.03
#: Frames to both sides over which the speed of a joint raises its weight, and the largest weight.
_NEAR_FRAMES, _LARGEST_WEIGHT = 2, 6.0
#: Weights of joint errors: wrists and ankles move fastest, and the radar sees speed.
_JOINTS = (1.0, 0.8, 0.8, 1.0, 1.3, 0.8, 1.0, 1.3, 0.8, 1.0, 1.3, 0.8, 1.0, 1.3)


def target(window: Windows, sight: Sight) -> Tensor:
    """True joints (B, T, 14, 3) in the frame that faces the person, in body heights."""
    return turned(window.joints, sight.azimuth[..., None, :])


def laplace(error: Tensor, log_spread: Tensor) -> Tensor:
    """Negative log-likelihood of absolute errors under a Laplace distribution: ``|e| / b + log b``."""
    return error * torch.exp(-log_spread) + log_spread


def _about_hips(joints: Tensor) -> Tensor:
    return joints - mid_hips(joints)[..., None, :]


def speed_weight(about: Tensor, fps: Tensor) -> Tensor:
    """Weights (B, T, 14) of the errors of joints: 1 at rest, and one more for each body height per second.

    A radar sees speed, and blows and kicks, over in a few frames, hardly count without such weights.

    Args:
        about: (B, T, 14, 3) true joints about the hips, body heights.
        fps: (B,).
    """
    speed = torch.diff(about, dim=1).norm(dim=-1) * fps[:, None, None]
    steps = _NEAR_FRAMES + 1  # between frames, to each side
    fastest = F.max_pool1d(speed.transpose(1, 2), 2 * steps, 1, steps).transpose(1, 2)
    return (1.0 + fastest).clamp(max=_LARGEST_WEIGHT)


def lifter_loss(found: Located, true: Tensor, weight: Tensor, fps: Tensor) -> dict[str, Tensor]:
    """The loss and its terms.

    Args:
        found: output of the network.
        true: (B, T, 14, 3), see :func:`target`.
        weight: (B, T) weights of frames.
        fps: (B,).
    """
    weight = weight / weight.sum().clamp(min=1.0)
    joints, about = _about_hips(found.joints), _about_hips(true)
    each = torch.tensor(_JOINTS) * speed_weight(about, fps)
    error = (joints - about).abs()
    across, along = error[..., ::2].mean(dim=-1), error[..., 1]
    place = ((across + along) * each).mean(dim=-1)
    # The angle of the hips and the logarithm of their distance: relative errors count equally far away and nearby.
    far = mid_hips(true)[..., 1].clamp(min=0.3)
    hips = mid_hips(found.joints)[..., 1].clamp(min=0.05)
    off_range = (hips / far).log().abs()
    rate = fps[:, None, None, None]
    moved = torch.diff(joints - about, dim=1) * rate
    hips_moved = torch.diff((hips / far).log() * far.clamp(max=4.0), dim=1) * rate[..., 0, 0]
    pairs = torch.minimum(weight[:, 1:], weight[:, :-1])
    speed = (moved.square().sum(dim=-1) + 1e-4).sqrt() * torch.maximum(each[:, 1:], each[:, :-1])
    ends = torch.tensor(BONES).T
    lengths = bone_lengths(found.joints, ends).log() - bone_lengths(true, ends).log()
    spread = (
        laplace(across.detach(), found.log_spread[..., 0]) + laplace(along.detach(), found.log_spread[..., 1])
    ).mean(dim=-1) + laplace(off_range.detach(), found.log_range_spread)
    terms = {
        "place": (weight * place).sum(),
        "range": (weight * off_range).sum(),
        "speed": (pairs * (speed.mean(dim=-1) + 0.5 * hips_moved.abs())).sum(),
        "bones": (weight * lengths.abs().mean(dim=-1)).sum(),
        "spread": (weight * spread).sum(),
        "depth": (weight * along.mean(dim=-1)).sum(),
    }
    loss = terms["place"] + _RANGE * terms["range"] + _VELOCITY * terms["speed"]
    loss = loss + _BONES * 0.1 * terms["bones"] + _SPREAD * terms["spread"]
    return {"loss": loss} | terms


class LifterRecipe(Recipe):
    """The recipe of the temporal lifter, for :func:`tensorsim.training.loop.fit`.

    Args:
        net: a :class:`~tensorsim.vision.lifting.temporal_net.TemporalNet`.
        pool: motion to train on.
        held_out: motion to validate on.
        frames: frames of a window.
        learning_rate: peak learning rate.
        seed: seed of cameras and errors.
    """

    def __init__(
        self,
        net: nn.Module,
        pool: MotionPool,
        held_out: MotionPool,
        frames: int = 64,
        learning_rate: float = 1.5e-3,
        seed: int = 0,
    ) -> None:
        settings = {
            "frames": frames,
            "learning_rate": learning_rate,
            "seed": seed,
            "motions": len(pool.joints),
        }
        network = "TemporalLifter" if isinstance(net, TemporalNet) else type(net).__name__
        super().__init__(net, settings, {"network": network})
        self.pool, self.frames, self.seed = pool, frames, seed
        self.learning_rate = learning_rate
        self.judged = [film(held_out, 64, frames, torch.Generator().manual_seed(k)) for k in range(6)]

    def sample(self, index: int) -> dict[str, Any]:
        """The index alone: windows are made batch by batch."""
        return {"index": index}

    def collate(self, samples: list[dict[str, Any]]) -> Batch:
        """Film as many windows as there are samples; their first number is the seed."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003_139 + int(samples[0]["index"]))
        return self.batch_of(film(self.pool, len(samples), self.frames, generator))

    def batch_of(self, window: Windows) -> Batch:
        """The input of :meth:`loss` for filmed windows."""
        sight = window.sight()
        return {
            "sight": tuple(sight),
            "target": target(window, sight),
            "weight": _weight(window),
            "fps": window.fps,
        }

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """The loss of a batch from :meth:`collate`."""
        found = net(Sight(*batch["sight"]))
        located = Located(*(part.float() for part in found))
        return lifter_loss(located, batch["target"], batch["weight"], batch["fps"])

    def optimiser(self) -> torch.optim.Optimizer:
        """AdamW; no decay of offsets and norms."""
        groups = decay_groups(self.net, 0.02)
        return torch.optim.AdamW(groups, lr=self.learning_rate, betas=(0.9, 0.98))

    def rate(self, step: int, steps: int) -> float:
        """Rises over 300 steps, then falls along a cosine."""
        rise = min(1.0, (step + 1) / 300)
        return rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Errors on held-out motion: depths about the hips and positions for a body of 1.75 m, ranges, speeds."""
        totals: dict[str, float] = {}
        for window in self.judged:
            sight = window.sight()
            with torch.autocast("cpu", enabled=False):
                terms = lifter_loss(net(sight), target(window, sight), _weight(window), window.fps)
            for name, value in terms.items():
                totals[name] = totals.get(name, 0.0) + float(value) / len(self.judged)
        return {
            "score": -totals["loss"],
            "depth_cm": 175 * totals["depth"],
            "range_percent": 100 * totals["range"],
            "speed_m_s": 1.75 * totals["speed"],
            "place_cm": 175 * totals["place"],
        }


def _weight(window: Windows) -> Tensor:
    """Frames in which the person is tracked count fully, partly visible people less, gaps hardly."""
    count = (window.scores >= 0.3).sum(dim=-1) * window.valid
    return 0.05 + 0.25 * (count > 0) + 0.7 * (count >= 8)


#: Height of the bodies that VideoPose3D learns, in metres: its results are metric.
_TALL_M = 1.75


def picture_joints(window: Windows) -> Tensor:
    """Input of VideoPose3D: (B, T, 17, 2) Human3.6M joints from the centre of the picture, over half its width."""
    joints, _ = coco_to_body(window.keypoints, window.scores, THRESHOLD)
    source = nearest_valid(window.valid)[..., None, None].expand_as(joints)
    centred = body_to_h36m(joints.gather(1, source)) - window.center[:, None, None]
    return centred / (window.extent[:, None, None, :1] / 2)


class VideoPoseRecipe(LifterRecipe):
    """The recipe of :class:`~tensorsim.vision.VideoPose3D`: the mean joint error, as used by its authors."""

    def batch_of(self, window: Windows) -> Batch:
        """Joints in the picture and the true ones in camera axes, metres about the hips."""
        from_camera = window.joints @ window.rotation[:, None]  # right, down, away
        true = _TALL_M * _about_hips(from_camera)
        return {"joints": picture_joints(window), "target": body_to_h36m(true), "weight": _weight(window)}

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Mean distance of the joints from the true ones, metres (MPJPE)."""
        weight = batch["weight"] / batch["weight"].sum().clamp(min=1.0)
        error = (net(batch["joints"]).float() - batch["target"]).square().sum(dim=-1)
        return {"loss": (weight * (error + 1e-8).sqrt().mean(dim=-1)).sum()}

    def validate(self, net: nn.Module) -> dict[str, float]:
        """Errors on held-out motion, in cm for a body of 1.75 m: of joints about the hips, and of depths alone."""
        place = depth = 0.0
        for window in self.judged:
            batch = self.batch_of(window)
            weight = batch["weight"] / batch["weight"].sum()
            with torch.autocast("cpu", enabled=False), torch.no_grad():
                error = _about_hips(h36m_to_body(net(batch["joints"]) - batch["target"]))
            place += float((weight * error.norm(dim=-1).mean(dim=-1)).sum()) / len(self.judged)
            depth += float((weight * error[..., 2].abs().mean(dim=-1)).sum()) / len(self.judged)
        return {"score": -place, "joints_cm": 100 * place, "depth_cm": 100 * depth}
