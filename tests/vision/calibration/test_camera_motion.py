"""A panning camera is distinguished from a static one, even when people walk through its picture."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, TensorsimWarning, collected_warnings
from tensorsim.vision.calibration.camera_motion import BackgroundMotion, similarity_of

FPS, HEIGHT, WIDTH = 30.0, 240, 320


def room(seed: int = 0) -> np.ndarray:
    """A wide picture (480, 960) of a textured room."""
    noise = np.random.default_rng(seed).integers(0, 255, (60, 120), np.uint8)
    return cv2.GaussianBlur(cv2.resize(noise, (960, 480), interpolation=cv2.INTER_CUBIC), (0, 0), 1.5)


def seen(matrix: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """What a camera sees through an affine map (2, 3) of its pixels to those of the room."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), flags=flags)


def film(speed_px_s: float, zoom_per_s: float = 1.0, seconds: float = 2.0, walker: bool = True) -> Tensor:
    """Frames (T, 3, H, W) of a camera that pans and zooms; a textured person crosses the picture."""
    picture, person = room(), room(1)[:160, :70]
    frames = []
    for k in range(round(seconds * FPS)):
        scale = zoom_per_s ** (-k / FPS)
        matrix = np.array([[scale, 0, 200 + speed_px_s * k / FPS], [0, scale, 100.0]])
        frame = seen(matrix, picture)
        if walker:
            left = round(20 + 80 * k / FPS)
            frame[60:220, left : left + 70] = person
        frames.append(frame)
    return torch.from_numpy(np.stack(frames)[:, None].repeat(3, axis=1))


def boxes_of(frames: int) -> tuple[Tensor, Tensor]:
    left = 20 + 80 * torch.arange(frames) / FPS
    top = torch.full_like(left, 60.0)
    return torch.stack([left, top, left + 70, top + 160], dim=-1)[:, None], torch.ones(
        frames, 1, dtype=torch.bool
    )


def watched(frames: Tensor, boxed: bool = True, chunk: int = 8) -> BackgroundMotion:
    background = BackgroundMotion(FPS)
    boxes, valid = boxes_of(len(frames))
    for part in torch.arange(len(frames)).split(chunk):
        background.add(frames[part], boxes[part], valid[part] & boxed)
    return background


@pytest.mark.parametrize("speed_px_s", [15.0, 60.0, 150.0])
def test_a_pan_is_measured(speed_px_s: float) -> None:
    background = watched(film(speed_px_s))
    assert background.shift_px_s == pytest.approx(speed_px_s, rel=0.05)
    with pytest.warns(
        TensorsimWarning, match=f"the camera moves: .* up to {speed_px_s:.0f} pixels per second"
    ):
        background.warn()


@pytest.mark.parametrize("boxed", [True, False])
def test_a_still_camera_is_still_whoever_walks(boxed: bool) -> None:
    background = watched(film(0.0), boxed)
    assert background.shift_px_s is not None
    assert background.shift_px_s < 0.5
    with collected_warnings() as messages:
        background.warn()
    assert messages == []


def test_the_size_of_the_film_counts() -> None:
    small = film(60.0, walker=False)
    large = torch.nn.functional.interpolate(small.float(), scale_factor=3, mode="bilinear").byte()
    background = watched(large, boxed=False)
    assert background.width == 3 * WIDTH
    assert background.shift_px_s == pytest.approx(180.0, rel=0.05)


def test_zooms_count_and_cuts_and_bare_walls_do_not() -> None:
    zoom = watched(film(0.0, 1.3, walker=False), boxed=False)
    assert zoom.moves()
    still = film(0.0, walker=False)
    cut = torch.cat([still[:45], torch.from_numpy(room(7)[:HEIGHT, :WIDTH].copy()).expand(45, 3, -1, -1)])
    assert watched(torch.cat([cut, cut[-45:]]), boxed=False).shift_px_s == pytest.approx(0.0, abs=0.5)
    wall = watched(torch.full((60, 3, HEIGHT, WIDTH), 90, dtype=torch.uint8), boxed=False)
    assert wall.shift_px_s is None
    assert not wall.moves()
    assert watched(still[:20]).shift_px_s is None, "less than a second"


def test_the_similarity_is_that_of_the_background() -> None:
    turn = cv2.getRotationMatrix2D((160, 120), 3.0, 1.05)
    picture = room()
    before, after = (
        picture[100:340, 200:520].copy(),
        seen(np.vstack([turn, [0, 0, 1]])[:2], picture[100:340, 200:520]),
    )
    background = np.full((HEIGHT, WIDTH), 255, np.uint8)
    found = similarity_of(before, background, after, background)
    assert found is not None
    points = np.array([[60.0, 60, 1], [250, 60, 1], [60, 180, 1], [250, 180, 1]]).T
    expected = np.linalg.inv(np.vstack([turn, [0, 0, 1]])) @ points
    assert np.abs((found @ points - expected)[:2]).max() < 0.3
    background[:, :] = 0
    assert similarity_of(before, background, after, background) is None


def test_a_rate_that_cannot_be_is_refused() -> None:
    with pytest.raises(TensorsimError, match="fps"):
        BackgroundMotion(0.0)


@pytest.mark.parametrize(
    ("fps", "every", "steps"), [(30.0, 3, 10), (25.0, 2, 12), (60.0, 6, 10), (1.0, 1, 1)]
)
def test_pictures_a_tenth_of_a_second_apart_make_a_second(fps: float, every: int, steps: int) -> None:
    motion = BackgroundMotion(fps)
    assert (motion._every, motion._second) == (every, steps)
    assert motion._per_s == pytest.approx(fps / (every * steps))
