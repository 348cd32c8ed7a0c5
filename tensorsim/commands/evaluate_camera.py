"""``tensorsim evaluate camera``: how well the camera is estimated from people who walk."""

from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

from tensorsim.exceptions import TensorsimError, check_count, check_seed

if TYPE_CHECKING:
    from tensorsim.evaluation.camera import CameraErrors

#: Standard deviation of an estimated field of view, in degrees, that separates well-determined walks from others.
FOV_SD_DEG = 4.0


@dataclass(frozen=True)
class EvaluateCamera:
    """Estimate known cameras from generated walks, and print the errors of tilt, field of view and range.

    One row per tilt and height, over all fields of view: the median and the maximum error of the camera that the
    pipeline uses, which shifts uncertain tilts towards level. Walks that are less than half in view are left out.
    """

    tilts: tuple[float, ...] = (0.0, 12.0, 24.0, 35.0)
    """Downward tilts in degrees."""
    heights: tuple[float, ...] = (0.8, 1.5, 3.0)
    """Heights in metres above the floor."""
    fovs: tuple[float, ...] = (40.0, 60.0, 90.0)
    """Horizontal fields of view in degrees."""
    walks: int = 5
    """Number of walks in front of each camera, each by a different person."""
    noise: float = 2.0
    """Standard deviation of the keypoint errors in pixels, for images of 640 x 480."""
    turn: float = 80.0
    """Angle in degrees by which people turn halfway through; 0 for straight walks."""
    known_height: bool = True
    """Use the true height of the person; otherwise assume 1.70 m."""
    seed: int = 0
    """Random seed for people and paths."""

    def run(self) -> None:
        """Run the command."""
        check_seed(self.seed, "--seed")
        if not (self.tilts and self.heights and self.fovs):
            raise TensorsimError(
                "evaluate camera: got no tilt, height or field of view, expected at least one each"
            )
        check_count(self.walks, "walks")
        if not 0 <= self.noise < float("inf"):
            raise TensorsimError(f"--noise: got {self.noise:g}, expected at least 0 pixels")

        from tensorsim.evaluation import camera as cameras

        print("| tilt | height | walks | tilt error | field of view error | range error |")
        print("| ---: | ---: | ---: | ---: | ---: | ---: |")
        found: list[CameraErrors] = []
        as_told: list[CameraErrors] = []
        seed = self.seed
        for tilt in self.tilts:
            for height in self.heights:
                row = []
                for fov in self.fovs:
                    camera = cameras.known_camera(tilt, height, fov)
                    for _ in range(self.walks):
                        seed += 1
                        walk = cameras.walk_before(camera, seed, self.turn)
                        if walk.seen >= cameras.LEAST_SEEN:
                            told = cameras.estimate(walk, self.noise, self.known_height, seed)
                            row.append(cameras.errors_of(cameras.used(told), camera, walk))
                            as_told.append(cameras.errors_of(told, camera, walk))
                if row:
                    print(f"| {tilt:.0f} | {height:.1f} m | {len(row)} | {self._errors(row)} |", flush=True)
                found += row
        if not found:
            raise TensorsimError("evaluate camera: got no camera with a walk in view, expected at least one")
        for what, rows in (
            ("", found),
            ("before uncertain tilts are drawn towards a level camera: ", as_told),
        ):
            tilts = sum(abs(one.pitch_deg) <= 2 for one in rows)
            print(
                f"{what}tilt within 2 degrees: {tilts} of {len(rows)}; range within 7 %: {self._right(rows)}"
            )
        narrow = [one for one in found if one.fov_sd_deg <= FOV_SD_DEG]
        wide = [one for one in found if one.fov_sd_deg > FOV_SD_DEG]
        print(
            f"range within 7 % where the standard deviation of the field of view is at most {FOV_SD_DEG:g} degrees: "
            f"{self._right(narrow)}; elsewhere {self._right(wide)}"
        )
        within = [sum(abs(one.fov_deg) <= k * one.fov_sd_deg for one in found) for k in (1, 2)]
        print(
            f"field of view within one standard deviation: {within[0]} of {len(found)} (68 % expected), "
            f"within two: {within[1]} (95 %)"
        )

    @staticmethod
    def _right(rows: "list[CameraErrors]") -> str:
        """How many ranges are within 7 %."""
        return f"{sum(abs(one.range) <= 0.07 for one in rows)} of {len(rows)}"

    @staticmethod
    def _errors(row: "list[CameraErrors]") -> str:
        """Median and largest errors of a row."""
        pitch = sorted(abs(one.pitch_deg) for one in row)
        fov = sorted(abs(one.fov_deg) for one in row)
        far = sorted(100 * abs(one.range) for one in row)
        return (
            f"{median(pitch):.1f}, {pitch[-1]:.1f} deg | {median(fov):.0f}, {fov[-1]:.0f} deg | "
            f"{median(far):.0f}, {far[-1]:.0f} %"
        )
