"""From the joints of people to the point scatterers of one scene."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tensorsim.config import JOINT_RCS_M2
from tensorsim.errors import TensorsimError, check_floating, check_min_rank, check_positive, check_size


def visibility_fade(
    valid: Tensor, fps: float, prf_hz: float, start: int, stop: int, fade_s: float = 0.1
) -> Tensor:
    """Amplitude of people who enter and leave, at pulses ``start`` to ``stop`` (excluded), free of steps.

    An echo that is switched on within one pulse splashes over all Doppler bins. Here the amplitude rises as a
    raised cosine over ``fade_s`` after the first valid frame of a run and falls likewise before its last one;
    it is zero between. A run that reaches the first or last frame of the clip is not faded there: the person
    is in the scene before and after.

    Args:
        valid: (..., T) bool at video rate, frame k at ``k / fps``.
        fps, prf_hz: rates of frames and pulses.
        start, stop: pulses, ``0 <= start <= stop``.
        fade_s: length of a flank in seconds.

    Returns:
        (..., stop - start) float64 in [0, 1].

    Raises:
        TensorsimError: valid not boolean or without frames, or a rate, range or flank that is not possible.
    """
    if valid.dtype != torch.bool:
        raise TensorsimError(f"valid: got dtype {valid.dtype}, expected bool")
    check_min_rank(valid, 1, "valid", "(..., T)")
    check_positive(fps, "fps")
    check_positive(prf_hz, "prf_hz")
    check_positive(fade_s, "fade_s")
    frames = valid.shape[-1]
    if frames < 1:
        raise TensorsimError(
            f"valid: got shape {list(valid.shape)}, expected (..., T) with at least one frame"
        )
    if not 0 <= start <= stop:
        raise TensorsimError(f"visibility_fade: got pulses {start} to {stop}, expected 0 <= start <= stop")

    # Frame T, the end of the clip, goes on like the last one.
    present = torch.cat([valid, valid[..., -1:]], dim=-1)
    frame = torch.arange(frames + 1, dtype=torch.float64, device=valid.device)
    ever = torch.full_like(frame, float("inf"))
    run_start = torch.cummax(torch.where(present, -ever, frame + 1), dim=-1)[0]
    run_end = torch.cummin(torch.where(present, ever, frame - 1).flip(-1), dim=-1)[0].flip(-1)

    time = torch.arange(start, stop, dtype=torch.float64, device=valid.device) * fps / prf_hz
    before = torch.floor(time).long().clamp(max=frames - 1)
    since_start = time - run_start.index_select(-1, before)
    until_end = run_end.index_select(-1, before + 1) - time
    flank = fade_s * fps
    rise = torch.sin(math.pi / 2 * (since_start / flank).clamp(0.0, 1.0)) ** 2
    fall = torch.sin(math.pi / 2 * (until_end / flank).clamp(0.0, 1.0)) ** 2
    return rise * fall


class JointScatterers(nn.Module):
    """One point scatterer per joint; the people of a clip become one scene.

    Args:
        rcs_m2: radar cross section of each joint in m^2; the default is the original's panel.

    Example:
        >>> JointScatterers()(positions, fade)  # (B, P, M, 14, 3), (B, P, M) -> (B, M, 14 P, 3), (B, M, 14 P)

    Raises:
        TensorsimError: no joint, or a cross section that is negative or not finite.
    """

    rcs_m2: Tensor

    def __init__(self, rcs_m2: Sequence[float] = JOINT_RCS_M2) -> None:
        super().__init__()
        if len(rcs_m2) == 0 or not all(math.isfinite(v) and v >= 0 for v in rcs_m2):
            raise TensorsimError(
                f"JointScatterers.rcs_m2: got {rcs_m2}, expected finite numbers >= 0, one per joint"
            )
        self.register_buffer("rcs_m2", torch.tensor(tuple(rcs_m2), dtype=torch.float64), persistent=False)

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Place scatterers at joints; any range of pulses.

        Args:
            positions: (..., P, M, J, 3) m, people and pulses; P may be 0.
            fade: (..., P, M) amplitude of each person in [0, 1], see :func:`visibility_fade`.

        Returns:
            Positions (..., M, P * J, 3), person after person, and their cross sections (..., M, P * J) in m^2
            and in the dtype of the positions. Amplitude goes with the square root of the cross section, so
            this is ``fade ** 2`` times that of the joint.

        Raises:
            TensorsimError: wrong ranks or dtypes, another number of joints, or shapes that do not go
                together.
        """
        layout = f"(..., P, M, {self.rcs_m2.shape[0]}, 3)"
        check_floating(positions, "positions")
        check_floating(fade, "fade")
        check_min_rank(positions, 4, "positions", layout)
        check_size(positions, -1, 3, "positions", layout)
        check_size(positions, -2, self.rcs_m2.shape[0], "positions", layout)
        if fade.shape != positions.shape[:-2]:
            raise TensorsimError(
                f"fade: got shape {list(fade.shape)}, expected (..., P, M) {list(positions.shape[:-2])}"
            )
        rcs = fade.square().unsqueeze(-1) * self.rcs_m2.to(positions.dtype)
        scene = positions.transpose(-4, -3).flatten(-3, -2)
        return scene, rcs.to(positions.dtype).transpose(-3, -2).flatten(-2)
