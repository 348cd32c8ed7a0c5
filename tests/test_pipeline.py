"""The whole graph on a film with known truth, and scripted in a process without tensorsim."""

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import trunk_uprightness
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.geometry.framing import keypoint_boxes, seen_keypoints
from tensorsim.motion import JointScatterers
from tensorsim.pipeline import PoseToDoppler, VideoToActivity, VideoToDoppler, VideoToPose
from tensorsim.pipeline.pose import joined
from tensorsim.streaming import maps_of_pose
from tensorsim.summary import people_of
from tensorsim.vision.lifting.bone_fit import BoneFit
from tensorsim.vision.pose2d.topdown import FlipTest, TopDownPose
from tests.film import RectangleDetector, StandingPose, film, walker
from tests.stage import StageTester, assert_same

FPS = 10.0
RADAR = ts.RadarConfig.through_wall()  # 128 Hz: small maps


def pipeline(**options: object) -> VideoToDoppler:
    """With nearest matching: the network of the default lifter has never seen a rigid body glide at 10 frames/s."""
    people = {name: options.pop(name) for name in ("camera", "initial_distance_m") if name in options}
    heights = options.pop("person_height_m", (1.75,))
    stage = VideoToPose(
        RectangleDetector(),
        StandingPose(),
        heights,
        lifter=ts.vision.NearestPoseLifter(),
        **people,  # type: ignore[arg-type]
    )
    options = {"radar": RADAR, "snr_db": None} | options
    return VideoToDoppler(video_to_pose=stage, **options).eval()  # type: ignore[arg-type]


def two_clips() -> Tensor:
    """One clip with one person, one with two: (2, 20, 3, H, W)."""
    away, away_x = walker(20, FPS, 4.0, 1.2, -0.8)
    near, near_x = walker(20, FPS, 7.0, -0.5, 1.2)
    one = film(away, away_x)
    two = film(torch.cat((away, near)), torch.cat((away_x, near_x)))
    return torch.stack((one, two))


class TestPoseToDoppler(StageTester):
    batched_arguments = (0, 1)
    batch_shapes = ((3,),)
    gradient_arguments = (0,)
    gradient_atol = 1e-4
    batch_atol = 1e-4
    exports = False  # what a clip shows is checked against the PRF, which needs values

    def make(self) -> PoseToDoppler:
        # Noise of a fixed level is not wanted here, but for finite differences: without it magnitudes have kinks.
        return PoseToDoppler(ts.radar.RadarSimulator(RADAR, wall=ts.WallConfig(), snr_db=None))

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        body = torch.randn((*batch, 2, 1, 14, 3), generator=generator, dtype=dtype) * 0.3
        t = torch.arange(6, dtype=dtype)[:, None, None] / FPS
        velocity = torch.tensor([0.3, 0.8, 0.0], dtype=dtype)
        joints = body + torch.tensor([0.0, 4.0, 1.0], dtype=dtype) + velocity * t
        valid = torch.ones((*batch, 2, 6), dtype=torch.bool)
        valid[..., 1, 4:] = False
        return joints, valid, FPS

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, valid, fps = self.inputs((1,), torch.float32)
        return [
            ((joints[:, :, :1], valid[:, :, :1], fps), "2"),
            ((joints[..., :2], valid, fps), "3"),
            ((joints, valid.float(), fps), "bool"),
            ((joints, valid, -1.0), "fps"),
            ((joints * math.nan, valid, fps), "NaN"),
            ((joints + 2.0 * torch.arange(6).reshape(6, 1, 1), valid, fps), "PRF"),
        ]


class TestVideoToDoppler(StageTester):
    batch_shapes = ((2,),)
    gradient_arguments = ()  # detection, tracking and the search for poses are not differentiable
    float64 = False  # networks run in one precision
    exports = False  # the number of people depends on the video
    batch_atol = script_atol = 1e-4

    def make(self) -> VideoToDoppler:
        return pipeline(wall=ts.WallConfig(), multipath=True)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        clip = film(*walker(8, FPS, 5.0, 0.9, 0.2))
        return clip.to(dtype).div(255).expand(*batch, *clip.shape).clone(), FPS

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        (video, fps) = self.inputs((2,), torch.float32)
        return [
            ((video[0], fps), r"video: got shape \[8, 3, 240, 320\], expected \(B, T, 3, H, W\)"),
            ((video[:, :, :1], fps), r"expected \(B, T, 3, H, W\)"),
            ((video[:, :1], fps), "at least 2 frames"),
            ((video[:, :0], fps), "at least 2 frames"),
            ((video[:0], fps), "at least 1 clip"),
            ((video, 0.0), "fps: got 0.0"),
            ((video, math.nan), "fps: got nan"),
            ((video, fps, torch.tensor([0, 8])), "expected 2 counts from 1 to 8"),
        ]


class TestVideoToActivity(TestVideoToDoppler):
    def make(self) -> VideoToActivity:  # type: ignore[override]
        torch.manual_seed(0)
        recognizer = ts.recognition.ActivityRecognizer(RADAR, ts.recognition.SPGNet(), size=32)
        return VideoToActivity(pipeline(wall=ts.WallConfig()), recognizer).eval()


def test_activity_adds_logits_to_the_simulation() -> None:
    graph, clips = TestVideoToActivity().make(), two_clips()
    found, simulation = graph(clips, FPS), graph.video_to_doppler(clips, FPS)
    assert found._fields == (*simulation._fields, "logits")
    assert_same(tuple(found[:-1]), tuple(simulation))
    assert found.logits.shape == (2, len(ts.ACTIVITIES))
    assert not torch.equal(found.logits[0], found.logits[1])


def test_networks_must_be_given_or_replaced() -> None:
    with pytest.raises(TensorsimError, match=r"got no detector.*VideoToDoppler\.from_pretrained\(\)"):
        VideoToDoppler(RectangleDetector())


def test_shipped_networks_look_into_the_mirror_unless_told_not_to() -> None:
    asked_twice = VideoToDoppler.from_pretrained().video_to_pose.pose.network
    assert isinstance(asked_twice, FlipTest)
    once = VideoToDoppler.from_pretrained(flip_test=False).video_to_pose.pose.network
    crops = torch.rand(1, 3, 128, 96)
    assert torch.equal(asked_twice.network(crops), once(crops))
    assert not torch.equal(asked_twice(crops), once(crops))


def test_a_pretrained_detector_may_be_of_another_kind() -> None:
    graph = VideoToActivity.from_pretrained("acf-person").video_to_doppler
    assert isinstance(graph.video_to_pose.detector, ts.vision.AcfDetector)


@pytest.mark.parametrize(
    "make",
    [
        lambda: VideoToActivity.from_pretrained(),
        lambda: VideoToActivity.from_config(ts.SimulationConfig().replace(processing__denoiser="dncnn")),
    ],
)
def test_pretrained_networks_are_frozen(make: Callable[[], VideoToActivity]) -> None:
    assert not [name for name, values in make().named_parameters() if values.requires_grad]


def test_a_learnable_scene_in_a_pretrained_graph_still_learns() -> None:
    stage = PoseToDoppler(ts.radar.RadarSimulator(RADAR), scatterers=JointScatterers(learnable=True))
    graph = VideoToDoppler.from_pretrained(pose_to_doppler=stage)
    assert all(values.requires_grad for values in graph.pose_to_doppler.parameters())


def test_a_person_who_walks_away_is_where_they_are_and_recedes() -> None:
    frames = 40
    range_m, x_m = walker(frames, FPS, 4.0, 1.2, 0.5)
    out = pipeline()(film(range_m, x_m).unsqueeze(0), FPS)
    assert out.boxes.shape == (1, 1, frames, 4)
    assert out.valid.all()
    hips = out.joints[0, 0][:, [8, 11]].mean(dim=1)
    assert torch.allclose(hips[:, 1], range_m[0], atol=0.35), "range"
    assert torch.allclose(hips[:, 0], x_m[0], atol=0.1), "azimuth"
    feet = out.joints[0, 0][:, [10, 13], 2]
    assert feet.abs().max() < 0.15, "feet on the floor"
    stage = pipeline()
    doppler_hz = stage.pose_to_doppler.simulator.doppler.doppler_hz
    middle = out.doppler_time[0][:, out.doppler_time.shape[-1] // 4 : -out.doppler_time.shape[-1] // 4]
    peak_hz = float(doppler_hz[middle.square().mean(dim=-1).argmax()])
    assert peak_hz == pytest.approx(-2 * 1.2 / RADAR.doppler_wavelength_m, abs=8.0), "receding is negative"


def test_the_range_line_moves_with_the_person() -> None:
    range_m, x_m = walker(40, FPS, 4.0, 1.2, 0.0)
    out = pipeline()(film(range_m, x_m).unsqueeze(0), FPS)
    line_m = out.range_time[0].argmax(dim=0) * RADAR.range_resolution_m
    assert float(line_m[-1] - line_m[0]) == pytest.approx(1.2 * 3.9, abs=0.5)


def test_two_people_are_one_scene() -> None:
    out = pipeline()(two_clips()[1:], FPS)
    assert out.boxes.shape[1] == 2
    stage = pipeline()
    maps = [
        stage.pose_to_doppler(out.joints[:, p : p + 1], out.valid[:, p : p + 1], FPS).range_time
        for p in range(2)
    ]
    lines = [m[0, :, 100].argmax() for m in maps]
    assert abs(int(lines[0] - lines[1])) > 3
    both = out.range_time[0, :, 100]
    for own, line in zip(maps, lines, strict=True):
        assert both[line] == pytest.approx(float(own[0, line, 100]), rel=0.35)


def test_batch_equals_loop_with_people_padded() -> None:
    stage, clips = pipeline(), two_clips()
    both = stage(clips, FPS)
    assert both.valid.shape == (2, 2, 20)
    assert not both.valid[0, 1].any()
    for i, people in enumerate((1, 2)):
        single = stage(clips[i : i + 1], FPS)
        assert single.boxes.shape[1] == people
        assert_same([f[:, :people] for f in single[:5]], [f[i : i + 1, :people] for f in both[:5]], atol=1e-5)
        assert_same(single[5:], [f[i : i + 1] for f in both[5:]], atol=1e-4)


def test_a_foot_alone_at_the_end_of_a_track_does_not_fold_the_body() -> None:
    stage = pipeline().video_to_pose
    whole = stage(film(*walker(20, FPS, 4.0, 0.5, 0.0)).unsqueeze(0), FPS)
    tracks = ts.Tracks(whole.boxes, whole.valid, whole.valid)
    scores = whole.keypoint_scores.clone()
    scores[:, :, 16:, :15] = 0.1  # the ankles alone pass the threshold
    joints = stage.lift(tracks, whole.keypoints, scores, 240, 320, FPS).joints
    assert_same(joints[:, :, :10], whole.joints[:, :, :10], atol=0.02)
    hips = joints[0, 0, 16:, [8, 11], 2]
    assert hips.min() > 0.7
    assert (joints[0, 0, 16:, 8, 1].diff() > 0).all(), "goes on walking away"


class MeasuredFrames(nn.Module):
    """A smoother that records which frames of which joints were passed as measured."""

    def __init__(self, smoother: nn.Module) -> None:
        super().__init__()
        self.smoother, self.measured = smoother, torch.empty(0)

    def forward(self, joints: Tensor, measured: Tensor, fps: float, noise: Tensor) -> Tensor:
        self.measured = measured
        return self.smoother(joints, measured, fps, noise)


def test_brief_gaps_of_a_joint_are_predicted_and_longer_ones_are_not() -> None:
    """A quarter of a second is two frames here: the smoother coasts through those, and takes the matched pose else."""
    stage = pipeline().video_to_pose
    whole = stage(film(*walker(20, FPS, 4.0, 0.5, 0.0)).unsqueeze(0), FPS)
    stage.smoother = MeasuredFrames(stage.smoother)
    scores = whole.keypoint_scores.clone()
    scores[:, :, 6:8, 10] = 0.0  # the right wrist for two frames
    scores[:, :, 6:9, 9] = 0.0  # the left one for three
    tracks = ts.Tracks(whole.boxes, whole.valid, whole.valid)
    stage.lift(tracks, whole.keypoints, scores, 240, 320, FPS)
    expected = torch.ones(20, 14, dtype=torch.bool)
    expected[6:8, JOINTS.index("right_wrist")] = False
    assert torch.equal(stage.smoother.measured[0, 0], expected)


# At 6 m/s two poses of the library fit equally well, and a thousandth of a pixel decides how far away the figure is.
@pytest.mark.parametrize(
    ("speed_m_s", "decode", "there"),
    [(0.5, "expected", True), (0.5, "dark", True), (6.0, "dark", False), (8.0, "expected", False)],
)
def test_nobody_runs_while_hidden(speed_m_s: float, decode: str, there: bool) -> None:
    """A person is hidden for half a second and then stands elsewhere."""
    stage = pipeline().video_to_pose
    stage.pose = TopDownPose(StandingPose(), decode, flip_test=True, stand_up=True)
    gone = slice(8, 13)
    start, stop = (
        stage(film(*walker(20, FPS, range_m, 0.0, 0.0)).unsqueeze(0), FPS)
        for range_m in (4.0, 4.0 + 0.6 * speed_m_s)
    )
    later = (torch.arange(20) >= 10)[:, None]
    keypoints = torch.where(later[..., None], stop.keypoints, start.keypoints)
    scores = torch.where(later, stop.keypoint_scores, start.keypoint_scores)
    boxes = torch.where(later, stop.boxes, start.boxes)
    scores[:, :, gone] = 0.0
    pose = stage.lift(ts.Tracks(boxes, start.valid, start.valid), keypoints, scores, 240, 320, FPS)
    assert bool(pose.valid[:, :, gone].all()) == bool(pose.valid[:, :, gone].any()) == there
    assert pose.valid[:, :, : gone.start].all()
    assert pose.valid[:, :, gone.stop :].all()


@pytest.mark.parametrize(
    ("good", "is_person"), [(slice(0, 11), True), (slice(0, 10), False), (slice(0, 60, 4), True)]
)
def test_a_person_is_seen_for_a_second_or_often(good: slice, is_person: bool) -> None:
    """Tracks of six seconds: a person who falls and lies, furniture, a person in the dark."""
    scores = torch.full((1, 1, 60, 17), 0.4)
    scores[:, :, good] = 0.8
    stage = pipeline().video_to_pose
    assert bool(stage.is_person(scores, torch.ones(1, 1, 60, dtype=torch.bool), FPS)) == is_person


def test_a_track_that_shows_no_joint_is_nobody() -> None:
    stage = pipeline().video_to_pose
    whole = stage(film(*walker(20, FPS, 4.0, 0.5, 0.0)).unsqueeze(0), FPS)
    tracks = ts.Tracks(whole.boxes, whole.valid, whole.valid)
    pose = stage.lift(tracks, whole.keypoints, 0.2 * whole.keypoint_scores, 240, 320, FPS)
    assert not pose.valid.any()
    assert torch.isfinite(pose.joints).all()
    assert people_of(pose, FPS, RADAR) == []
    assert people_of(whole, FPS, RADAR)[0]["last_frame"] == 19


def test_a_graph_does_not_estimate_the_camera_and_says_so() -> None:
    config = ts.SimulationConfig().replace(pose__calibrate=True)
    with pytest.warns(TensorsimWarning, match=r"pose\.calibrate is ignored here"):
        VideoToDoppler.from_config(config, RectangleDetector(), StandingPose())


def test_joints_without_people_are_refused() -> None:
    stage = PoseToDoppler(ts.radar.RadarSimulator(RADAR))
    with pytest.raises(
        TensorsimError, match=r"joints: got shape \[1, 30, 14, 3\], expected \(B, P, T, 14, 3\)"
    ):
        stage(torch.zeros(1, 30, 14, 3), torch.ones(1, 30, dtype=torch.bool), FPS)


def test_ranges_of_people_are_those_from_the_antennas() -> None:
    """The antennas are 1.5 m above the origin; who walks past does not come nearer by as much as along y."""
    joints = torch.zeros(1, 1, 21, 14, 3)
    joints[..., 0], joints[..., 1], joints[..., 2] = torch.linspace(-3.0, -1.0, 21)[:, None], 1.2, 1.3
    there = torch.ones(1, 1, 21, dtype=torch.bool)
    blank = torch.zeros(1, 1, 21, 17, 2)
    row = people_of(ts.Pose(torch.zeros(1, 1, 21, 4), blank, blank[..., 0], joints, there), FPS, RADAR)[0]
    x_m = np.linspace(-3.0, -1.0, 21) - RADAR.middle_m[0]
    range_m = np.sqrt(x_m**2 + (1.2 - RADAR.middle_m[1]) ** 2 + (1.3 - RADAR.middle_m[2]) ** 2)
    assert row["mean_range_m"] == pytest.approx(range_m.mean(), abs=1e-3)
    assert row["mean_approach_m_s"] == pytest.approx((range_m[0] - range_m[-1]) / (20 / FPS), abs=1e-3)


class AsManyAsThereAre(nn.Module):
    """Finds in all images of a call as many boxes, possibly none, as the value of the brightest pixel."""

    def forward(self, images: Tensor) -> ts.types.Detections:
        count, most = images.shape[0], int(images.max())
        box = torch.tensor([10.0, 10.0, 40.0, 100.0]).expand(count, most, 4)
        scores = torch.full((count, most), 0.9)
        labels = torch.zeros(count, most, dtype=torch.int64)
        return ts.types.Detections(box, scores, labels, scores > 0)


def test_a_detector_may_pad_every_call_to_another_count() -> None:
    stage = VideoToPose(AsManyAsThereAre(), StandingPose(), frames_per_batch=2).eval()
    frames = torch.tensor([1, 1, 0, 0, 3, 3], dtype=torch.uint8).reshape(6, 1, 1, 1).expand(6, 3, 8, 8)
    found = stage.detect(frames)
    assert found.valid.sum(dim=1).tolist() == [1, 1, 0, 0, 3, 3]
    assert found.boxes[..., 3].tolist() == [[100.0 * there for there in row] for row in found.valid.tolist()]
    parts = [found, ts.types.Detections(*(field[:, :1] for field in found))]
    assert_same(torch.jit.script(joined)(parts), joined(parts))


class FlatPose(nn.Module):
    """A metric pose that is no MetricPose: everybody stands in a plane 4 m away."""

    def forward(
        self,
        keypoints: Tensor,
        scores: Tensor,
        lifted: ts.types.Lifted,
        valid: Tensor,
        image_height: int,
        image_width: int,
        fps: float,
    ) -> tuple[Tensor, Tensor]:
        u, v = (keypoints / image_height).unbind(-1)
        return torch.stack([u, torch.full_like(u, 4.0), 2.0 - v], dim=-1), valid[..., None].expand_as(scores)


def test_a_metric_pose_of_ones_own_replaces_the_default() -> None:
    clip = two_clips()[:1]
    stage = VideoToPose(RectangleDetector(), StandingPose(), metric_pose=FlatPose()).eval()
    found = stage(clip, FPS)
    torch.testing.assert_close(
        found.joints[0, 0, :, :, 1], torch.full((20, 14), 4.0).to(found.joints), atol=1e-6, rtol=0
    )
    assert_same(torch.jit.script(stage)(clip, FPS).joints, found.joints)


def test_a_corrected_range_rate_scripts() -> None:
    clip = two_clips()[:1]
    stage = VideoToPose(RectangleDetector(), StandingPose(), range_rate=True).eval()
    assert_same(torch.jit.script(stage)(clip, FPS).joints, stage(clip, FPS).joints, atol=1e-6)


def test_padded_frames_do_not_count() -> None:
    stage, clips = VideoToPose(RectangleDetector(), StandingPose()).eval(), two_clips()
    graph = VideoToDoppler(video_to_pose=stage, radar=RADAR, snr_db=None)
    padded = clips.clone()
    padded[0, 12:] = 255  # rubbish in the padding
    out = graph(padded, FPS, torch.tensor([12, 20]))
    assert not out.valid[0, :, 12:].any()
    assert_same(out.joints[0, :, 12:], out.joints[0, :, 11:12].expand(-1, 8, -1, -1), atol=0.0)
    for clip, count in enumerate((12, 20)):
        alone = graph(clips[clip : clip + 1, :count], FPS)
        people = alone.joints.shape[1]
        for name in ("boxes", "keypoints", "keypoint_scores", "joints", "valid"):
            # Products of matrices of other sizes may be rounded differently.
            assert_same(getattr(out, name)[clip, :people, :count], getattr(alone, name)[0], atol=1e-5)
        last = int((count - 1) / FPS * RADAR.prf_hz) - 13  # fades out over 0.1 s; a clip's end is no leaving
        assert_same(out.range_time[clip, :, :last], alone.range_time[0, :, :last], atol=0.08)
    assert float(out.range_time[0, :, -40:].abs().max()) < 1e-6 * float(out.range_time[0].max())


def test_padded_frames_do_not_count_in_a_scripted_stage() -> None:
    stage, clips = pipeline().video_to_pose, two_clips()
    lengths = torch.tensor([12, 20])
    assert_same(torch.jit.script(stage)(clips, FPS, lengths), stage(clips, FPS, lengths))


def test_padded_frames_at_uneven_times_do_not_count() -> None:
    stage, clips = VideoToPose(RectangleDetector(), StandingPose()).eval(), two_clips()
    times_s = torch.arange(20) / FPS + 0.02 * torch.rand(2, 20)
    out = stage(clips, FPS, torch.tensor([12, 20]), times_s)
    alone = stage(clips[:1, :12], FPS, None, times_s[:1, :12])
    assert_same(out.joints[:1, :1, : alone.joints.shape[2]], alone.joints, atol=1e-5)


def test_a_clip_without_people_gives_the_empty_scene_and_says_so() -> None:
    stage = pipeline(snr_db=30.0, leakage=True)
    with pytest.warns(ts.TensorsimWarning, match="no person found in a clip"):
        out = stage(torch.zeros(1, 10, 3, 120, 160), FPS)
    assert out.boxes.shape == (1, 0, 10, 4)
    assert out.joints.shape == (1, 0, 10, 14, 3)
    assert out.range_time.shape[-1] == 128
    assert int(out.range_time[0].mean(dim=-1).argmax()) <= 1, "leakage"
    assert torch.isfinite(out.doppler_time).all()
    assert float(out.doppler_time.min()) > 0, "noise floor"


def test_float_video_equals_uint8_video() -> None:
    stage, clips = pipeline(), two_clips()[:1]
    assert_same(stage(clips.float() / 255, FPS), stage(clips, FPS), atol=1e-4)


def test_noise_repeats_with_the_seed() -> None:
    stage, clips = pipeline(snr_db=10.0), two_clips()[:1]
    outs = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        outs.append(stage(clips, FPS))
    assert torch.equal(outs[0].range_time, outs[1].range_time)
    assert not torch.equal(outs[0].range_time, outs[2].range_time)
    assert float(outs[0].snr_db) == pytest.approx(10.0, abs=0.3)


def test_gradients_flow_from_maps_to_joints() -> None:
    stage = pipeline().pose_to_doppler.double()
    t = torch.arange(12) / FPS
    joints = torch.randn(1, 1, 1, 14, 3, dtype=torch.float64) * 0.2 + torch.tensor([0.0, 3.0, 1.0])
    joints = (joints + torch.stack((0 * t, 0.3 * t, 0 * t), dim=-1)[:, None]).requires_grad_(True)
    stage(joints, torch.ones(1, 1, 12, dtype=torch.bool), FPS).doppler_time.sum().backward()
    assert joints.grad is not None
    assert torch.isfinite(joints.grad).all()
    assert bool((joints.grad != 0).any())


def test_gradients_flow_from_maps_to_frames() -> None:
    """Through crops, heat maps and keypoints; people are detected and tracked without gradients."""
    motion = ts.motion.ActivityGenerator().generate("walking", batch=1, seed=1, duration_s=0.4, rate_hz=20.0)
    frames = ts.data.PersonRenderer(height=180, width=240)(motion.joints[:1], seed=1).frames
    frames = (frames.reshape(1, -1, 3, 180, 240) / (255 if frames.dtype == torch.uint8 else 1)).float()
    out = ts.VideoToDoppler.from_pretrained()(frames.requires_grad_(True), 20.0)
    assert bool(out.valid.any())
    out.doppler_time.square().sum().backward()
    assert frames.grad is not None
    assert torch.isfinite(frames.grad).all()
    assert bool((frames.grad != 0).any())


@pytest.mark.parametrize(("fps", "interval"), [(5.0, 2), (30.0, 2), (44.0, 2), (60.0, 4), (120.0, 8)])
def test_detections_per_second_do_not_grow_with_the_frame_rate(fps: float, interval: int) -> None:
    """The tracker ends a person after a number of observed frames without a detection."""
    stage = VideoToPose(RectangleDetector(), StandingPose())
    observed = stage.observed_frames(torch.ones(1, 20, dtype=torch.bool), fps)[0]
    assert observed.nonzero()[:, 0].tolist() == sorted({*range(0, 20, interval), 19})


def test_refuses_bad_intervals() -> None:
    with pytest.raises(ts.TensorsimError, match="detection_interval: got 0"):
        VideoToPose(RectangleDetector(), StandingPose(), detection_interval=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames_per_batch": "8"}, "frames_per_batch: got '8', expected an integer of at least 1"),
        ({"detection_interval": 2.5}, r"detection_interval: got 2\.5, expected an integer of at least 1"),
        ({"fewest_joints": 15}, "fewest_joints: got 15, expected an integer from 1 to 14"),
        ({"keypoint_threshold": 2.0}, r"keypoint_threshold: got 2\.0, expected a score in \(0, 1\)"),
        ({"person_height_m": 1.75}, r"person_height_m: got 1\.75, expected a tuple of one number per person"),
        ({"metric_pose": 3}, "metric_pose: got a int, expected an instance of Module"),
        ({"bone_fit": BoneFit}, "bone_fit: got the class BoneFit, expected an instance of Module"),
    ],
)
def test_refuses_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ts.TensorsimError, match=message):
        VideoToPose(RectangleDetector(), StandingPose(), **options)


def test_refuses_other_parts_in_place_of_ready_ones() -> None:
    simulator = ts.radar.RadarSimulator(RADAR)
    with pytest.raises(
        ts.TensorsimError, match="simulator: got a RadarConfig, expected an instance of RadarSimulator"
    ):
        PoseToDoppler(RADAR)  # type: ignore[arg-type]
    with pytest.raises(
        ts.TensorsimError, match=r"rcs_scale\[0\]: got inf, expected a positive finite number"
    ):
        PoseToDoppler(simulator, rcs_scale=(math.inf,))
    with pytest.raises(
        ts.TensorsimError, match="video_to_pose: got the class VideoToPose, expected an instance"
    ):
        VideoToDoppler(video_to_pose=VideoToPose)  # type: ignore[arg-type]
    with pytest.raises(
        ts.TensorsimError, match="pose_to_doppler: got a RadarSimulator, expected an instance"
    ):
        pipeline(pose_to_doppler=simulator, radar=None)
    with pytest.raises(
        ts.TensorsimError, match="video_to_doppler: got a PoseToDoppler, expected an instance"
    ):
        VideoToActivity(PoseToDoppler(simulator), nn.Identity())  # type: ignore[arg-type]


def test_positions_are_not_rounded_by_mixed_precision() -> None:
    with (
        torch.autocast("cpu", torch.bfloat16),
        pytest.raises(ts.TensorsimError, match=r"video: got it under torch\.autocast, expected it off"),
    ):
        pipeline()(two_clips(), FPS)


# ---- TorchScript ---------------------------------------------------------------------------------------

#: Runs where `import tensorsim` fails; loads the scripted graph and saves what it gives.
LONELY = """
import sys
sys.modules["tensorsim"] = None
import warnings; warnings.simplefilter("ignore")
import torch
graph, inputs, outputs = sys.argv[1:]
arguments = torch.load(inputs)
with torch.no_grad():
    result = torch.jit.load(graph)(*arguments)
torch.save(tuple(result), outputs)
"""


def run_without_tensorsim(graph: Path, arguments: tuple[object, ...], folder: Path) -> tuple[Tensor, ...]:
    torch.save(arguments, folder / "in.pt")
    command = [sys.executable, "-c", LONELY, str(graph), str(folder / "in.pt"), str(folder / "out.pt")]
    subprocess.run(command, check=True, cwd=folder)
    result: tuple[Tensor, ...] = torch.load(folder / "out.pt")
    return result


def test_scripted_graph_equals_eager_without_tensorsim(tmp_path: Path) -> None:
    stage, clips = pipeline(multipath=True, wall=ts.WallConfig()), two_clips()
    ts.export.to_torchscript(stage, tmp_path / "sim.pt")
    assert [p.name for p in tmp_path.iterdir()] == ["sim.pt"]
    for batch in (clips, clips[:1, :13]):  # other batch sizes, lengths and people counts
        with torch.no_grad():
            expected = stage(batch, FPS)
        assert_same(run_without_tensorsim(tmp_path / "sim.pt", (batch, FPS), tmp_path), expected, atol=1e-4)


def test_scripted_pose_to_doppler_with_every_option(tmp_path: Path) -> None:
    simulator = ts.radar.RadarSimulator(
        RADAR, wall=ts.WallConfig(), multipath=True, leakage=True, snr_db=None
    )
    stage = PoseToDoppler(
        simulator,
        resampler=ts.motion.PoseResampler(RADAR.prf_hz, method="linear"),
        pulse_smoother=ts.motion.SavitzkyGolay(33, 3),
        denoiser=ts.enhance.MapDenoiser(ts.enhance.DnCNN(depth=3, channels=4)),
    ).eval()
    ts.export.to_torchscript(stage, tmp_path / "maps.pt")
    t = torch.arange(15) / FPS
    joints = torch.randn(2, 1, 1, 14, 3) * 0.2 + torch.tensor([0.0, 3.0, 1.0])
    joints = joints + torch.stack((0 * t, 0.4 * t, 0 * t), dim=-1)[:, None]
    arguments = (joints, torch.ones(2, 1, 15, dtype=torch.bool), FPS)
    with torch.no_grad():
        expected = stage(*arguments)
    assert_same(run_without_tensorsim(tmp_path / "maps.pt", arguments, tmp_path), expected, atol=1e-4)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:positions. some scatterer")  # an untrained network puts people anywhere
def test_real_networks_script_whole(tmp_path: Path, shared_data: Path) -> None:
    from tensorsim.data.video import VideoReader

    detector = ts.vision.RTMDet.from_pretrained(shared_data / "weights" / "rtmdet_nano_person.onnx")
    network = ts.vision.HRNet(18).eval()
    # Untrained: let the scores pass the threshold, or nobody is there.
    torch.nn.init.normal_(network.final_layer.weight, std=0.3)
    assert network.final_layer.bias is not None
    torch.nn.init.constant_(network.final_layer.bias, 1.0)
    radar = ts.RadarConfig.through_wall(prf_hz=4096.0)
    stage = VideoToDoppler(detector, network, radar=radar, snr_db=None).eval()
    ts.export.to_torchscript(stage, tmp_path / "sim.pt")
    # Two people in one film and one person in another, at other lengths than each other.
    for name, frames, size in (("hug_2people_28fps.mp4", 6, 1), ("walk_across_1person_30fps.mp4", 9, 1)):
        reader = VideoReader(shared_data / "video" / name)
        clip = next(iter(reader.chunks(frames))).unsqueeze(0).repeat(size, 1, 1, 1, 1)
        with torch.no_grad():
            expected = stage(clip, reader.fps)
        result = run_without_tensorsim(tmp_path / "sim.pt", (clip, reader.fps), tmp_path)
        people = len(ts.Pose._fields)
        assert_same(result[:people], expected[:people], atol=1e-4)
        # Of joints that are off by 0.1 mm the phases at 2 GHz are off by half a degree, and more where echoes cancel.
        for name in ("range_time", "range_time_mti", "doppler_time", "ridge_magnitudes"):
            index = expected._fields.index(name)
            assert_same([result[index]], [expected[index]], atol=1e-2)
        assert expected.valid.shape[1] >= 1
        assert expected.valid.any(dim=-1).all()


@pytest.mark.filterwarnings("ignore:positions. some scatterer is beyond")
def test_who_is_beyond_twice_the_range_axis_does_not_appear_at_the_radar() -> None:
    """A beat frequency above the sample rate would; the receiver's filter keeps it out."""
    radar = ts.RadarConfig.free_space(prf_hz=1024.0)
    stage = PoseToDoppler(ts.radar.RadarSimulator(radar, snr_db=None)).eval()
    reach = radar.range_resolution_m * (radar.samples_per_chirp // 2)
    body = forward_kinematics(BodyPose.standing((1,)), 1.75)
    t = torch.arange(20, dtype=torch.float64) / FPS
    loudest = []
    for range_m in (4.0, 2 * reach + 0.3, 2.5 * reach):
        joints = body.expand(20, -1, -1) + torch.stack([0 * t, range_m - 0.3 * t, 0 * t], -1)[:, None]
        with torch.no_grad():
            maps = stage(joints[None, None], torch.ones(1, 1, 20, dtype=torch.bool), FPS)
        loudest.append(float(maps.doppler_time.max()))
    assert max(loudest[1:]) < 1e-4 * loudest[0]


def test_the_receiver_hears_everybody_on_the_range_axis() -> None:
    radar = ts.RadarConfig.free_space()
    stage = PoseToDoppler(ts.radar.RadarSimulator(radar))
    reach = radar.range_resolution_m * (radar.samples_per_chirp // 2)
    radius = torch.tensor([0.1, 1.0, 1.49, 1.7, 1.9, 30.0], dtype=torch.float64) * reach
    way = torch.stack([0.6 * radius, 0.8 * radius, 0 * radius], -1)
    there = way + torch.tensor([radar.tx_m, radar.rx_m], dtype=torch.float64).mean(0)
    heard = stage.heard(there[:, None].expand(-1, 14, -1))
    assert heard.tolist() == pytest.approx([1, 1, 1, 0.5, 0, 0], abs=1e-6)
    assert heard[:3].eq(1.0).all()


def test_who_is_too_far_away_alone_leaves_an_empty_scene() -> None:
    """The noise is not set by an echo that the receiver does not hear."""
    joints, there = torch.zeros(1, 1, 20, 14, 3), torch.ones(1, 1, 20, dtype=torch.bool)
    joints[..., 1] = 2.5 * RADAR.reach_m - 0.1 * torch.arange(20)[:, None]
    stage = PoseToDoppler(ts.radar.RadarSimulator(RADAR, snr_db=50.0))
    torch.manual_seed(0)
    far = stage(joints, there, FPS)
    torch.manual_seed(0)
    empty = stage(joints, ~there, FPS)
    assert torch.equal(far.doppler_time, empty.doppler_time)
    blank = torch.zeros(1, 1, 20, 17, 2)
    pose = ts.Pose(torch.zeros(1, 1, 20, 4), blank, blank[..., 0], joints, there)
    with pytest.warns(TensorsimWarning, match="the receiver filters out"):
        maps_of_pose(stage, pose, FPS, torch.device("cpu"), quiet=True)


def test_joints_that_are_not_seen_are_smoothed_more_than_those_that_are() -> None:
    walk = ts.motion.ActivityGenerator().generate("walking", seed=2, duration_s=3.0, rate_hz=30.0).joints[0]
    walk = walk + torch.tensor([0.0, 3.0, 0.0])  # all of the body is in the picture
    camera = ts.CameraConfig(position_m=(0.0, 0.0, 1.2))
    keypoints, scores = seen_keypoints(
        walk[None], torch.ones(1, len(walk), dtype=torch.bool), camera, 480, 640
    )
    arm, when = [8, 10], slice(30, 75)  # right elbow and wrist, in COCO
    scores[:, when, arm] = 0.1
    jumps = 30 * torch.randn(45, 1, 2, generator=torch.Generator().manual_seed(0))
    keypoints[:, when, arm] += jumps
    boxes = keypoint_boxes(keypoints, scores)
    present = torch.ones(1, 1, len(walk), dtype=torch.bool)
    tracks = ts.Tracks(boxes[None], present, present)
    stage = VideoToPose(nn.Identity(), nn.Identity(), camera=camera, walking_legs=False).eval()

    def unsteady(factor: float) -> Tensor:
        """Accelerations (14,) of the joints, m/s^2."""
        stage.hidden_noise = factor
        with torch.no_grad():
            joints = stage.lift(tracks, keypoints[None], scores[None], 480, 640, 30.0).joints[0, 0, 32:73]
        return joints.diff(n=2, dim=0).norm(dim=-1).mean(0) * 30**2

    as_others, more = unsteady(1.0), unsteady(3.0)
    hidden = torch.tensor([3, 4])  # of the body
    assert float((more[hidden] / as_others[hidden]).max()) < 0.95
    legs = torch.tensor([9, 10, 12, 13])
    torch.testing.assert_close(more[legs], as_others[legs])


def test_people_who_lie_are_smoothed_more_than_those_who_stand() -> None:
    fall = ts.motion.ActivityGenerator().generate("walking to falling", seed=1, duration_s=4.0, rate_hz=30.0)
    joints = fall.joints[0] + torch.tensor([0.0, 2.0, 0.0])
    upright = trunk_uprightness(joints)
    assert float(upright[:30].min()) > 0.9
    assert float(upright[-30:].abs().max()) < 0.5
    camera = ts.CameraConfig(position_m=(0.0, 0.0, 1.2))
    keypoints, scores = seen_keypoints(
        joints[None], torch.ones(1, len(joints), dtype=torch.bool), camera, 480, 640
    )
    keypoints += 3 * torch.randn(keypoints.shape, generator=torch.Generator().manual_seed(0))
    present = torch.ones(1, 1, len(joints), dtype=torch.bool)
    tracks = ts.Tracks(keypoint_boxes(keypoints, scores)[None], present, present)
    stage = VideoToPose(nn.Identity(), nn.Identity(), camera=camera, walking_legs=False).eval()

    def unsteady(factor: float) -> Tensor:
        """Mean acceleration (T - 2,) of the joints, m/s^2."""
        stage.lying_noise = factor
        with torch.no_grad():
            found = stage.lift(tracks, keypoints[None], scores[None], 480, 640, 30.0).joints[0, 0]
        return found.diff(n=2, dim=0).norm(dim=-1).mean(-1) * 30**2

    as_others, more = unsteady(1.0), unsteady(5.0)
    assert float(more[-30:].mean() / as_others[-30:].mean()) < 0.9
    torch.testing.assert_close(more[:20], as_others[:20], rtol=0.02, atol=0.02)
