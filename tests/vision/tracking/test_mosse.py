import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import map_coordinates
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.types import Detections
from tensorsim.vision.tracking.mosse import MosseTracker, peak_to_sidelobe, prepared
from tests.stage import StageTester

FILM = Path("../shared/data/video/walk_across_1person_30fps.mp4")


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """A picture (3, H, W) with detail of several sizes, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 3, height, width)
    for coarse in (4, 8, 16, 32):
        noise = torch.rand(1, 3, height // coarse + 1, width // coarse + 1, generator=generator)
        total += F.interpolate(noise, (height, width), mode="bicubic", align_corners=False)
    return ((total - total.min()) / (total.max() - total.min()))[0]


def detections(boxes: Any, scores: Any = None) -> Detections:
    tensor = torch.tensor(boxes, dtype=torch.float32)
    sure = torch.full(tensor.shape[:2], 0.9) if scores is None else torch.tensor(scores)
    return Detections(
        tensor,
        sure,
        torch.zeros(tensor.shape[:2], dtype=torch.int64),
        torch.ones(tensor.shape[:2], dtype=torch.bool),
    )


def moving(shifts: list[tuple[float, float]], seed: int = 0) -> Tensor:
    """A textured square of 48 x 64 that moves over another texture by these (right, down) pixels: (T, 3, 160, 200)."""
    ground, figure = 0.4 * texture(160, 200, seed + 100), texture(64, 48, seed)
    frames = []
    for right, down in shifts:
        v, u = torch.meshgrid(torch.arange(160.0), torch.arange(200.0), indexing="ij")
        grid = torch.stack([(u + 0.5 - 60 - right) / 24 - 1, (v + 0.5 - 40 - down) / 32 - 1], -1)
        inside = (grid.abs() <= 1).all(-1)
        drawn = F.grid_sample(figure[None], grid[None], align_corners=False, padding_mode="border")[0]
        frames.append(torch.where(inside, drawn, ground))
    return torch.stack(frames)


PATH = [(0.0, 0.0), (3.0, 1.0), (7.0, 1.5), (10.0, 4.0), (12.5, 7.0), (16.0, 9.0), (21.0, 10.0), (26.0, 14.0)]
START = [60.0, 40.0, 108.0, 104.0]


class TestMosseTracker(StageTester):
    batch_shapes = ((2,),)
    gradient_arguments = ()  # the place of a peak
    exports = False  # the number of people depends on the data

    def make(self) -> nn.Module:
        return MosseTracker(size=32)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        video = torch.stack([moving(PATH[:4], seed) for seed in range(batch[0])]).to(dtype)
        other = [20.0, 20.0, 50.0, 70.0]
        start = detections([[START, other]] * batch[0])
        return video, start._replace(boxes=start.boxes.to(dtype), scores=start.scores.to(dtype))

    def test_batch_equals_loop(self) -> None:
        tracker, (video, start) = self.make(), self.inputs((3,), torch.float32)
        whole = tracker(video, start)
        for k in range(3):
            one = tracker(video[k : k + 1], Detections(*(field[k : k + 1] for field in start)))
            torch.testing.assert_close(one.boxes[0], whole.boxes[k], rtol=0, atol=1e-3)
            assert torch.equal(one.matched[0], whole.matched[k])

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        video, start = self.inputs((2,), torch.float32)
        return [
            ((video[0], start), r"expected \(B, T, 3, H, W\)"),
            ((video[:, :0], start), "at least one clip and frame"),
            ((video[:1], start), "got detections of 2 clips, expected 1"),
            ((video * float("nan"), start), "NaN or infinite"),
            ((video.long(), start), "video: got dtype torch.int64"),
            ((video, start._replace(boxes=start.boxes[..., :3])), r"start.boxes: got shape .* \(B, K, 4\)"),
            ((video, start._replace(scores=start.scores[:, :1])), "start.scores: got shape"),
            ((video, start._replace(labels=start.labels[:1])), "start.labels: got shape"),
            ((video, start._replace(valid=start.valid.float())), "start.valid: got torch.float32"),
        ]


def test_follows_known_shifts() -> None:
    tracks = MosseTracker()(moving(PATH)[None], detections([[START]]))
    assert bool(tracks.matched.all())
    expected = torch.tensor([[START[0] + r, START[1] + d, START[2] + r, START[3] + d] for r, d in PATH])
    assert float((tracks.boxes[0, 0] - expected).abs().max()) < 0.6


def test_follows_as_opencv_does() -> None:
    """OpenCV's filter has its own constants; where it holds the target, both are at the same place."""
    cv2 = pytest.importorskip("cv2")
    film = (255 * moving(PATH)).round().to(torch.uint8)
    frames = [np.ascontiguousarray(frame.permute(1, 2, 0).numpy()[..., ::-1]) for frame in film]
    reference = cv2.legacy.TrackerMOSSE_create()
    reference.init(frames[0], (60, 40, 48, 64))
    tracks = MosseTracker()(film[None], detections([[START]]))
    held = 0
    for t in range(1, len(frames)):
        found, (x, y, _, _) = reference.update(frames[t])
        if not found:
            break
        held += 1
        assert abs(float(tracks.boxes[0, 0, t, 0]) - x) < 3
        assert abs(float(tracks.boxes[0, 0, t, 1]) - y) < 3
    if held == 0:
        pytest.skip("OpenCV's tracker loses this target in its first update")


def test_a_target_that_disappears_is_lost() -> None:
    film = moving([*PATH, *[(500.0, 0.0)] * 4])
    tracks = MosseTracker()(film[None], detections([[START]]))
    last = len(PATH) - 1
    assert tracks.valid[0, 0].tolist() == [True] * (last + 1) + [False] * 4
    assert float(tracks.boxes[0, 0, last + 1 :].abs().max()) == 0.0


def test_who_starts() -> None:
    start = detections([[START, [0, 0, 40, 40], START, [5, 5, 5, 60]]], [[0.6, 0.4, 0.9, 0.9]])
    start.boxes[0, 2] += 20.0
    tracks = MosseTracker()(moving(PATH[:2])[None], start)
    assert tracks.boxes.shape == (1, 2, 2, 4)  # not the weak one, not the one without width
    assert torch.equal(tracks.boxes[0, :, 0], start.boxes[0, [2, 0]])  # best first
    assert tracks.valid[0, :, 0].all()
    nobody = MosseTracker()(moving(PATH[:2])[None], detections([[START]], [[0.1]]))
    assert nobody.boxes.shape == (1, 0, 2, 4)


def test_filter_is_the_closed_form_of_one_picture() -> None:
    """With eta 1 the filter of one picture gives back the Gaussian on that picture."""
    tracker = MosseTracker(size=32)
    spectrum = torch.fft.fft2(prepared(texture(32, 32).mean(0)[None], tracker.window).double())
    top, bottom = tracker._learned(spectrum)
    response = torch.fft.ifft2(spectrum * top / (bottom + 1e-12)).real
    torch.testing.assert_close(response[0], tracker.goal.double(), rtol=0, atol=1e-3)


def mosse_in_numpy(film: np.ndarray, box: list[float], size: int, rate: float) -> list[tuple[float, float]]:
    """Centres of a box (xyxy) in grey frames (T, H, W) in [0, 1]: MOSSE as published, with nine first pictures."""
    x, y, wide, high = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2, box[2] - box[0], box[3] - box[1]
    steps = np.arange(size) - size // 2
    window = np.outer(*[0.5 - 0.5 * np.cos(2 * np.pi * np.arange(1, size + 1) / (size + 1))] * 2)
    goal = np.fft.fft2(np.exp(-(steps[:, None] ** 2 + steps**2) / (2 * 2.0**2)))

    def spectrum(frame: np.ndarray, turn: float = 0.0, growth: float = 1.0) -> np.ndarray:
        down, right = np.meshgrid(steps / size * growth, steps / size * growth, indexing="ij")
        u = x + (np.cos(turn) * right - np.sin(turn) * down) * wide
        v = y + (np.sin(turn) * right + np.cos(turn) * down) * high
        patch = np.log1p(255 * map_coordinates(frame, [v - 0.5, u - 0.5], order=1, mode="nearest"))
        patch = patch - patch.mean()
        return np.fft.fft2(patch / (np.linalg.norm(patch) + 1e-5) * window)

    warps = [(0.0, 1.0), *((turn, 1.0) for turn in (0.05, -0.05, 0.1, -0.1)), (0.0, 0.95), (0.0, 1.05)]
    first = [spectrum(film[0], *warp) for warp in (*warps, (0.05, 1.03), (-0.05, 0.97))]
    top = np.mean([goal * f.conj() for f in first], axis=0)
    bottom = np.mean([f * f.conj() for f in first], axis=0)
    centres = [(x, y)]
    for frame in film[1:]:
        response = np.fft.ifft2(spectrum(frame) * top / (bottom + 1e-5)).real
        row, column = np.unravel_index(response.argmax(), response.shape)
        for axis, line, at in ((0, response[row], column), (1, response[:, column], row)):
            left, middle, right = line[at - 1 : at + 2]
            shift = at - size // 2 + (right - left) / 2 / (2 * middle - left - right)
            x, y = (x + shift * wide / size, y) if axis == 0 else (x, y + shift * high / size)
        f = spectrum(frame)
        top, bottom = rate * goal * f.conj() + (1 - rate) * top, rate * f * f.conj() + (1 - rate) * bottom
        centres.append((x, y))
    return centres


def test_boxes_are_those_of_the_published_filter_in_numpy() -> None:
    film = 0.6 * moving(PATH[:5]) + 0.4 * moving(PATH[:5], seed=1).roll(1, 0)  # what is followed changes
    tracks = MosseTracker(learning_rate=0.3, size=32).double()(film[None].double(), detections([[START]]))
    assert bool(tracks.matched.all())
    expected = mosse_in_numpy(film.double().mean(1).numpy(), START, 32, 0.3)
    middle = (tracks.boxes[0, 0, :, :2] + tracks.boxes[0, 0, :, 2:]) / 2
    np.testing.assert_allclose(middle.numpy(), expected, atol=1e-4)


def test_ratio_of_a_known_response() -> None:
    generator = np.random.default_rng(0)
    response = generator.standard_normal((1, 32, 32))
    response[0, 20, 9] = 12.0
    outside = np.ones((32, 32), dtype=bool)
    outside[15:26, 4:15] = False
    rest = response[0][outside]
    expected = (12.0 - rest.mean()) / rest.std()
    found = peak_to_sidelobe(torch.from_numpy(response), torch.tensor([20]), torch.tensor([9]))
    assert float(found) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"learning_rate": 1.5}, "learning_rate: got 1.5"),
        ({"sigma": 0.0}, "expected a positive"),
        ({"size": 8}, "size: got 8"),
        ({"size": 32.5}, "size: got 32.5"),
        ({"max_tracks": 0}, "max_tracks: got 0"),
        ({"max_tracks": 2.5}, "max_tracks: got 2.5"),
        ({"least_ratio": math.nan}, "least_ratio: got nan"),
    ],
)
def test_refuses_bad_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        MosseTracker(**settings)


@pytest.mark.slow
@pytest.mark.skipif(not FILM.is_file(), reason=f"{FILM} is not there")
def test_follows_a_person_in_a_real_film() -> None:
    from tensorsim.data import read_video
    from tensorsim.geometry.boxes import box_iou
    from tensorsim.vision.detection.rtmdet import RTMDet

    video, _ = read_video(FILM, end_s=1.0)
    detector = RTMDet.from_pretrained()
    with torch.inference_mode():
        tracks = MosseTracker()(video, detector(video[:, 0]))
        later = detector(video[0, 20:21])
    assert tracks.boxes.shape[1] >= 1
    assert float(box_iou(tracks.boxes[0, 0, 20][None], later.boxes[0, :1]).max()) > 0.4
