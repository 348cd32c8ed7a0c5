"""From the joints of people to the point scatterers of one scene."""

import math
from collections.abc import Sequence
from numbers import Real

import torch
from torch import Tensor, nn

from tensorsim.config import JOINT_RCS_M2, Vector
from tensorsim.errors import TensorsimError, check_min_rank, check_positive, check_tensor


def visibility_fade(
    valid: Tensor, fps: float, prf_hz: float, start: int, stop: int, fade_s: float = 0.1
) -> Tensor:
    """Amplitude of people who enter and leave, at pulses ``start`` to ``stop`` (excluded), without steps.

    An echo switched on within one pulse would spread over all Doppler bins. Here the amplitude rises as a
    raised cosine over ``fade_s`` after the first valid frame of a run and falls likewise before its last one;
    between runs it is zero. A run that reaches the first or last frame of the clip is not faded there: the person
    is in the scene before and after.

    Args:
        valid: (..., T) bool at video rate, frame k at ``k / fps``.
        fps, prf_hz: rates of frames and pulses.
        start, stop: pulses, ``0 <= start <= stop``.
        fade_s: length of a rise or fall in seconds.

    Returns:
        (..., stop - start) float64 in [0, 1].

    Raises:
        TensorsimError: valid not boolean or without frames, or an impossible rate, range or ``fade_s``.
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

    # Frame T, the end of the clip, is like the last frame.
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


def check_people(positions: Tensor, fade: Tensor, joints: int) -> None:
    """Refuse anything but positions (..., P, M, ``joints``, 3) and fade (..., P, M), both real and finite."""
    check_tensor(positions, "positions", f"(..., P, M, {joints}, 3)")
    check_tensor(fade, "fade", "(..., P, M)")
    if fade.shape != positions.shape[:-2]:
        raise TensorsimError(
            f"fade: got shape {list(fade.shape)}, expected (..., P, M) {list(positions.shape[:-2])}"
        )


def one_scene(points: Tensor, rcs: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
    """The scatterers of P people as one scene, person after person.

    Args:
        points: (..., P, M, K, 3) metres, K scatterers per person.
        rcs: (..., P, M, K) or broadcastable to it, m^2.
        fade: (..., P, M) amplitude of each person.

    Returns:
        Positions (..., M, P * K, 3) and cross sections (..., M, P * K), both in the dtype of the points.
        Amplitude is proportional to the square root of the cross section, so cross sections scale with ``fade ** 2``.
    """
    shown = (fade.square().unsqueeze(-1) * rcs).to(points.dtype)
    return points.transpose(-4, -3).flatten(-3, -2), shown.transpose(-3, -2).flatten(-2)


#: Joint weights whose weighted sum points to the right of the body.
RIGHTWARD = {"right_shoulder": 0.5, "right_hip": 0.5, "left_shoulder": -0.5, "left_hip": -0.5}


def check_antenna(name: str, position: Vector) -> None:
    """Refuse an antenna position without three finite numbers."""
    if len(position) != 3 or not all(isinstance(v, Real) and math.isfinite(v) for v in position):
        raise TensorsimError(f"{name}: got {position}, expected three finite numbers (x, y, z) in metres")


def weights(names: Sequence[str], *points: dict[str, float]) -> Tensor:
    """Weights of points that are weighted sums of named ones, as a matrix (points, names) float64."""
    return torch.tensor([[point.get(name, 0.0) for name in names] for point in points], dtype=torch.float64)


class JointScatterers(nn.Module):
    """One point scatterer per joint; the people of a clip become one scene.

    Args:
        rcs_m2: radar cross section of each joint in m^2; the default is that of the original's panel.
        learnable: whether the table is a parameter, to be fitted to an echo starting from ``rcs_m2``. The learned
            parameter is its logarithm ``log_rcs_m2``, so that it stays positive and steps are in dB.

    Example:
        >>> positions, fade = torch.randn(2, 3, 100, 14, 3), torch.ones(2, 3, 100)  # 2 scenes, 3 people, 100 pulses
        >>> points, rcs = JointScatterers()(positions, fade)
        >>> points.shape, rcs.shape
        (torch.Size([2, 100, 42, 3]), torch.Size([2, 100, 42]))

    Raises:
        TensorsimError: no joint, or a cross section that is negative or not finite (or 0, if learnable).
    """

    rcs_m2: Tensor
    log_rcs_m2: Tensor | None

    def __init__(self, rcs_m2: Sequence[float] = JOINT_RCS_M2, learnable: bool = False) -> None:
        super().__init__()
        if len(rcs_m2) == 0 or not all(math.isfinite(v) and v >= 0 for v in rcs_m2):
            raise TensorsimError(
                f"JointScatterers.rcs_m2: got {rcs_m2}, expected finite numbers >= 0, one per joint"
            )
        if learnable and min(rcs_m2) == 0:
            raise TensorsimError(
                f"JointScatterers.rcs_m2: got {rcs_m2}, expected numbers > 0 if they are learned: the logarithm of 0 "
                "is not finite"
            )
        table = torch.tensor(tuple(rcs_m2), dtype=torch.float64)
        self.register_buffer("rcs_m2", table, persistent=False)
        self.register_parameter("log_rcs_m2", nn.Parameter(table.log()) if learnable else None)

    def table(self) -> Tensor:
        """The current cross sections (J,) in m^2; differentiable with respect to ``log_rcs_m2`` if learnable."""
        log_rcs_m2 = self.log_rcs_m2
        return self.rcs_m2 if log_rcs_m2 is None else log_rcs_m2.exp()

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Place scatterers at joints; any range of pulses.

        Args:
            positions: (..., P, M, J, 3) m, people and pulses; P may be 0.
            fade: (..., P, M) amplitude of each person in [0, 1], see :func:`visibility_fade`.

        Returns:
            Positions (..., M, P * J, 3), person after person, and their cross sections (..., M, P * J) in m^2
            and in the dtype of the positions, see :func:`one_scene`.

        Raises:
            TensorsimError: wrong ranks or dtypes, another number of joints, or shapes that do not match.
        """
        check_people(positions, fade, self.rcs_m2.shape[0])
        return one_scene(positions, self.table().to(positions.dtype), fade)
