"""Shadowing of people by others in front of them."""

import torch
from torch import Tensor, nn

from tensorsim.config import JOINTS, Vector
from tensorsim.errors import check_not_negative, check_positive
from tensorsim.motion.scatterers import check_antenna, check_people, weights


def segment_distance(origin: Tensor, ends: Tensor, start: Tensor, stop: Tensor) -> Tensor:
    """Shortest distance from segments ``origin`` - ``ends`` to segments ``start`` - ``stop``.

    The minimum of a quadratic over two parameters in [0, 1] (Ericson, *Real-Time Collision Detection*, 5.1.9),
    written with scalar products only, so that no vector per pair is stored.

    Args:
        origin: (3,) common end of the first segments, metres.
        ends: (..., S, 3) their other ends.
        start, stop: (..., Q, 3) ends of the second segments.

    Returns:
        (..., S, Q) metres, at least 1e-4. Differentiable.
    """
    ray = ends - origin
    axis, offset = stop - start, origin - start
    ray2 = ray.square().sum(-1, keepdim=True).clamp_min(1e-12)
    axis2 = axis.square().sum(-1).unsqueeze(-2).clamp_min(1e-12)
    ray_axis = ray @ axis.transpose(-1, -2)
    ray_offset = ray @ offset.transpose(-1, -2)
    axis_offset = (axis * offset).sum(-1).unsqueeze(-2)

    parallel = (ray2 * axis2 - ray_axis.square()).clamp_min(1e-12)
    s = ((ray_axis * axis_offset - ray_offset * axis2) / parallel).clamp(0.0, 1.0)
    t = ((ray_axis * s + axis_offset) / axis2).clamp(0.0, 1.0)
    s = ((ray_axis * t - ray_offset) / ray2).clamp(0.0, 1.0)
    square = (
        offset.square().sum(-1).unsqueeze(-2)
        + s.square() * ray2
        + t.square() * axis2
        + 2 * (s * ray_offset - t * axis_offset - s * t * ray_axis)
    )
    return square.clamp_min(1e-8).sqrt()


class Shadowing(nn.Module):
    """A scatterer model whose people shadow each other.

    The torso of a person is a capsule about the line from the neck to the middle of the hips. A leg (from the
    transmitter to a scatterer, or back to the receiver) that comes closer to the axis of somebody else's torso
    than ``radius_m`` loses ``attenuation_db``, both legs together twice that; losses of several people add up. Nobody
    shadows themselves, and people who fade in or out cast a shadow in proportion to their visibility.
    There is no diffraction around the capsule, and scatterers inside it (an embrace) are shadowed.

    Args:
        scatterers: the model, joints -> scatterers of one scene, person after person, with the same number each.
        tx_m, rx_m: transmitter and receiver in metres (for an array, its centre).
        attenuation_db: one-way loss of power behind a body; measured at 60 GHz: 20 dB and more (Collonge,
            Zaharia and El Zein, IEEE Trans. Wireless Commun. 3, 2004).
        radius_m: radius of the capsule.
        edge_m: softness of its edge. At the edge the loss in dB is half, and falls from 9/10 to 1/10 within 4.4
            times this; the default is about a Fresnel zone at 77 GHz and 3 m. 0 is a hard edge, whose
            position has no gradient.

    Example:
        >>> positions, fade = torch.randn(2, 3, 100, 14, 3), torch.ones(2, 3, 100)  # 2 scenes, 3 people, 100 pulses
        >>> stage = Shadowing(ts.motion.JointScatterers(), tx_m=(-0.1, 0.0, 1.5), rx_m=(0.1, 0.0, 1.5))
        >>> points, rcs = stage(positions, fade)
        >>> points.shape, rcs.shape
        (torch.Size([2, 100, 42, 3]), torch.Size([2, 100, 42]))

    Raises:
        TensorsimError: an antenna without three finite numbers, a loss or an edge below 0, a radius not
            positive.
    """

    tx: Tensor
    rx: Tensor
    trunk: Tensor

    def __init__(
        self,
        scatterers: nn.Module,
        tx_m: Vector,
        rx_m: Vector,
        attenuation_db: float = 20.0,
        radius_m: float = 0.15,
        edge_m: float = 0.02,
    ) -> None:
        super().__init__()
        check_antenna("tx_m", tx_m)
        check_antenna("rx_m", rx_m)
        check_positive(radius_m, "radius_m")
        for name, value in (("attenuation_db", attenuation_db), ("edge_m", edge_m)):
            check_not_negative(value, name)
        self.scatterers = scatterers
        self.attenuation_db = attenuation_db
        self.radius_m = radius_m
        self.edge_m = edge_m
        trunk = weights(JOINTS, {"neck": 1.0}, {"right_hip": 0.5, "left_hip": 0.5})
        self.register_buffer("trunk", trunk, persistent=False)
        self.register_buffer("tx", torch.tensor(tx_m, dtype=torch.float64), persistent=False)
        self.register_buffer("rx", torch.tensor(rx_m, dtype=torch.float64), persistent=False)

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (..., P, M, 14, 3) m and fade (..., P, M) to the scene of the scatterer model, shadowed.

        Any range of pulses; P may be 0. Differentiable.

        Raises:
            TensorsimError: wrong ranks or dtypes, or shapes that do not match.
        """
        check_people(positions, fade, 14)
        scene, rcs = self.scatterers(positions, fade)
        people = positions.shape[-4]
        if people < 2:
            return scene, rcs
        neck, hips = (self.trunk.to(scene.dtype) @ positions).transpose(-4, -3).unbind(-2)
        blocked = self._blocked(self.tx.to(scene.dtype), scene, neck, hips)
        blocked = blocked + self._blocked(self.rx.to(scene.dtype), scene, neck, hips)

        someone_else = 1 - torch.eye(people, dtype=scene.dtype, device=scene.device)
        someone_else = someone_else.repeat_interleave(scene.shape[-2] // people, 0)
        seen = fade.to(scene.dtype).transpose(-2, -1).unsqueeze(-2)
        loss_db = self.attenuation_db * (blocked * someone_else * seen).sum(-1)
        return scene, rcs * 10 ** (-loss_db / 10)

    def _blocked(self, antenna: Tensor, scene: Tensor, neck: Tensor, hips: Tensor) -> Tensor:
        """How much the torsos (..., Q, 3) block the legs from (3,) to (..., S, 3): (..., S, Q) in [0, 1]."""
        inside = self.radius_m - segment_distance(antenna, scene, neck, hips)
        if self.edge_m == 0.0:
            return (inside > 0).to(inside.dtype)
        return torch.sigmoid(inside / self.edge_m)
