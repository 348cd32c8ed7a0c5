"""How fast people come closer or move away, corrected by a network that sees how their bodies move."""

import os

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED_JOINTS, mid_hips
from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_mask,
    check_points,
    check_positive,
    check_shape,
)
from tensorsim.vision.lifting.sight import turned
from tensorsim.vision.lifting.temporal_net import DILATIONS, TimeBlock
from tensorsim.vision.smoothing.along_time import local_linear

#: Rate at which the network sees people and gives their speed, whatever the frame rate.
RATE_HZ = 20.0
#: Joints about the hips and their speeds, three of each; the speed of the hips; which joints are seen; who is there.
FEATURES = 42 + 42 + 3 + 14 + 1


def at_times(x: Tensor, position: Tensor) -> Tensor:
    """Values (S, T, ...) interpolated linearly at ``position`` (K,) in frames: (S, K, ...)."""
    before = position.floor().clamp(0.0, x.shape[1] - 2.0)
    share = (position - before).clamp(0.0, 1.0).to(x.dtype).reshape([-1] + [1] * (x.dim() - 2))
    index = before.to(torch.int64)
    return torch.lerp(x[:, index], x[:, index + 1], share)


def sample_count(frames: int, fps: float, rate_hz: float = RATE_HZ) -> int:
    """Number of times of ``rate_hz`` within ``frames`` frames."""
    return int((frames - 1) / fps * rate_hz + 1e-6) + 1


def sampled(x: Tensor, fps: float, rate_hz: float = RATE_HZ) -> Tensor:
    """Values (S, T, ...) of frames at the K times of ``rate_hz`` within them: (S, K, ...)."""
    count = sample_count(x.shape[1], fps, rate_hz)
    return at_times(x, torch.arange(count, dtype=torch.float64, device=x.device) * (fps / rate_hz))


def movement(
    joints: Tensor, seen: Tensor, valid: Tensor, camera_m: Tensor, fps: float, rate_hz: float = RATE_HZ
) -> Tensor:
    """What the network sees of tracks between each two times of ``rate_hz``.

    Args:
        joints: (S, T, 14, 3) m.
        seen: (S, T, 14) bool.
        valid: (S, T) bool.
        camera_m: (3,) position of the camera.
        fps: frames per second.
        rate_hz: times per second.

    Returns:
        (S, K, FEATURES): joints about the hips (m) and their speeds (m/s), speed of the hips, in axes to the right,
        away from the camera, and up; which joints are seen, and whether the person is there, from 0 to 1.
    """
    points = sampled(joints, fps, rate_hz)
    shown = sampled(seen.to(joints.dtype), fps, rate_hz)
    there = sampled(valid.to(joints.dtype), fps, rate_hz)[..., None]
    hips = mid_hips(points)
    ahead = F.normalize(hips[..., :2] - camera_m[:2], dim=-1, eps=1e-6)
    about = turned(points - hips[..., None, :], ahead.flip(-1)[..., None, :])
    between = F.normalize(ahead[:, 1:] + ahead[:, :-1], dim=-1, eps=1e-6)
    parts = [
        ((about[:, 1:] + about[:, :-1]) / 2).flatten(-2),
        ((about[:, 1:] - about[:, :-1]) * rate_hz).flatten(-2),
        turned((hips[:, 1:] - hips[:, :-1]) * rate_hz, between.flip(-1)),
        torch.minimum(shown[:, 1:], shown[:, :-1]),
        torch.minimum(there[:, 1:], there[:, :-1]),
    ]
    return torch.cat(parts, dim=-1)


def mirrored(features: Tensor, other_joint: Tensor) -> Tensor:
    """What the network sees (..., FEATURES) of the mirror image; ``other_joint`` (14,) is each joint's other side."""
    about, rates, hips, seen, there = features.split([42, 42, 3, 14, 1], dim=-1)
    right = torch.tensor([-1.0, 1.0, 1.0], dtype=features.dtype, device=features.device)
    about = (about.unflatten(-1, [14, 3]).index_select(-2, other_joint) * right).flatten(-2)
    rates = (rates.unflatten(-1, [14, 3]).index_select(-2, other_joint) * right).flatten(-2)
    return torch.cat([about, rates, hips * right, seen.index_select(-1, other_joint), there], dim=-1)


class RangeRateNet(nn.Module):
    """Maps how people move to the error of their speed away from the camera: dilated convolutions along time.

    Args:
        channels: width; 96 makes 0.2 million parameters.
        dilations: intervals between the taps of each block's convolution.

    Shapes:
        features (S, K, FEATURES) -> m/s (S, K) to be added to the speed. Differentiable.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, channels: int = 96, dilations: tuple[int, ...] = DILATIONS) -> None:
        super().__init__()
        self.reach = sum(dilations)
        # Means and standard deviations of the features in the training data.
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.enter = nn.Linear(FEATURES, channels)
        self.blocks = nn.ModuleList([TimeBlock(channels, dilation) for dilation in dilations])
        self.norm = nn.LayerNorm(channels)
        self.leave = nn.Linear(channels, 1)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Features to speeds."""
        x = ((features - self.mean) / self.deviation).clamp(-5.0, 5.0)
        x = self.enter(x).to(features.dtype)
        for block in self.blocks:
            x = block(x)
        return self.leave(self.norm(x))[..., 0].to(features.dtype)


class RangeRate(nn.Module):
    """Moves people towards or away from the camera so that their speed along the line of sight fits how they move.

    A camera tells the range of a person from the size, whose errors come and go with the pose: the hips seem to come
    closer when somebody bends, and the Doppler shift of the trunk, the strongest echo, is wrong. A network that has
    seen generated people, true and as the pipeline finds them, gives the error of the speed of the hips, from the
    joints about the hips, their speeds and the speed of the hips, in axes that face the person, in the second before
    and after. People and their mirror images are averaged. The whole body is moved horizontally by the integral of the
    correction less its mean over ``level_s``: slow changes of the range remain, as do bearing and height.

    Args:
        network: with its weights; None is an untrained one, which changes nothing. :meth:`from_pretrained` loads the
            shipped one.
        level_s: standard deviation of the Gaussian over which the mean is taken.
        samples_per_block: times that go through the network at once, which bounds memory; results do not depend on it.

    Shapes:
        joints (..., T, 14, 3) in metres, z up, seen (..., T, 14) bool, valid (..., T) bool, position of the camera
        (3,) in metres, frames per second -> joints (..., T, 14, 3). Differentiable.

    Raises:
        TensorsimError: numbers that are not positive, wrong shapes, NaN.
    """

    other_joint: Tensor

    def __init__(
        self, network: RangeRateNet | None = None, level_s: float = 2.5, samples_per_block: int = 1024
    ) -> None:
        super().__init__()
        check_positive(level_s, "RangeRate.level_s")
        self.network = RangeRateNet() if network is None else network
        self.level_s, self.rate_hz = level_s, RATE_HZ
        #: No correction is larger than this, in m/s.
        self.largest_m_s = 2.0
        self.samples_per_block = check_count(samples_per_block, "RangeRate.samples_per_block")
        self.register_buffer("other_joint", torch.tensor(MIRRORED_JOINTS), persistent=False)

    def forward(self, joints: Tensor, seen: Tensor, valid: Tensor, camera_m: Tensor, fps: float) -> Tensor:
        """Joints, which of them are seen, frames with a person, position of the camera, frame rate -> joints."""
        check_points(joints, 3, 14, 3, "joints", "(..., T, 14, 3) metres")
        check_finite(joints, "joints")
        check_mask(seen, list(joints.shape[:-1]), "seen")
        check_mask(valid, list(joints.shape[:-2]), "valid")
        check_shape(camera_m, [3], "camera_m")
        check_positive(fps, "fps")
        frames = joints.shape[-3]
        if joints.numel() == 0 or frames < 2 or sample_count(frames, fps) < 2:
            return joints
        points, there = joints.reshape(-1, frames, 14, 3), valid.reshape(-1, frames)
        features = movement(points, seen.reshape(-1, frames, 14), there, camera_m, fps)
        speed = self._in_blocks(features) + self._in_blocks(mirrored(features, self.other_joint))
        speed = (speed / 2).clamp(-self.largest_m_s, self.largest_m_s) * features[..., -1]
        moved = F.pad((speed / self.rate_hz).cumsum(dim=1), [1, 0])
        position = torch.arange(frames, dtype=torch.float64, device=joints.device) * (self.rate_hz / fps)
        moved = at_times(moved, position)
        weights = there.to(joints.dtype) + 1e-4
        # The ridge makes this a mean without slope, as for standing feet.
        level = local_linear(moved, weights, self.level_s * fps, ridge=torch.full_like(moved, 30.0))
        ahead = F.normalize(mid_hips(points)[..., :2] - camera_m[:2], dim=-1, eps=1e-6)
        shift = F.pad((moved - level)[..., None] * ahead, [0, 1])
        return (points + shift[..., None, :]).reshape(joints.shape)

    def _in_blocks(self, features: Tensor) -> Tensor:
        """The network's output for ``samples_per_block`` times at once, (S, K)."""
        count, reach = features.shape[1], self.network.reach
        parts: list[Tensor] = []
        for start in range(0, count, self.samples_per_block):
            first, stop = max(start - reach, 0), min(start + self.samples_per_block, count)
            block = features[:, first : min(stop + reach, count)].to(self.network.mean.dtype)
            parts.append(self.network(block)[:, start - first : stop - first])
        return torch.cat(parts, dim=1).to(features.dtype)

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None) -> "RangeRate":
        """The stage with trained weights, in evaluation mode.

        Args:
            source: a path, a name from ``tensorsim models list``, or None for the shipped weights.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        weights = load_state_dict(path)
        enter = weights.get("enter.weight")
        if enter is None or enter.dim() != 2 or enter.shape[1] != FEATURES:
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of a RangeRate"
            )
        network = RangeRateNet(enter.shape[0])
        load_strict(network, weights, path)
        return cls(network).eval()
