"""The compared ways from a clip to its maps: whole pipelines, and pipelines with one true stage."""

import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import PoseConfig, ProcessingConfig, SceneConfig, SimulationConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.evaluation.clips import Clip
from tensorsim.evaluation.films import CAMERA, FPS, Filmed, Observed, project, true_keypoints
from tensorsim.evaluation.scores import Maps
from tensorsim.model_files import manifest
from tensorsim.motion.scatterers import visibility_fade
from tensorsim.pipeline import PoseToDoppler, VideoToPose
from tensorsim.pipeline.networks import pretrained_lifter
from tensorsim.registry import shipped_weights
from tensorsim.types import Lifted
from tensorsim.vision.lifting.bone_fit import BoneFit
from tensorsim.vision.lifting.metric_pose import MetricPose
from tensorsim.vision.lifting.pose_library import SHIPPED_LIBRARY
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.smoothing.kalman import KalmanSmoother

#: Columns per second of range-time maps that have more pulses than that.
DISPLAY_RATE_HZ = 256.0
#: Configurations of the pipeline; the key is whether it follows the paper literally.
CONFIGS = {False: SimulationConfig(), True: SimulationConfig.paper()}
#: Variance in m^2 of joints from exact keypoints.
EXACT_NOISE = 1e-6
#: Stages in order; the first two matter only for films, the next three for films and keypoints.
STAGES = ("detector", "pose", "lifting", "position", "smoothing", "interpolation")
SOURCES = {
    "a": "true 3D joints at video rate",
    "b": "true 2D keypoints",
    "c": "networks on the rendered film",
}


@dataclass(frozen=True)
class Setting:
    """One way from a clip to its maps.

    Attributes:
        source: "a" starts from true joints at the frame rate, "b" from true keypoints, "c" from the film.
        paper: use the paper's literal formulas in every stage that has them.
        true_stage: the stage of ``STAGES`` that is replaced by the truth, or "".
    """

    source: str
    paper: bool = False
    true_stage: str = ""

    @property
    def name(self) -> str:
        """Its name in tables and files."""
        return (
            self.source
            + ("-paper" if self.paper else "")
            + (f"+{self.true_stage}" if self.true_stage else "")
        )


def lifting_files() -> dict[str, str]:
    """Digests of the shipped files used to lift keypoints: weights, and the poses for nearest matching."""
    poses = {entry["name"]: entry["sha256"] for entry in manifest() if entry["file"] == SHIPPED_LIBRARY}
    return shipped_weights("TemporalLifter") | poses


def true_lifting(clip: Clip) -> Lifted:
    """The output of a perfect lifter for the one person of a clip, shapes (1, T, ...)."""
    joints = clip.joints(FPS)
    view = project(joints)[2]
    pixels, reach = view.project(joints)
    depth = (reach - mid_hips(reach[..., None])) / clip.height_m
    scale = view.scale * clip.height_m / reach.mean(dim=-1)
    frames = len(joints)
    return Lifted(
        depth.float()[None],
        scale.float()[None],
        pixels.float()[None],
        torch.zeros(1, frames, dtype=torch.int64),
        torch.zeros(1, frames),
        torch.zeros(1, frames, 14),
    )


class _TrueLifter(nn.Module):
    def __init__(self, lifted: Lifted) -> None:
        super().__init__()
        self.lifted = lifted

    def forward(self, keypoints: Tensor, weights: Tensor) -> Lifted:
        return Lifted(*(field[None] for field in self.lifted))


class _TruePosition(nn.Module):
    """Moves the output of a stage so that the hips are at their true position."""

    def __init__(self, stage: nn.Module, joints: Tensor) -> None:
        super().__init__()
        self.stage, self.joints = stage, joints

    def forward(self, *arguments: object) -> Tensor | tuple[Tensor, Tensor]:
        result = self.stage(*arguments)
        placed = result if isinstance(result, Tensor) else result[0]
        moved = placed + (mid_hips(self.joints.to(placed)) - mid_hips(placed))[..., None, :]
        return moved if isinstance(result, Tensor) else (moved, result[1])


class _TrueSmoothing(nn.Module):
    """Smooths only the error; the true motion passes unchanged."""

    def __init__(self, stage: nn.Module, joints: Tensor) -> None:
        super().__init__()
        self.stage, self.joints = stage, joints

    def forward(self, joints: Tensor, valid: Tensor, fps: float, noise_std_m: Tensor) -> Tensor:
        truth = self.joints.to(joints)
        return truth + self.stage(joints - truth, valid, fps, noise_std_m)


class Pipelines:
    """The pipelines of every setting, from joints, keypoints or films to the maps of every scene.

    Args:
        scenes: scenes by name.
        lifter: lifter of settings other than the paper's; None is the default one.
    """

    def __init__(self, scenes: dict[str, SceneConfig], lifter: PoseConfig | None = None) -> None:
        self.scenes = scenes
        self.lifters = {
            paper: pretrained_lifter(config.pose if paper or lifter is None else lifter)
            for paper, config in CONFIGS.items()
        }
        self.radars = {
            (name, paper): _pose_to_doppler(scene, paper)
            for name, scene in scenes.items()
            for paper in (False, True)
        }

    def speed_m_s(self, scene: str) -> Tensor:
        """(F,) radial speed of the Doppler bins of a scene."""
        simulator = self.radars[scene, False].simulator
        return simulator.doppler.doppler_hz * (simulator.radar.doppler_wavelength_m / 2)

    def joints(self, setting: Setting, clip: Clip, film: Filmed | None) -> tuple[Tensor, Tensor]:
        """Joints (P, T, 14, 3) at the frame rate and whether people are present (P, T).

        Args:
            setting: the way to the joints.
            clip: the truth.
            film: needed for source "c".
        """
        truth = clip.joints(FPS)
        if setting.source == "a":
            joints = truth[None][: int(clip.present)]
            valid = torch.ones(joints.shape[:2], dtype=torch.bool)
            # Exact joints need no smoothing and get none, like those of motion files.
            return _smoother(setting, truth)(joints, None, FPS) if setting.paper else joints, valid
        return self.lifted(setting, clip, self._observed(setting, clip, film))

    def lifted(self, setting: Setting, clip: Clip, observed: Observed) -> tuple[Tensor, Tensor]:
        """Joints and presence, as :meth:`joints`, of people observed in the picture."""
        if observed.valid.shape[0] == 0:
            return torch.zeros(0, observed.valid.shape[1], 14, 3), observed.valid
        if setting.true_stage in ("lifting", "position", "smoothing"):  # the truth has one person only
            longest = int(observed.valid.sum(dim=-1).argmax())
            observed = Observed(*(field[longest : longest + 1] for field in observed))
        stage = self._video_to_pose(setting, clip, clip.joints(FPS))
        with torch.inference_mode():
            return observed.lifted_by(stage)

    def maps(self, setting: Setting, scene: str, clip: Clip, joints: Tensor, valid: Tensor) -> Maps:
        """The maps of joints at the frame rate; those of an empty scene where there are none.

        Raises:
            TensorsimError: motion that is too fast for the radar of the scene.
        """
        stage = self.radars[scene, setting.paper]
        pulses = stage.resampler.pulses(valid.shape[-1], FPS)
        positions = stage.pulse_smoother(stage.resampler(joints, FPS)) if len(joints) else joints.double()
        if setting.true_stage == "interpolation" and len(joints):
            rate = stage.simulator.radar.prf_hz
            exact = clip.joints(rate)
            positions = positions + exact - stage.resampler(clip.joints(FPS), FPS)
        return self._simulate(stage, positions, valid, pulses)

    def truth(self, scene: str, clip: Clip) -> Maps:
        """The maps of the true joints, evaluated at every pulse.

        Raises:
            TensorsimError: motion that is too fast for the radar of the scene.
        """
        stage = self.radars[scene, False]
        positions = clip.joints(stage.simulator.radar.prf_hz)[None]
        valid = torch.full((1, round(clip.duration_s * FPS)), clip.present)
        return self._simulate(stage, positions, valid, positions.shape[1])

    def _simulate(self, stage: PoseToDoppler, positions: Tensor, valid: Tensor, pulses: int) -> Maps:
        if len(positions) == 0:  # nobody: one scatterer without an echo
            positions, valid = (
                torch.ones(1, pulses, 14, 3, dtype=torch.float64),
                valid.new_zeros(1, valid.shape[-1]),
            )
        fade = visibility_fade(valid, FPS, stage.simulator.radar.prf_hz, 0, pulses)
        with torch.inference_mode(), warnings.catch_warnings():
            warnings.simplefilter("ignore", TensorsimWarning)  # limbs that alias also do so in the truth
            return Maps.of(stage.simulator(*stage.scatterers(positions, fade)))

    def _observed(self, setting: Setting, clip: Clip, film: Filmed | None) -> Observed:
        if setting.source == "b":
            return true_keypoints(clip)
        if film is None:
            raise TensorsimError(f"setting {setting.name}: got no film, expected one")
        if setting.true_stage == "detector":
            return film.boxed
        if setting.true_stage != "pose":
            return film.found
        true = true_keypoints(clip)
        if film.found.valid.shape[0] == 0 or not clip.present:
            return film.found
        longest = int(film.found.valid.sum(dim=-1).argmax())
        valid = film.found.valid[longest : longest + 1] & true.valid
        return Observed(film.found.boxes[longest : longest + 1], valid, true.keypoints, true.scores)

    def _video_to_pose(self, setting: Setting, clip: Clip, truth: Tensor) -> VideoToPose:
        # The camera is known, and so is the height of the body, which users also give to the pipeline.
        distance = (float(mid_hips(truth)[0, 1]) - CAMERA.position_m[1],) if setting.paper else None
        place: nn.Module = MetricPose(
            CAMERA,
            (clip.height_m,),
            distance,
            mode=CONFIGS[setting.paper].pose.position,
            calibrated=_is_exact(setting),
        )
        if setting.paper:
            place = _Shifted(place, CAMERA.position_m[1])
        if setting.true_stage == "position":
            place = _TruePosition(place, truth)
        lifter: nn.Module = self.lifters[setting.paper]
        if isinstance(lifter, TemporalLifter):
            lifter = lifter.seen_by(CAMERA, (clip.height_m,))
        if setting.true_stage == "lifting":
            lifter = _TrueLifter(true_lifting(clip))
        fit: nn.Module | None = None
        if _is_exact(setting):
            fit = BoneFit(CAMERA.position_m, (clip.height_m,), calibrated=True)
            if setting.true_stage == "lifting":  # true depths need no correction
                fit = None
            elif setting.true_stage == "position":
                fit = _TruePosition(fit, truth)
        nothing = nn.Identity()
        return VideoToPose(
            nothing,
            nothing,
            lifter=lifter,
            metric_pose=place,
            smoother=_smoother(setting, truth),
            bone_fit=fit,
        ).eval()


class _Shifted(nn.Module):
    """The paper's position is relative to the camera: adds the y of the camera."""

    def __init__(self, stage: nn.Module, y_m: float) -> None:
        super().__init__()
        self.stage, self.y_m = stage, y_m

    def forward(self, *arguments: object) -> tuple[Tensor, Tensor]:
        placed, seen = self.stage(*arguments)
        return placed + placed.new_tensor([0.0, self.y_m, 0.0]), seen


def _is_exact(setting: Setting) -> bool:
    """Whether keypoints are exact; the pipeline is then told so, as for labelled ones."""
    return not setting.paper and (setting.source == "b" or setting.true_stage == "pose")


def _smoother(setting: Setting, truth: Tensor) -> nn.Module:
    smoother: nn.Module = KalmanSmoother(mode=CONFIGS[setting.paper].smoothing.mode)
    if _is_exact(setting):
        smoother = KalmanSmoother(measurement_noise=EXACT_NOISE)
    return _TrueSmoothing(smoother, truth) if setting.true_stage == "smoothing" else smoother


def _pose_to_doppler(scene: SceneConfig, paper: bool) -> PoseToDoppler:
    """The radar stage of a scene, without noise, which would be the same in all maps."""
    rate_hz = DISPLAY_RATE_HZ if scene.radar.prf_hz > DISPLAY_RATE_HZ else None
    config = SimulationConfig(replace(scene, snr_db=None), ProcessingConfig(display_rate_hz=rate_hz))
    return PoseToDoppler.from_config(SimulationConfig.paper(config) if paper else config)
