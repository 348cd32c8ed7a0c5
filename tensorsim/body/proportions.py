"""Lengths of the segments of a body as fractions of its height: the one place for these numbers.

Winter, *Biomechanics and Motor Control of Human Movement*, after Drillis and Contini, except the half widths of
shoulders and hips and the position of the nose, which are those of keypoints in pictures.
"""

from typing import NamedTuple

from torch import Tensor

ANKLE_HEIGHT = 0.039
SHANK = 0.246
THIGH = 0.245
TRUNK = 0.288
HALF_HIPS = 0.06
HALF_SHOULDERS = 0.105
UPPER_ARM = 0.186
FOREARM = 0.146
#: Position of the nose relative to the middle of the shoulders: forward and up.
NOSE_FORWARD = 0.06
NOSE_UP = 0.11
#: Height above the floor of a joint that rests on it; ankles have their own height.
FLESH = 0.045


class Proportions(NamedTuple):
    """Lengths of segments as fractions of the body height, each a number or a tensor (...).

    The defaults are the means; head and ankles keep the same fraction in every body.
    """

    shank: Tensor | float = SHANK
    thigh: Tensor | float = THIGH
    trunk: Tensor | float = TRUNK
    half_hips: Tensor | float = HALF_HIPS
    half_shoulders: Tensor | float = HALF_SHOULDERS
    upper_arm: Tensor | float = UPPER_ARM
    forearm: Tensor | float = FOREARM
