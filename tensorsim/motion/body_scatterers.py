"""The body as a rough surface: a torso of many points and limbs of a few, as strong as measured ones."""

import math

import torch
from torch import Tensor, nn

from tensorsim.body.proportions import ANKLE_HEIGHT, TRUNK
from tensorsim.config import JOINTS, Vector
from tensorsim.errors import check_count, check_positive
from tensorsim.motion.limb_scatterers import POINTS, SEGMENTS, TOES, bisector, toes_of
from tensorsim.motion.rough_surface import cylinder_rcs, patch_rcs, skin_reflectivity
from tensorsim.motion.scatterers import RIGHTWARD, check_antenna, check_people, one_scene, weights
from tensorsim.ops import unit

#: The torso is an elliptical cylinder: semi-axes to the right and forward in body heights, and its length down from
#: the neck as a multiple of the distance to the middle of the hips.
TORSO_RIGHT, TORSO_FORWARD, TORSO_LENGTH = 0.095, 0.077, 1.2
#: Rows and columns of its points. The spacing of columns matches the angular width of a patch's reflection.
ROWS, COLUMNS = 2, 14
#: Root mean square slope of its surface, and of the limbs' surface, where sleeves and trousers hang in folds.
TORSO_ROUGHNESS, LIMB_ROUGHNESS = 0.2, 0.35
#: Ratio of cross sections to those of the bare cylinders, for shoulders, hips, hands and double reflections between
#: parts; set by the measured cross section of a man at 4.8 and 9.4 GHz.
WHOLE_BODY = 1.4
#: Remaining fraction of the limbs' cross section at 77 GHz, and the increase at 24 GHz and below, fitted to measured
#: walks: see the class.
LIMB_SHARES = {"upper_arm": 0.67, "forearm": 0.2, "thigh": 0.285, "shank": 0.19, "foot": 0.085}
LIMBS_AT_24_GHZ = 1.3


def torso_columns(right: float, forward: float, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Columns of an elliptical cylinder whose normals are equally spaced in angle.

    Args:
        right, forward: semi-axes in metres.
        columns: number of columns around the whole circumference.

    Returns:
        Positions (columns, 2) in metres and unit normals (columns, 2), to the right and forward, and widths
        (columns,) in metres.
    """
    fine = 64
    angle = 2 * math.pi * (torch.arange(columns * fine, dtype=torch.float64) + 0.5) / (columns * fine)
    support = (right * torch.cos(angle)).square() + (forward * torch.sin(angle)).square()
    width = ((right * forward) ** 2 * support**-1.5).reshape(columns, fine).mean(-1) * 2 * math.pi / columns
    middle = 2 * math.pi * (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    normal = torch.stack((torch.cos(middle), torch.sin(middle)), -1)
    axes = torch.tensor((right, forward), dtype=torch.float64)
    return normal * axes.square() / (normal * axes).norm(dim=-1, keepdim=True), normal, width


def _line_across(share: float) -> dict[str, float]:
    """Joint weights for a line to the right: that of the shoulders at a share of 0, that of the hips at 1."""
    return {
        "right_shoulder": 1 - share,
        "left_shoulder": share - 1,
        "right_hip": share,
        "left_hip": -share,
    }


def limb_gain(carrier_hz: float) -> float:
    """Factor on limb cross sections: ``LIMBS_AT_24_GHZ`` up to 24 GHz, 1 from 77 GHz, linear in dB over log f."""
    below = math.log(77e9 / carrier_hz) / math.log(77 / 24)
    return LIMBS_AT_24_GHZ ** min(1.0, max(0.0, below))


class BodyScatterers(nn.Module):
    """An extended torso and limbs, with cross sections that follow aspect and carrier.

    The torso is an elliptical cylinder, twisted between shoulders and hips and covered with points, which reflect where
    they face the bisector of transmitter and receiver; a limb is a cylinder of ``per_segment`` points, strong broadside
    and weak end-on; the head is a sphere. All are rough (:mod:`~tensorsim.motion.rough_surface`) and made of skin, so
    that a body reflects a third of what metal would at 77 GHz and half at 5.8 GHz. Points are many wavelengths apart:
    their echoes add with arbitrary phases, and the sum fluctuates from pulse to pulse as in measurements.

    A walking person totals 0.4 m^2 at 77 GHz and 0.6 m^2 at 5.8 GHz; published: 0.37 to 1.9 m^2 at 4.8 GHz and 0.5
    to 1.2 m^2 at 9.4 GHz for a man of 91 kg (Schultz, Burgener and King, Proc. IRE 46, 1958), and averages at 24 and 77
    GHz that are very close to each other (Fortuny-Guasch and Chareau, JRC report EUR 25762, 2013). The scale is set by
    the former, :data:`WHOLE_BODY`.

    Limbs are fitted: cylinders of their size would put two to three times more power above 1.5 times the speed of the
    torso than is measured at 24 and 77 GHz. :data:`LIMB_SHARES` bring that to within a quarter, and the speed below
    which 95 % of the power lies to within 6 % (``python -m tests.benchmarks.eval_bodies`` prints both). The power
    above 2 times at 77 GHz fits as well; at 24 GHz two measured sets differ there by a factor of four, and this model
    lies between them. The shares account for limbs that hide each other, antennas aimed at the chest, and more.

    Args:
        tx_m, rx_m: transmitter and receiver in metres (for an array, its centre).
        carrier_hz: sets the reflectivity of skin and the share of the limbs.
        per_segment: points per limb segment.
        height_m: body height, which scales the cross sections.

    Example:
        >>> positions, fade = torch.randn(3, 100, 14, 3), torch.ones(3, 100)  # 3 people, 100 pulses
        >>> points, rcs = BodyScatterers((-0.1, 0.0, 1.5), (0.1, 0.0, 1.5), carrier_hz=77e9)(positions, fade)
        >>> points.shape, rcs.shape
        (torch.Size([100, 177, 3]), torch.Size([100, 177]))

    Raises:
        TensorsimError: an antenna without three finite numbers, ``per_segment`` below 1, a carrier or height that is
            not positive.
    """

    tx: Tensor
    rx: Tensor
    limb_points: Tensor
    limb_axes: Tensor
    limb_area: Tensor
    limb_cap: Tensor
    right: Tensor
    trunk: Tensor
    knees: Tensor
    ankles: Tensor
    torso_place: Tensor
    torso_normal: Tensor
    torso_down: Tensor
    torso_right: Tensor
    torso_area: Tensor

    def __init__(
        self,
        tx_m: Vector,
        rx_m: Vector,
        carrier_hz: float,
        per_segment: int = 3,
        height_m: float = 1.75,
    ) -> None:
        super().__init__()
        check_antenna("tx_m", tx_m)
        check_antenna("rx_m", rx_m)
        check_positive(carrier_hz, "carrier_hz")
        check_positive(height_m, "height_m")
        check_count(per_segment, "per_segment", 1, 1000)
        self.per_segment = per_segment
        self.points_per_person = 1 + 10 * per_segment + ROWS * COLUMNS
        self.toes_m = TOES * height_m
        self.sole_m = ANKLE_HEIGHT * height_m / 2
        self.torso_roughness, self.limb_roughness = TORSO_ROUGHNESS, LIMB_ROUGHNESS
        reflectivity = WHOLE_BODY * skin_reflectivity(carrier_hz)
        limbs = [s for s in SEGMENTS if s.name not in ("head", "torso")]
        start, end = weights(POINTS, *(s.start for s in limbs)), weights(POINTS, *(s.end for s in limbs))
        along = (torch.arange(per_segment, dtype=torch.float64).reshape(-1, 1) + 0.5) / per_segment
        sizes = torch.tensor([s.semi_axes for s in limbs], dtype=torch.float64) * height_m
        share = torch.tensor([LIMB_SHARES[s.name.split("_", 1)[1]] for s in limbs], dtype=torch.float64)
        share = (share * limb_gain(carrier_hz) * reflectivity / per_segment).unsqueeze(-1)
        head = next(s for s in SEGMENTS if s.name == "head").semi_axes[0] * height_m
        self.head_rcs = math.pi * head**2 * reflectivity

        place, normal, width = torso_columns(TORSO_RIGHT * height_m, TORSO_FORWARD * height_m, COLUMNS)
        down = TORSO_LENGTH * (torch.arange(ROWS, dtype=torch.float64) + 0.5) / ROWS
        area = width * TORSO_LENGTH * TRUNK * height_m / ROWS * reflectivity
        buffers = {
            "tx": torch.tensor(tx_m, dtype=torch.float64),
            "rx": torch.tensor(rx_m, dtype=torch.float64),
            "limb_points": (start.unsqueeze(1) + along * (end - start).unsqueeze(1)).flatten(0, 1),
            "limb_axes": end - start,
            "limb_area": 2 * sizes[:, :1] * sizes[:, 2:] * share,
            "limb_cap": math.pi * sizes[:, :1].square() * share,
            "right": weights(JOINTS, RIGHTWARD),
            "trunk": weights(JOINTS, {"neck": 1.0}, {"right_hip": 0.5, "left_hip": 0.5}),
            "knees": weights(JOINTS, {"right_knee": 1.0}, {"left_knee": 1.0}),
            "ankles": weights(JOINTS, {"right_ankle": 1.0}, {"left_ankle": 1.0}),
            "torso_place": place,
            "torso_normal": normal,
            "torso_down": down.unsqueeze(-1),
            "torso_right": weights(JOINTS, *(_line_across(float(share)) for share in down)),
            "torso_area": area.repeat(ROWS),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (..., P, M, 14, 3) m and fade (..., P, M) to scatterers of one scene, person after person.

        Any range of pulses; P may be 0. Differentiable.

        Returns:
            Positions (..., M, K P, 3) m and cross sections (..., M, K P) m^2, K = ``points_per_person``.

        Raises:
            TensorsimError: wrong ranks or dtypes, or shapes that do not match.
        """
        check_people(positions, fade, 14)
        right = self.right.to(positions.dtype) @ positions
        limbs, limb_rcs = self._limbs(positions, right)
        torso, torso_rcs = self._torso(positions)
        head_rcs = torch.full_like(limb_rcs[..., :1], self.head_rcs)
        points = torch.cat((positions[..., :1, :], limbs, torso), -2)
        return one_scene(points, torch.cat((head_rcs, limb_rcs, torso_rcs), -1), fade)

    def _limbs(self, positions: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 10 n, 3) of the limbs and their cross sections (..., 10 n)."""
        ankle = self.ankles.to(positions.dtype) @ positions
        toes = toes_of(self.knees.to(positions.dtype) @ positions, ankle, right, self.toes_m, self.sole_m)
        body = torch.cat((positions, toes), -2)
        points = self.limb_points.to(positions.dtype) @ body
        axis = unit(self.limb_axes.to(positions.dtype) @ body)
        view = bisector(points, self.tx.to(positions.dtype), self.rx.to(positions.dtype))
        view = view.unflatten(-2, (-1, self.per_segment))
        end_on = (view * axis.unsqueeze(-2)).sum(-1).square()
        rcs = cylinder_rcs(self.limb_area.to(positions.dtype), end_on, self.limb_roughness)
        return points, (rcs + self.limb_cap.to(positions.dtype) * end_on).flatten(-2)

    def _torso(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., R C, 3) on the torso and their cross sections (..., R C)."""
        neck, hips = (self.trunk.to(positions.dtype) @ positions).split(1, -2)
        up = unit(neck - hips)
        right = self.torso_right.to(positions.dtype) @ positions  # (..., R, 3)
        across = unit(right - (right * up).sum(-1, keepdim=True) * up)
        frame = torch.stack((across, torch.cross(up.expand_as(across), across, dim=-1)), -2)  # right, forward
        middle = neck + self.torso_down.to(positions.dtype) * (hips - neck)
        points = (middle.unsqueeze(-2) + self.torso_place.to(positions.dtype) @ frame).flatten(-3, -2)
        normal = (self.torso_normal.to(positions.dtype) @ frame).flatten(-3, -2)
        view = bisector(points, self.tx.to(positions.dtype), self.rx.to(positions.dtype))
        facing = (normal * view).sum(-1)
        return points, patch_rcs(self.torso_area.to(positions.dtype), facing, self.torso_roughness)
