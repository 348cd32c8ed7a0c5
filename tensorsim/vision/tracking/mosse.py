"""MOSSE: people followed by correlation with a filter that is learned from the picture itself, from a first box on.

Source: D. S. Bolme, J. R. Beveridge, B. A. Draper, Y. M. Lui, "Visual object tracking using adaptive correlation
filters", CVPR 2010. With F the Fourier transform of what is in the box and G that of a Gaussian peak in its middle::

    A = eta G conj(F) + (1 - eta) A,    B = eta F conj(F) + (1 - eta) B,    conj(H) = A / (B + epsilon)

and the peak of the inverse transform of ``F conj(H)`` in the next frame shows where the target went. The box
keeps its size.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_mask,
    check_not_negative,
    check_positive,
    check_rank,
    check_shape,
    check_size,
)
from tensorsim.geometry.boxes import center_to_xyxy, xyxy_to_center
from tensorsim.types import Detections, Tracks

#: Rotation in radians and scale of the first box in the eight pictures that, besides itself, initialise a filter.
_WARPS = (
    (0.05, 1.0), (-0.05, 1.0), (0.1, 1.0), (-0.1, 1.0), (0.0, 0.95), (0.0, 1.05), (0.05, 1.03), (-0.05, 0.97),
)  # fmt: skip
_EPSILON = 1e-5


def prepared(patches: Tensor, window: Tensor, epsilon: float = _EPSILON) -> Tensor:
    """Grey patches (..., S, S) in [0, 1] prepared for the filter: logarithm, mean 0, norm 1, times a window (S, S)."""
    x = torch.log1p(255 * patches)
    x = x - x.mean((-2, -1), keepdim=True)
    norm = x.square().sum((-2, -1), keepdim=True).sqrt()
    return x / (norm + epsilon) * window


def peak_to_sidelobe(
    response: Tensor, row: Tensor, column: Tensor, half_width: int = 5, epsilon: float = _EPSILON
) -> Tensor:
    """``(peak - mean) / deviation`` of responses (N, S, S) outside of 11x11 pixels around the peak (N,): (N,)."""
    place = torch.arange(response.shape[-1], device=response.device)
    far_rows = (place - row.unsqueeze(-1)).abs() > half_width
    far_columns = (place - column.unsqueeze(-1)).abs() > half_width
    outside = (far_rows.unsqueeze(-1) | far_columns.unsqueeze(-2)).to(response.dtype)
    count = outside.sum((-2, -1)).clamp(min=1.0)
    mean = (response * outside).sum((-2, -1)) / count
    variance = ((response - mean[:, None, None]).square() * outside).sum((-2, -1)) / count
    return (response.amax((-2, -1)) - mean) / (variance.sqrt() + epsilon)


class MosseTracker(nn.Module):
    """Follows people by MOSSE filters from their boxes in the first frame, all in one batch.

    A box is sampled on ``size`` x ``size`` points whatever its size, and shifts are counted in these. A target is
    lost in frames whose peak-to-sidelobe ratio is below ``least_ratio``: the box stays, the filter does not learn.

    Input: video (B, T, 3, H, W), RGB, uint8 or float in [0, 1], and the detections (B, K, ...) of the first frame of
    each clip; :class:`~tensorsim.vision.RTMDet` gives them. Output: :class:`~tensorsim.types.Tracks` of P people, the
    most that start in a clip, best first; valid from the first frame to the last one in which they are not lost. Not
    differentiable.

    Args:
        learning_rate: eta; OpenCV's is 0.2.
        sigma: width of the Gaussian peak in points.
        size: points along each side of a box.
        least_ratio: peak-to-sidelobe ratio below which a target is lost; OpenCV's.
        start_score: score from which a detection of a person starts a track.
        max_tracks: people at a time.

    Raises:
        TensorsimError: settings out of range; another shape or dtype, detections of another number of clips.
    """

    window: Tensor
    goal: Tensor
    warps: Tensor

    def __init__(
        self,
        learning_rate: float = 0.125,
        sigma: float = 2.0,
        size: int = 64,
        least_ratio: float = 5.7,
        start_score: float = 0.5,
        max_tracks: int = 5,
    ) -> None:
        super().__init__()
        for name, share in (("learning_rate", learning_rate), ("start_score", start_score)):
            if not 0 <= share <= 1:
                raise TensorsimError(f"MosseTracker.{name}: got {share}, expected a number from 0 to 1")
        check_positive(sigma, "MosseTracker.sigma")
        check_count(size, "MosseTracker.size", 16)
        check_count(max_tracks, "MosseTracker.max_tracks")
        check_not_negative(least_ratio, "MosseTracker.least_ratio")
        self.learning_rate, self.least_ratio, self.start_score = learning_rate, least_ratio, start_score
        self.size, self.max_tracks, self.epsilon = size, max_tracks, _EPSILON
        hann = torch.hann_window(size + 2, periodic=False)[1:-1]
        place = torch.arange(size) - size // 2
        squared = place.square().unsqueeze(-1) + place.square().unsqueeze(0)
        turns = [[[g * math.cos(a), -g * math.sin(a)], [g * math.sin(a), g * math.cos(a)]] for a, g in _WARPS]
        self.register_buffer("window", hann.unsqueeze(-1) * hann.unsqueeze(0), persistent=False)
        self.register_buffer("goal", torch.exp(-squared / (2 * sigma**2)), persistent=False)
        self.register_buffer("warps", torch.tensor(turns), persistent=False)

    def forward(self, video: Tensor, start: Detections) -> Tracks:
        """Tracks of each clip from the detections of its first frame."""
        self._check(video, start)
        boxes, present = self._first_boxes(start)
        clips, people, frames = boxes.shape[0], boxes.shape[1], video.shape[1]
        if people == 0:
            nobody = torch.zeros([clips, 0, frames], dtype=torch.bool, device=video.device)
            return Tracks(boxes.new_zeros([clips, 0, frames, 4]), nobody, nobody)
        state = xyxy_to_center(boxes).flatten(0, 1).to(self.window.dtype)
        clip = torch.arange(clips, device=video.device).repeat_interleave(people)
        matched = [present.flatten()]
        path = [state]
        upright = torch.eye(2, dtype=self.window.dtype, device=video.device)
        top, bottom = self._learned(self._spectrum(video[:, 0], clip, state, upright))
        for warp in self.warps:
            more = self._learned(self._spectrum(video[:, 0], clip, state, warp))
            top, bottom = top + more[0], bottom + more[1]
        top, bottom = top / (len(self.warps) + 1), bottom / (len(self.warps) + 1)
        for t in range(1, frames):
            found = self._spectrum(video[:, t], clip, state, upright)
            response = torch.real(torch.fft.ifft2(found * top / (bottom + self.epsilon)))
            shift, ratio = self._peak(response)
            seen = (ratio >= self.least_ratio) & matched[0]
            moved = state[:, :2] + shift * state[:, 2:] / self.size
            state = torch.where(seen.unsqueeze(-1), torch.cat([moved, state[:, 2:]], -1), state)
            new = self._learned(self._spectrum(video[:, t], clip, state, upright))
            rate = (self.learning_rate * seen.to(state.dtype))[:, None, None]
            top, bottom = rate * new[0] + (1 - rate) * top, rate * new[1] + (1 - rate) * bottom
            path.append(state)
            matched.append(seen)
        hits = torch.stack(matched, -1).reshape(clips, people, frames)
        valid = hits.flip(-1).to(torch.int64).cumsum(-1).flip(-1) > 0
        tracked = center_to_xyxy(torch.stack(path, 1)).reshape(clips, people, frames, 4)
        return Tracks((tracked * valid.unsqueeze(-1)).to(start.boxes.dtype), valid, hits)

    def _first_boxes(self, start: Detections) -> tuple[Tensor, Tensor]:
        """Boxes (B, P, 4) that start a track, best first, and which of them are real (B, P)."""
        wide = (start.boxes[..., 2:] - start.boxes[..., :2]).amin(-1) > 1
        usable = start.valid & (start.labels == 0) & (start.scores >= self.start_score) & wide
        order = torch.where(usable, start.scores, -1.0).argsort(dim=-1, descending=True, stable=True)
        people = min(int(usable.sum(-1).max()), self.max_tracks)
        order = order[:, :people]
        return start.boxes.gather(1, order.unsqueeze(-1).expand(-1, -1, 4)), usable.gather(1, order)

    def _spectrum(self, frames: Tensor, clip: Tensor, state: Tensor, warp: Tensor) -> Tensor:
        """Fourier transforms (N, S, S) of what is in boxes (N, 4), centre and sides, of frames (B, 3, H, W)."""
        grey = frames.to(self.window.dtype).mean(1, keepdim=True)
        if not frames.is_floating_point():
            grey = grey / 255
        steps = torch.arange(self.size, dtype=state.dtype, device=state.device) - self.size // 2
        v, u = torch.meshgrid(steps, steps, indexing="ij")
        offset = torch.matmul(torch.stack([u, v], -1), warp.transpose(0, 1)) / self.size
        points = state[:, None, None, :2] + offset * state[:, None, None, 2:]
        extent = torch.tensor([frames.shape[-1], frames.shape[-2]], dtype=state.dtype, device=state.device)
        grid = 2 * points / extent - 1
        patches = F.grid_sample(grey[clip], grid, padding_mode="border", align_corners=False)
        return torch.fft.fft2(prepared(patches.squeeze(1), self.window))

    def _learned(self, spectrum: Tensor) -> tuple[Tensor, Tensor]:
        """Numerator and denominator of the filter of these spectra (N, S, S)."""
        return torch.fft.fft2(self.goal) * spectrum.conj(), spectrum * spectrum.conj()

    def _peak(self, response: Tensor) -> tuple[Tensor, Tensor]:
        """Shift (N, 2) of the peak from the middle in points, column first, to fractions, and its ratio (N,)."""
        best = response.flatten(1).argmax(1)
        row, column = torch.div(best, self.size, rounding_mode="floor"), best % self.size
        n = torch.arange(len(best), device=best.device)
        fractions: list[Tensor] = []
        for axis, place in ((2, column), (1, row)):
            line = response[n, row] if axis == 2 else response[n, :, column]
            inner = place.clamp(1, self.size - 2)
            left, middle, right = line[n, inner - 1], line[n, inner], line[n, inner + 1]
            curve = 2 * middle - left - right
            part = torch.where(curve > 0, 0.5 * (right - left) / torch.where(curve > 0, curve, 1.0), 0.0)
            fractions.append(place - self.size // 2 + torch.where(inner == place, part.clamp(-0.5, 0.5), 0.0))
        return torch.stack(fractions, -1).to(response.dtype), peak_to_sidelobe(response, row, column)

    def _check(self, video: Tensor, start: Detections) -> None:
        check_rank(video, 5, "video", "(B, T, 3, H, W)")
        check_size(video, 2, 3, "video", "(B, T, 3, H, W)")
        if video.shape[0] == 0 or video.shape[1] == 0:
            raise TensorsimError(
                f"video: got shape {list(video.shape)}, expected at least one clip and frame"
            )
        if video.is_floating_point():
            check_finite(video, "video")
        elif video.dtype != torch.uint8:
            raise TensorsimError(f"video: got dtype {video.dtype}, expected uint8 or floating point")
        layout = "(B, K, 4), of the first frames"
        check_floating(start.boxes, "start.boxes")
        check_rank(start.boxes, 3, "start.boxes", layout)
        check_size(start.boxes, 2, 4, "start.boxes", layout)
        if start.boxes.shape[0] != video.shape[0]:
            raise TensorsimError(
                f"start: got detections of {start.boxes.shape[0]} clips, expected {video.shape[0]}"
            )
        each = list(start.boxes.shape[:2])
        check_floating(start.scores, "start.scores")
        check_shape(start.scores, each, "start.scores")
        check_shape(start.labels, each, "start.labels")
        check_mask(start.valid, each, "start.valid")
        check_finite(torch.where(start.valid.unsqueeze(-1), start.boxes, 0.0), "start.boxes where valid")
