"""The camera."""

import math
from dataclasses import dataclass

from tensorsim.config.checks import (
    Vector,
    is_finite,
    make_plain,
    require_finite,
    require_positive,
    require_vector,
)
from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class CameraConfig:
    """A pinhole camera. By default it is at the radar and looks along +y, with its x axis level.

    Attributes:
        focal_px: focal length in pixels; None derives it from ``horizontal_fov_rad``.
        horizontal_fov_rad: horizontal field of view in radians, used when ``focal_px`` is None.
        center_px: principal point (u, v); None is the middle of the image, ((W - 1) / 2, (H - 1) / 2).
        position_m: position of the camera in the world.
        pitch_rad: upward tilt of the optical axis.
        yaw_rad: rotation of the optical axis from +y towards +x.
        roll_rad: rotation about the optical axis, positive = clockwise as the camera sees it, so that upright bodies
            lean to the left in its image.

    Raises:
        TensorsimError: an unphysical focal length or field of view, or a position, principal point or angle that is
            not finite.
    """

    focal_px: float | None = None
    horizontal_fov_rad: float = math.pi / 3
    center_px: tuple[float, float] | None = None
    position_m: Vector = (0.0, 0.0, 1.5)
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        make_plain(self)
        if self.focal_px is not None:
            require_positive("CameraConfig", focal_px=self.focal_px)
        if not (is_finite(self.horizontal_fov_rad) and 0 < self.horizontal_fov_rad < math.pi):
            raise TensorsimError(
                f"CameraConfig.horizontal_fov_rad: got {self.horizontal_fov_rad}, expected between 0 and pi"
            )
        require_vector("CameraConfig", position_m=self.position_m)
        center = self.center_px
        if center is not None and not (
            isinstance(center, tuple) and len(center) == 2 and all(is_finite(v) for v in center)
        ):
            raise TensorsimError(
                f"CameraConfig.center_px: got {center!r}, expected two finite numbers (u, v) or None"
            )
        require_finite(self, "pitch_rad", "yaw_rad", "roll_rad")
