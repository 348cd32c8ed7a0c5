"""Live equals the causal stages on the whole film, with a bounded delay and memory; drops are counted."""

import itertools
import json
import math
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.interpolate import BSpline
from torch import Tensor

import tensorsim as ts
from tensorsim import cli, plot
from tensorsim.body.skeleton import coco_to_body, lowest_ankle
from tensorsim.commands import live as live_command
from tensorsim.data.video import VideoReader
from tensorsim.data.video_writer import write_video
from tensorsim.errors import TensorsimError
from tensorsim.live import LiveFrame, LiveSimulator
from tensorsim.live import camera as live_camera
from tensorsim.live.camera import Camera, Grabbed
from tensorsim.live.page import serving
from tensorsim.live.radar import LiveRadar, cubic_b_spline
from tensorsim.live.tracking import OnlineTracker
from tensorsim.live.view import MAP_HEIGHT, STRIP_HEIGHT, LiveView
from tensorsim.recognition.timeline import WINDOW_S
from tensorsim.types import Detections
from tensorsim.vision.lifting.metric_pose import lowered
from tensorsim.vision.lifting.pose_library import load_pose_library
from tensorsim.vision.smoothing.kalman import KalmanSmoother, smooth_constant_velocity
from tensorsim.vision.smoothing.outliers import limit_speed
from tests.film import STANDING, RectangleDetector, StandingPose, film, walker

FPS, FRAMES = 10.0, 60
#: A box that no edge of the picture cuts.
INSIDE = torch.tensor([[60.0, 30.0, 120.0, 200.0]])
CONFIG = ts.SimulationConfig.through_wall().replace(scene__snr_db=None, pose__flip_test=False)


@pytest.fixture(autouse=True, scope="module")
def _small_library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Every 40th pose of the shipped library: the tables of all of them take seconds to make."""
    global CONFIG
    path = tmp_path_factory.mktemp("library") / "poses.safetensors"
    save_file({"poses": load_pose_library()[::40].clone()}, path)
    whole, CONFIG = CONFIG, CONFIG.replace(pose__lifter="nearest", pose__library=str(path))
    yield
    CONFIG = whole


def networks() -> tuple[RectangleDetector, StandingPose]:
    return RectangleDetector(), StandingPose()


def simulator(**options: Any) -> LiveSimulator:
    return LiveSimulator(CONFIG, FPS, *networks(), **options)


@pytest.fixture(scope="module")
def walk() -> Tensor:
    """Frames (T, 3, H, W) of a person who walks away."""
    return film(*walker(FRAMES, FPS, 3.0, 0.6, 0.3))


@pytest.fixture(scope="module")
def pushed(walk: Tensor) -> list[LiveFrame]:
    live = simulator()
    return [live.push(frame) for frame in walk]


@pytest.fixture(scope="module")
def clip(walk: Tensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("film") / "walk.mp4"
    write_video(path, walk.permute(0, 2, 3, 1).numpy(), FPS)
    return path


def test_tracks_are_those_of_the_whole_clip_so_far() -> None:
    """The last frame of a smoothed track is its filtered one: the tracker on the first t frames is a reference."""
    range_m, x_m = (
        torch.cat(pair)
        for pair in zip(walker(30, FPS, 4.0, 0.5, -0.6), walker(30, FPS, 6.0, -0.5, 0.6), strict=True)
    )
    detections = RectangleDetector()(film(range_m, x_m))
    tracker, online = ts.vision.GNNTracker(), OnlineTracker()
    state = online.begin()
    for t in range(30):
        looked = t % 2 == 0
        state = online.step(state, Detections(*(field[t] for field in detections)) if looked else None)
        if t not in (20, 24, 28):
            continue
        observed = torch.arange(t + 1) % 2 == 0
        first = Detections(*(field[None, : t + 1] for field in detections))
        tracks = tracker(first, observed)
        numbers, boxes = online.people(state)
        assert len(numbers) == tracks.boxes.shape[1] == 2
        assert torch.allclose(boxes.float(), tracks.boxes[0, :, -1], atol=0.05)


def test_weak_detections_make_nobody() -> None:
    online = OnlineTracker()
    state = online.begin()
    box = torch.tensor([[10.0, 10.0, 50.0, 110.0]])
    weak = Detections(
        box, torch.tensor([0.4]), torch.zeros(1, dtype=torch.long), torch.ones(1, dtype=torch.bool)
    )
    for _ in range(20):
        state = online.step(state, weak)
    assert online.people(state)[0] == []


@pytest.mark.parametrize(("left_px", "off"), [(0.0, (0.0, 0.03)), (5.0, (0.05, 1.0))])
def test_sizes_of_who_is_cut_off_by_the_edge_count_little(left_px: float, off: tuple[float, float]) -> None:
    """A person looks larger by half while cut off by the edge, and is at the right place two frames later."""
    stage = simulator().poses[0]
    scores = torch.full((1, 17), 0.9)

    def range_m(sizes: list[float]) -> float:
        state = stage.begin(1)
        for size in sizes:
            keypoints = torch.tensor(STANDING)[None] * size + torch.tensor([50.0, 30.0])
            boxes = torch.tensor([[left_px if size > 150 else 60.0, 30.0, 120.0, 200.0]])
            state = stage(state, keypoints, scores, boxes, torch.tensor([True]), 240, 320)
        return float(state.shown[0, [8, 11], 1].mean())

    with torch.no_grad():
        true = range_m([120.0] * 12)
        found = range_m([180.0] * 10 + [120.0] * 2)
    assert off[0] <= abs(found / true - 1) <= off[1]


def test_who_leaves_by_the_edge_is_followed_while_enough_is_seen() -> None:
    """Joints beyond the edge move with the hips; a few joints, or a strip of a box, are not a person."""
    stage = simulator().poses[0]
    state = stage.begin(1)
    swing = torch.zeros(17, 2)
    with torch.no_grad():
        for t in range(12):
            swing[16, 0] = 4.0 * t  # the right ankle, ahead of the body
            points = torch.tensor(STANDING)[None] * 120 + torch.tensor([200.0 + 4 * t, 30.0]) + swing
            box = torch.tensor([[180.0 + 4 * t, 30.0, 300.0, 170.0]])
            state = stage(state, points, torch.full((1, 17), 0.9), box, torch.tensor([True]), 240, 320)
        scores = torch.full((1, 17), 0.9)
        scores[0, 16] = 0.1
        box = torch.tensor([[230.0, 30.0, 320.0, 170.0]])
        before = state.shown[0]
        for _ in range(8):  # far longer than the smoother predicts
            points = points + torch.tensor([2.0, 0.0])
            state = stage(state, points, scores, box, torch.tensor([True]), 240, 320)
        about = [shown[10] - shown[[8, 11]].mean(dim=0) for shown in (before, state.shown[0])]
        assert float((about[1] - about[0]).norm()) < 0.25
        assert int(state.missed) == 0
        few = torch.where(torch.arange(17) < 9, scores, 0.1)
        strip = torch.tensor([[300.0, 30.0, 325.0, 170.0]])
        for seen, where, missed in ((few, INSIDE, 0), (few, box, 1), (scores, strip, 2), (scores, box, 0)):
            state = stage(state, points, seen, where, torch.tensor([True]), 240, 320)
            assert int(state.missed) == missed


def test_who_was_hidden_is_placed_anew() -> None:
    stage = simulator().poses[0]

    def shown(sizes: list[float]) -> Tensor:
        state = stage.begin(1)
        for size in sizes:
            keypoints = torch.tensor(STANDING)[None] * size + torch.tensor([150.0, 30.0])
            there = torch.tensor([size > 0])
            state = stage(state, keypoints, torch.full((1, 17), 0.9), INSIDE, there, 240, 320)
        return state.shown[0] - state.shown[0].amin(dim=0)[2] * torch.tensor([0.0, 0.0, 1.0])

    with torch.no_grad():
        again, anew = shown([120.0] * 12 + [0.0] * 5 + [90.0] * 2), shown([90.0] * 2)
    assert torch.allclose(again, anew, atol=0.01)


def test_nobody_is_lifted_in_a_frame_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lifting takes longer than a frame lasts; the state is the same as after lifting keypoints of score 0."""
    stage = simulator().poses[0]
    states = [stage.begin(2)]
    for t in range(12):
        keypoints = torch.tensor(STANDING) * 120.0 + torch.tensor([[[140.0 + t, 30.0]], [[200.0 - t, 30.0]]])
        scores, there = torch.full((2, 17), 0.9), torch.tensor([True, True])
        states.append(stage(states[-1], keypoints, scores, INSIDE.expand(2, 4), there, 240, 320))
    blank = torch.zeros(2, 17, 2), torch.zeros(2, 17), INSIDE.expand(2, 4)

    def missed(first: bool) -> list[Tensor]:
        """The fields of the states after frames in which the second person, and maybe the first, is missing."""
        state, fields = states[-1], []
        for _ in range(6):
            state = stage(state, *blank, torch.tensor([first, False]), 240, 320)
            fields += [*state.size, *state.joints, *state[2:]]
        return [field[1] for field in fields]

    lifted = missed(True)
    monkeypatch.setattr(stage, "lifter", None)
    monkeypatch.setattr(stage, "metric_pose", None)
    for ours, theirs in zip(missed(False), lifted, strict=True):
        assert torch.equal(ours.nan_to_num(-1.0), theirs.nan_to_num(-1.0))


def test_poses_are_those_of_the_causal_stages_on_the_whole_film() -> None:
    """The same stages, each on all frames at once: lifter, forward filter of the size, metric pose, floor, filter."""
    stage = simulator().poses[0]
    turn = torch.Generator().manual_seed(0)
    size = torch.linspace(180, 120, 40)[:, None, None]
    keypoints = torch.tensor(STANDING) * size + torch.tensor([150.0, 30.0])
    keypoints = keypoints + torch.randn(keypoints.shape, generator=turn)
    scores = torch.full((40, 17), 0.9)
    scores[12:14, 9] = 0.1  # a wrist hides for a moment, then an ankle for long
    scores[20:32, 15] = 0.1
    state, shown = stage.begin(1), []
    with torch.no_grad():
        for t in range(40):
            frame = slice(t, t + 1)
            state = stage(state, keypoints[frame], scores[frame], INSIDE, torch.tensor([True]), 240, 320)
            shown.append(state.shown[0])

        body, body_scores = coco_to_body(keypoints, scores)
        reliable = body_scores >= 0.3
        lifted = stage.lifter(body[None], (body_scores * reliable)[None])
        density, noise = (
            torch.full([1], x, dtype=torch.float64) for x in (stage.size_density, stage.size_noise)
        )
        whole = (reliable.sum(-1) >= 10) & (lifted.distance[0] < 0.25)
        assert bool(whole.all())
        logarithm = lifted.scale[0].log().double()[:, None]
        size = smooth_constant_velocity(logarithm, whole, density, noise, stage.size_speed, 1 / FPS, False)
        alone = lifted._replace(**{name: getattr(lifted, name)[0][:, None, None] for name in lifted._fields})
        alone = alone._replace(scale=size.exp().float()[:, None])
        placed, seen = stage.metric_pose(
            body[:, None, None],
            (body_scores * reliable)[:, None, None],
            alone,
            torch.ones(40, 1, 1) > 0,
            240,
            320,
            FPS,
        )
        placed, seen = placed[:, 0, 0], seen[:, 0, 0]
        low = lowest_ankle(placed)
        window = stage.floor_frames
        floor = torch.stack([torch.quantile(low[max(0, t + 1 - window) : t + 1], 0.15) for t in range(40)])
        placed = lowered(placed, floor)
        hidden = torch.zeros(14)
        measured = torch.zeros(40, 14, dtype=torch.bool)
        for t in range(40):
            hidden = torch.where(seen[t], 0, hidden + 1)
            measured[t] = seen[t] | (hidden > stage.brief_gap) | (t == 0)
        smoother = KalmanSmoother(
            stage.joint_density / 30.0**3, stage.joint_noise, "forward", stage.initial_speed
        )
        expected = limit_speed(smoother(placed, measured, FPS), FPS, stage.top_speed_m_s)
    # Rounding, which depends on the processor, may choose another of two poses that fit equally well: 1 mm.
    assert torch.allclose(torch.stack(shown).float(), expected, atol=2e-3)


def test_spline_is_that_of_scipy() -> None:
    knots = np.random.default_rng(0).normal(size=(9, 3))
    spline = BSpline(np.arange(-3.0, 10.0), knots, 3)  # knot k of the curve is control point k + 1
    u = np.linspace(0, 0.99, 7)
    for k in range(6):
        part = cubic_b_spline(torch.from_numpy(knots[k : k + 4]), torch.from_numpy(u))
        assert np.allclose(part.numpy(), spline(k + u), atol=1e-12)


@pytest.mark.parametrize(
    ("fps", "prf_hz", "mti"),
    [(20.0, 512.0, "two-pulse"), (120.0, 128.0, "two-pulse"), (60.0, 128.0, "n-pulse")],
)
def test_maps_are_those_of_the_whole_motion(fps: float, prf_hz: float, mti: str) -> None:
    """Also where a frame has fewer pulses than the moving target indicator needs to start."""
    motion = ts.motion.ActivityGenerator().generate("walking", seed=1, duration_s=2.0, rate_hz=fps)
    joints = motion.joints[0].double()
    joints = (joints[:1] + joints) / 2  # slow enough for a PRF of 128 Hz
    config = CONFIG.replace(
        scene__radar__prf_hz=prf_hz, processing__display_rate_hz=128.0, processing__mti=mti
    )
    stage = ts.PoseToDoppler.from_config(config)
    radar = LiveRadar(stage, fps)
    with torch.no_grad():
        parts = [radar.push({0: (frame, True)}) for frame in joints]
        # All moments of the curve at once; before the first frame the person stands, and fades in.
        still = torch.cat([joints[:1].expand(3, 14, 3), joints])
        appears = torch.arange(1, len(joints) + 1) / (0.1 * fps)
        level = torch.cat([torch.zeros(3), appears.clamp(max=1.0)]).double()
        time_s = torch.arange(radar.pulse) / prf_hz * fps
        knots = np.arange(-5.0, len(still) - 1)
        curves = [
            BSpline(knots, x.flatten(1).numpy() if x.dim() > 1 else x.numpy(), 3) for x in (still, level)
        ]
        place, fade = (torch.from_numpy(curve(time_s.numpy())) for curve in curves)
        points, rcs = stage.scatterers(place.reshape(1, 1, -1, 14, 3), fade.reshape(1, 1, -1))
        maps = stage.simulator(points, rcs)
    assert radar.pulse == math.ceil((len(joints) - 2) / fps * prf_hz)
    for name in ("doppler_time", "range_time", "range_time_mti"):
        live = torch.cat([getattr(part, name) for part in parts], dim=-1)
        expected = getattr(maps, name)[0][:, : live.shape[-1]]
        assert expected.shape[-1] - live.shape[-1] <= 1, "but for what fills no column"
        assert torch.allclose(live, expected[:, : live.shape[-1]], atol=1e-4 * float(expected.max()))


@pytest.mark.parametrize("absent", [1, 3, 20])
def test_nobody_hears_how_somebody_gets_elsewhere_while_hidden(absent: int) -> None:
    body = (
        ts.motion.ActivityGenerator().generate("walking", seed=1, duration_s=2.0, rate_hz=30.0).joints[0, 0]
    )
    here, there = body.double(), body.double() + torch.tensor([0.0, 0.6, 0.0])
    frames = [(here, True)] * 20 + [(here, False)] * absent + [(there, True)] * 20
    radar = LiveRadar(ts.PoseToDoppler.from_config(CONFIG), 30.0)
    with torch.no_grad():
        maps = torch.cat([radar.push({0: frame}).doppler_time for frame in frames], dim=-1)
        radar = LiveRadar(radar.stage, 30.0)
        appears = torch.cat([radar.push({0: (here, True)}).doppler_time for _ in range(20)], dim=-1)
    fast = radar.simulator.doppler.doppler_hz.abs() * radar.simulator.radar.doppler_wavelength_m > 3.0
    assert float(maps[fast].max()) < 1.5 * float(appears[fast].max())


def test_a_file_as_a_camera_equals_its_frames(clip: Path) -> None:
    camera = Camera(str(clip), every_frame=True)
    played, given = simulator(), simulator()
    frames = [frame for chunk in VideoReader(clip).chunks(7) for frame in chunk]
    ours = [played.push(frame) for frame, _ in camera.frames()]
    theirs = [given.push(frame) for frame in frames]
    assert len(ours) == len(theirs) == FRAMES
    for a, b in zip(ours, theirs, strict=True):
        assert torch.equal(a.doppler_time, b.doppler_time)
        assert [p.number for p in a.people] == [p.number for p in b.people]
        assert all(torch.equal(p.joints, q.joints) for p, q in zip(a.people, b.people, strict=True))
    assert camera.dropped == 0


def test_somebody_walks_away_and_is_seen_by_the_radar(pushed: list[LiveFrame]) -> None:
    last = pushed[-1]
    assert [person.number for person in last.people] == [1]
    hips = torch.stack([frame.people[0].joints[8] for frame in pushed[30:]])
    speed = (hips[-1, 1] - hips[0, 1]) / (len(hips) - 1) * FPS
    assert float(speed) == pytest.approx(0.6, abs=0.1)
    receding = torch.cat([frame.doppler_time for frame in pushed[30:]], dim=-1).square().sum(-1)
    assert float(receding[: len(receding) // 2].sum()) > 20 * float(receding[len(receding) // 2 :].sum())
    centres = torch.cat([frame.doppler_time_s for frame in pushed])
    assert torch.allclose(centres.diff(), centres.diff().mean().expand(len(centres) - 1))


def test_delay_is_bounded(pushed: list[LiveFrame]) -> None:
    assert max(frame.delay_s for frame in pushed[5:]) < 0.5


def test_missed_frames_are_bridged_and_counted(walk: Tensor) -> None:
    live = simulator()
    for index, frame in enumerate(walk):
        new = live.miss() if index % 3 == 2 else live.push(frame)
    assert live.missed == FRAMES // 3
    assert new.number == FRAMES - 1
    assert new.people[0].present
    assert float(new.people[0].joints[8, 1]) == pytest.approx(3.0 + 0.6 * 5.9, abs=0.4)


def test_people_are_looked_for_whichever_frames_are_missed(walk: Tensor) -> None:
    """Frames that arrive have odd numbers; detection must not depend on the parity of the number."""
    live = simulator()
    for index, frame in enumerate(walk):
        new = live.push(frame) if index % 2 else live.miss()
    assert [person.number for person in new.people] == [1]


def test_somebody_who_leaves_is_forgotten(walk: Tensor) -> None:
    live = simulator()
    for frame in walk[:30]:
        live.push(frame)
    assert len(live.radar.people) == 1
    for _ in range(120):
        new = live.push(torch.zeros_like(walk[0]))
    assert (new.people, live.states, live.radar.people) == ([], {}, {})
    assert float(new.doppler_time.max()) == 0.0


def test_labels_come_once_a_second(walk: Tensor) -> None:
    recognizer = ts.recognition.ActivityRecognizer(
        CONFIG.scene.radar, ts.recognition.SPGNet(2), size=32, speed_m_s=2.0, class_names=("a", "b")
    ).eval()
    live = simulator(recognizer=recognizer)
    labels = [new.label for new in map(live.push, walk) if new.label]
    assert [round(label.end_s) for label in labels] == [4, 5]
    assert all(label.end_s - label.start_s == pytest.approx(WINDOW_S) for label in labels)
    assert live.labels is not None
    kept = sum(part.shape[-1] for part in live.labels.doppler_time.parts)
    assert kept <= live.labels.doppler_time.columns + 20


def test_what_needs_the_whole_film_is_refused(walk: Tensor) -> None:
    for changes in (
        {"pose__initial_distance_m": (4.0,)},
        {"pose__calibrate": True},
        {"pose__people": "nearest"},
        {"smoothing__smoothing_ratio": 0.25},
        {"processing__mti": "mean"},
        {"scene__sway": True},
    ):
        with pytest.raises(TensorsimError, match="live: got"):
            LiveSimulator(CONFIG.replace(**changes), FPS, *networks())
    with pytest.raises(TensorsimError, match=r"frame: got torch\.float32 of shape"):
        simulator().push(walk[0].float())


def test_nearest_matching_lifts_whatever_the_configuration_says() -> None:
    """The temporal lifter needs future frames."""
    config = CONFIG.replace(pose__library=None, pose__lifter="temporal")
    assert LiveSimulator(config, FPS, *networks()).config.pose.lifter == "nearest"


def test_the_noise_of_an_empty_scene_is_drawn_as_weak_as_it_is() -> None:
    live = LiveSimulator(CONFIG.replace(scene__snr_db=50.0), FPS, *networks())
    view, blank = LiveView(live, plot.MapStyle("gray")), torch.zeros(3, 120, 160, dtype=torch.uint8)
    for _ in range(10):
        new = live.push(blank)
        view.add(new)
    drawn = view.draw(new, blank.permute(1, 2, 0).numpy(), 0)[-STRIP_HEIGHT - MAP_HEIGHT : -STRIP_HEIGHT]
    assert 0 < drawn[20:100, -20:].max() < 128


def test_frames_that_come_too_fast_are_dropped_and_counted(clip: Path) -> None:
    camera = Camera(str(clip), fps=200.0)
    indices, last = [], -1
    for _, missing in camera.frames():
        last += 1 + missing
        indices.append(last)
        time.sleep(0.02)  # in which others are dropped: they count once the film is there
        assert len(indices) + camera.dropped == last + 1 <= FRAMES
    assert camera.dropped > 0


def test_frames_that_a_film_does_not_have_are_missing(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(str(clip), every_frame=True, loops=2)
    frame = torch.zeros(3, 4, 4, dtype=torch.uint8)
    monkeypatch.setattr(
        camera.reader, "timed_frames", lambda: iter([(0.0, frame), (0.1, frame), (0.52, frame), (0.6, frame)])
    )
    assert [grabbed.missing for grabbed in camera.frames()] == [0, 0, 3, 0, 0, 0, 3, 0]
    assert camera.dropped == 0


def test_an_error_while_frames_are_read_is_raised(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(str(clip), fps=200.0)

    def broken() -> Iterator[tuple[float, Tensor]]:
        yield 0.0, torch.zeros(3, 4, 4, dtype=torch.uint8)
        raise TensorsimError("frame 1 has another shape")

    monkeypatch.setattr(camera.reader, "timed_frames", broken)
    with pytest.raises(TensorsimError, match="frame 1 has another shape"):
        list(camera.frames())


class SlowCapture:
    """A camera that takes a while to start, gives one frame and stops."""

    def __init__(self) -> None:
        self.answers = iter([(True, np.zeros((4, 4, 3), np.uint8)), (False, None)])

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(0.1)
        return next(self.answers)

    def release(self) -> None:
        pass


def test_time_starts_with_the_first_frame_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_camera, "_opened", lambda *_: (SlowCapture(), 30.0))
    camera = Camera("0")
    frames = camera.frames()
    assert next(frames).missing == camera.dropped == 0
    with pytest.raises(TensorsimError, match="0: the camera gave no more frames"):
        next(frames)


class SteadyCapture:
    """A camera with this many frames per second, with jitter, for eight seconds of a simulated clock."""

    def __init__(self, fps: float) -> None:
        self.fps, self.count, self.now, self.jitter = fps, 0, 0.0, np.random.default_rng(0)

    def monotonic(self) -> float:
        return self.now

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.now = 5.0 + self.count / self.fps + self.jitter.uniform(0, 1.5 / self.fps)
        self.count += 1
        return (True, np.zeros((4, 4, 3), np.uint8)) if self.now < 13.0 else (False, None)

    def release(self) -> None:
        pass


@pytest.mark.parametrize("fps", [20.0, 25.0, 30.0])
def test_time_is_that_of_the_clock_whatever_a_camera_announces(
    monkeypatch: pytest.MonkeyPatch, fps: float
) -> None:
    capture, state = SteadyCapture(fps), live_camera._State()
    monkeypatch.setattr(live_camera, "_opened", lambda *_: (capture, 25.0))
    monkeypatch.setattr(live_camera, "time", capture)
    indices = []
    for index, frame in Camera("0")._live(state):
        if frame is not None:
            indices.append(index)
            assert index / 25.0 == pytest.approx(capture.now - 5.0, abs=4 / 25.0)
    assert (np.diff(indices) >= 1).all()
    assert len(indices) + state.dropped == capture.count - 1
    assert state.dropped == pytest.approx(max(0.0, 8 * (fps - 25)), abs=4)


def test_cameras_that_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no such file"):
        Camera(str(tmp_path / "no.mp4"))
    with pytest.raises(TensorsimError, match="--camera: 97 cannot be opened"):
        Camera("97")
    with pytest.raises(TensorsimError, match="--every-frame: got the camera 0"):
        Camera("0", every_frame=True)


def test_the_page_streams_pictures_to_this_machine_only() -> None:
    import cv2

    with serving(0) as page:
        address = f"http://127.0.0.1:{page.port}"
        assert b"/live.mjpg" in urllib.request.urlopen(f"{address}/", timeout=5).read()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{address}/../etc/passwd", timeout=5)
        elsewhere = urllib.request.Request(address, headers={"Host": "elsewhere.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(elsewhere, timeout=5)
        threading.Timer(0.1, page.show, [np.full((20, 30, 3), 200, np.uint8)]).start()
        stream = urllib.request.urlopen(f"{address}/live.mjpg", timeout=5)
        assert stream.readline() == b"--frame\r\n"
        assert stream.readline() == b"Content-Type: image/jpeg\r\n"
        stream.readline()
        picture = cv2.imdecode(np.frombuffer(stream.read(len(page.latest)), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (20, 30, 3)
        with pytest.raises(TensorsimError, match=f"--port: {page.port} cannot be used"), serving(page.port):
            pass


def _every_third(camera: Camera) -> Iterator[Grabbed]:
    """The third frame of a film, the sixth and so on, as if the others had been dropped."""
    for index, (_, frame) in enumerate(camera.reader.timed_frames()):
        if index % 3 == 2:
            camera.dropped += 2
            yield Grabbed(frame, 2)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), SystemExit(143), TensorsimError("the camera gave no more frames")]
)
def test_the_recorded_film_outlives_an_interrupt(
    clip: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
) -> None:
    def interrupted(camera: Camera) -> Iterator[Grabbed]:
        for _, frame in itertools.islice(camera.reader.timed_frames(), 3):
            yield Grabbed(frame, 0)
        raise error

    weights, path = tmp_path / "w.onnx", tmp_path / "live.webm"
    weights.write_text("")
    monkeypatch.setattr(live_command, "load_networks", lambda *_: networks())
    monkeypatch.setattr(Camera, "frames", interrupted)
    arguments = ["live", "--camera", str(clip), "--detector", str(weights), "--pose", str(weights)]
    arguments += ["--port", "None", "--record", str(path)]
    if isinstance(error, KeyboardInterrupt):
        cli.main(arguments)
        assert "0.3 s, " in capsys.readouterr().out
    else:
        with pytest.raises(SystemExit) as stop:
            cli.main(arguments)
        ended = isinstance(error, SystemExit)  # by SIGTERM
        assert stop.value.code == (143 if ended else 2)
        assert ended or "the camera gave no more frames" in capsys.readouterr().err
    assert sum(chunk.shape[0] for chunk in VideoReader(path).chunks(16)) == 3


def test_command(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = tmp_path / "w.onnx"
    weights.write_text("")
    monkeypatch.setattr(live_command, "load_networks", lambda *_: networks())
    arguments = [
        "live",
        "--camera",
        str(clip),
        "--detector",
        str(weights),
        "--pose",
        str(weights),
        "--port",
        "0",
    ]
    arguments += ["--scene", "through-wall", "--every-frame", "--record", str(tmp_path / "live.webm")]
    cli.main([*arguments, "--seconds", "5.2"])
    said = capsys.readouterr()
    assert "5.3 s, 1 person, 0 frames dropped" in said.out
    assert "dropped 0" in said.out.splitlines()[0], "a label after four seconds"
    assert "showing http://127.0.0.1:" in said.err
    film = VideoReader(tmp_path / "live.webm")
    assert (film.width, film.height) == (640, 480 + 240 + 26)
    assert sum(chunk.shape[0] for chunk in film.chunks(16)) == 53
    # Columns, labels and pictures of missing frames are not omitted.
    monkeypatch.setattr(Camera, "frames", _every_third)
    cli.main([*arguments, "--record", str(tmp_path / "third.webm")])
    said = capsys.readouterr()
    assert "1 person, 40 frames dropped" in said.out
    assert said.out.splitlines()[0].startswith("     4.")
    assert sum(chunk.shape[0] for chunk in VideoReader(tmp_path / "third.webm").chunks(16)) == FRAMES
    with pytest.raises(SystemExit):
        cli.main([*arguments, "--sound"])
    assert "--sound (applied to tensorsim live)" in capsys.readouterr().err


def test_the_summary_of_a_run_is_taken(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It states that the camera was estimated, which live cannot do."""
    weights, summary = tmp_path / "w.onnx", tmp_path / "summary.json"
    weights.write_text("")
    summary.write_text(json.dumps({"config": CONFIG.replace(pose__calibrate=True).to_document()}))
    monkeypatch.setattr(live_command, "load_networks", lambda *_: networks())
    arguments = ["live", "--camera", str(clip), "--detector", str(weights), "--pose", str(weights)]
    cli.main([*arguments, "--port", "None", "--seconds", "0.2", "--every-frame", "--config", str(summary)])
    assert "0.3 s, " in capsys.readouterr().out


def test_a_record_in_a_file_is_refused(clip: Path) -> None:
    with pytest.raises(TensorsimError, match=r"--record: .*walk\.mp4 is a file, expected a folder"):
        live_command.Live(str(clip), record=clip / "x.webm").run()


def test_a_film_is_not_recorded_onto_itself(clip: Path) -> None:
    with pytest.raises(TensorsimError, match="which is --camera, expected another file"):
        live_command.Live(str(clip), record=clip).run()
