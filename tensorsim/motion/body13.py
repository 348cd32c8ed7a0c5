"""The 13-scatterer body of the first RadHARSimulator."""

from typing import NamedTuple

from torch import Tensor, nn

from tensorsim.config import JOINTS
from tensorsim.motion.scatterers import JointScatterers, check_people, weights


class Node(NamedTuple):
    """A point of the body.

    Attributes:
        name: name of the node.
        parent: the parent node; None for the root.
        rcs_m2: radar cross section in m^2.
        joints: names of ``tensorsim.JOINTS`` with their weights (sum 1); the node is their weighted mean.
    """

    name: str
    parent: str | None
    rcs_m2: float
    joints: dict[str, float]


#: Tree and cross sections of the author's open 13-scatterer walker. Its torso node is 0.3 above the hip and 0.2
#: below the shoulders (in units of 1 / 1.8 of the body height), and its hip is a single node.
NODES = (
    Node("torso", None, 1.0, {"neck": 0.6, "right_hip": 0.2, "left_hip": 0.2}),
    Node("head", "torso", 0.5, {"head": 1.0}),
    Node("hip", "torso", 0.1, {"right_hip": 0.5, "left_hip": 0.5}),
    Node("right_knee", "hip", 0.4, {"right_knee": 1.0}),
    Node("right_ankle", "right_knee", 0.3, {"right_ankle": 1.0}),
    Node("left_knee", "hip", 0.4, {"left_knee": 1.0}),
    Node("left_ankle", "left_knee", 0.3, {"left_ankle": 1.0}),
    Node("right_shoulder", "torso", 0.1, {"right_shoulder": 1.0}),
    Node("right_elbow", "right_shoulder", 0.3, {"right_elbow": 1.0}),
    Node("right_hand", "right_elbow", 0.2, {"right_wrist": 1.0}),
    Node("left_shoulder", "torso", 0.1, {"left_shoulder": 1.0}),
    Node("left_elbow", "left_shoulder", 0.3, {"left_elbow": 1.0}),
    Node("left_hand", "left_elbow", 0.2, {"left_wrist": 1.0}),
)


class Body13Scatterers(nn.Module):
    """13 point scatterers per person, placed by the 14 joints: see :data:`NODES`.

    Args:
        learnable: whether the cross sections are parameters, see
            :class:`~tensorsim.motion.scatterers.JointScatterers`.

    Example:
        >>> positions, fade = torch.randn(2, 3, 100, 14, 3), torch.ones(2, 3, 100)  # 2 scenes, 3 people, 100 pulses
        >>> points, rcs = Body13Scatterers()(positions, fade)
        >>> points.shape, rcs.shape
        (torch.Size([2, 100, 39, 3]), torch.Size([2, 100, 39]))
    """

    nodes: Tensor

    def __init__(self, learnable: bool = False) -> None:
        super().__init__()
        self.register_buffer("nodes", weights(JOINTS, *(node.joints for node in NODES)), persistent=False)
        self.points = JointScatterers([node.rcs_m2 for node in NODES], learnable)

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (..., P, M, 14, 3) m and fade (..., P, M) to a scene (..., M, 13 P, 3) m, (..., M, 13 P) m^2.

        Any range of pulses; P may be 0. Differentiable.

        Raises:
            TensorsimError: wrong ranks or dtypes, or shapes that do not match.
        """
        check_people(positions, fade, self.nodes.shape[1])
        scene, rcs = self.points(self.nodes.to(positions.dtype) @ positions, fade)
        return scene, rcs
