import os
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensorsim.data import read_video, video
from tensorsim.data.video import VideoReader, opening
from tensorsim.data.video_writer import write_video
from tensorsim.errors import TensorsimError, TensorsimWarning, collected_warnings

HEIGHT, WIDTH, SIDE = 48, 64, 12
BACKGROUND, SQUARE = (30, 60, 200), (230, 120, 20)  # RGB


def picture(index: int) -> np.ndarray:
    """A square that moves two pixels right per frame, 16 pixels below the top."""
    frame = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    frame[:] = BACKGROUND
    frame[16 : 16 + SIDE, 2 * index : 2 * index + SIDE] = SQUARE
    return frame


def write_clip(path: Path, frames: int = 20, fps: float = 25.0) -> Path:
    if path.suffix == ".gif":
        image = pytest.importorskip("PIL.Image")
        pictures = [image.fromarray(picture(i)) for i in range(frames)]
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 / fps))
        return path
    if path.suffix == ".mjpeg":
        pictures = [cv2.imencode(".jpg", picture(i)[..., ::-1])[1].tobytes() for i in range(frames)]
        path.write_bytes(b"".join(pictures))
        return path
    code = {".avi": "MJPG", ".mp4": "mp4v", ".mkv": "FFV1", ".mxf": "mpg2"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for i in range(frames):
        writer.write(picture(i)[..., ::-1].copy())
    writer.release()
    return path


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return write_clip(tmp_path / "clip.mp4")


def read(path: Path, size: int = 7, **arguments: float) -> torch.Tensor:
    return torch.cat(list(VideoReader(path, **arguments).chunks(size)))  # type: ignore[arg-type]


def square_of(frame: torch.Tensor) -> tuple[float, float]:
    """Column and row of the middle of the square."""
    rows, columns = np.nonzero(frame[0].numpy().astype(int) > 130)
    return float(columns.mean()), float(rows.mean())


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".gif", ".mkv"])
def test_frames_in_order_upright_and_rgb(tmp_path: Path, suffix: str) -> None:
    reader = VideoReader(write_clip(tmp_path / f"clip{suffix}"))
    assert reader.fps == pytest.approx(25.0)
    assert (reader.height, reader.width, reader.frame_count) == (HEIGHT, WIDTH, 20)
    chunks = list(reader.chunks(8))
    assert [c.shape[0] for c in chunks] == [8, 8, 4]
    frames = torch.cat(chunks)
    assert frames.dtype == torch.uint8
    assert frames.shape == (20, 3, HEIGHT, WIDTH)
    for i, frame in enumerate(frames):
        column, row = square_of(frame)
        assert column == pytest.approx(2 * i + (SIDE - 1) / 2, abs=0.3)
        assert row == pytest.approx(16 + (SIDE - 1) / 2, abs=0.3)
        assert frame[:, 22, 2 * i + 6].tolist() == pytest.approx(list(SQUARE), abs=12)
        assert frame[:, 40, 40].tolist() == pytest.approx(list(BACKGROUND), abs=12)


def test_lossless_frames_are_exact(tmp_path: Path) -> None:
    frames = read(write_clip(tmp_path / "clip.gif"))
    assert torch.equal(frames[5].permute(1, 2, 0), torch.from_numpy(picture(5)))


def test_two_passes_are_equal_and_chunks_do_not_share_memory(clip: Path) -> None:
    reader = VideoReader(clip)
    first, second = list(reader.chunks(3)), list(reader.chunks(20))
    assert torch.equal(torch.cat(first), torch.cat(second))


def test_pass_may_be_left_early_and_passes_interleaved(clip: Path) -> None:
    reader = VideoReader(clip)
    next(reader.chunks(4))
    for a, b in zip(reader.chunks(4), reader.chunks(4), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    ("arguments", "indices"),
    [
        ({"start_s": 0.2}, range(5, 20)),
        ({"start_s": 0.21}, range(6, 20)),
        ({"end_s": 0.4}, range(10)),
        ({"start_s": 0.2, "end_s": 0.41}, range(5, 11)),
        ({"end_s": 60.0}, range(20)),
        ({"end_s": float("inf")}, range(20)),
        ({"stride": 3}, range(0, 20, 3)),
        ({"stride": 50}, [0]),
        ({"start_s": 0.08, "end_s": 0.6, "stride": 4}, range(2, 15, 4)),
        ({"fps": 10.0, "start_s": 0.5, "stride": 2}, range(5, 20, 2)),
    ],
)
def test_range_and_stride(clip: Path, arguments: dict[str, float], indices: range | list[int]) -> None:
    """Frame k is at k / fps; the start belongs to the range, the end does not."""
    reader = VideoReader(clip, **arguments)  # type: ignore[arg-type]
    assert reader.fps == pytest.approx(arguments.get("fps", 25.0) / arguments.get("stride", 1))
    assert reader.frame_count == len(indices)
    frames = torch.cat(list(reader.chunks(4)))
    assert torch.equal(frames, read(clip)[list(indices)])


def test_rotation_flag_of_a_telephone(tmp_path: Path) -> None:
    """A film stored sideways, with a display matrix that rotates it by 90 degrees clockwise."""
    path = write_clip(tmp_path / "clip.mp4")
    data = bytearray(path.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    one = 1 << 16
    assert struct.unpack_from(">9i", data, matrix) == (one, 0, 0, 0, one, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", data, matrix, 0, one, 0, -one, 0, 0, HEIGHT * one, 0, 1 << 30)
    upright = read(path)
    path.write_bytes(data)
    reader = VideoReader(path)
    assert (reader.height, reader.width) == (WIDTH, HEIGHT)
    assert torch.equal(read(path), torch.rot90(upright, -1, (2, 3)))


def test_fps_given_replaces_that_of_the_file(clip: Path) -> None:
    reader = VideoReader(clip, fps=12.5)
    assert reader.fps == 12.5
    assert len(read(clip, fps=12.5)) == 20


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf"), 1000.0, 90000.0])
def test_refuses_absurd_fps_unless_one_is_given(
    clip: Path, monkeypatch: pytest.MonkeyPatch, fps: float
) -> None:
    monkeypatch.setattr(video, "properties", lambda capture: (fps, 20))
    with pytest.raises(TensorsimError, match=f"the file states {fps} frames per second.*give the frame rate"):
        VideoReader(clip)
    assert VideoReader(clip, fps=25.0).fps == 25.0


def test_reads_the_rate_of_a_file_with_a_broken_header(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.avi")
    data = bytearray(path.read_bytes())
    scale_and_rate = data.index(b"strh") + 8 + 20
    struct.pack_into("<2I", data, scale_and_rate, 1, 90000)
    path.write_bytes(data)
    with pytest.raises(TensorsimError, match="90000"):
        VideoReader(path)
    assert VideoReader(path, fps=25.0).fps == 25.0


def test_film_that_does_not_say_how_long_it_is(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "properties", lambda capture: (25.0, None))
    reader = VideoReader(clip)
    assert reader.frame_count is None
    assert sum(c.shape[0] for c in reader.chunks(6)) == 20


@pytest.mark.parametrize("count", [-1, 0, 1e18])
def test_frame_counts_that_are_none(count: float) -> None:
    class Capture:
        def get(self, name: int) -> float:
            return count if name == cv2.CAP_PROP_FRAME_COUNT else 25.0

    assert video.properties(Capture()) == (25.0, None)


def test_cut_off_film_gives_what_is_there(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.avi", frames=30)
    whole = read(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    reader = VideoReader(path)
    with pytest.warns(TensorsimWarning, match=r"got \d+ frames, expected 30 as the file states"):
        frames = torch.cat(list(reader.chunks(8)))
    assert 5 < len(frames) < 25
    assert torch.equal(frames, whole[: len(frames)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read(path, end_s=0.12)) == 3  # what was asked for is there


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fps": 0.0}, "fps: got 0.0, expected a positive finite number"),
        ({"fps": float("nan")}, "fps: got nan"),
        ({"stride": 0}, "stride: got 0, expected stride from 1 to 100000 frames"),
        ({"start_s": -1.0}, "start_s: got -1.0"),
        ({"start_s": float("nan")}, "start_s: got nan"),
        ({"end_s": 0.0}, "end_s: got 0.0, expected a number of seconds above the start, 0.0"),
        ({"start_s": 0.5, "end_s": 0.5}, "end_s: got 0.5"),
        ({"end_s": float("nan")}, "end_s: got nan"),
        (
            {"start_s": 0.8},
            r"got a start of 0.8 s, expected less than its length of 0.800 s \(20 frames at 25",
        ),
        ({"start_s": 100.0}, r"got a start of 100.0 s, expected less than its length of 0.800 s"),
        ({"start_s": 0.21, "end_s": 0.22}, "no frame lies between 0.21 and 0.22 s"),
    ],
)
def test_refuses_impossible_ranges(clip: Path, arguments: dict[str, float], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        VideoReader(clip, **arguments)  # type: ignore[arg-type]


def test_refuses_chunks_of_nothing(clip: Path) -> None:
    with pytest.raises(TensorsimError, match="got a size of 0 frames"):
        VideoReader(clip).chunks(0)


@pytest.mark.parametrize("name", ["clip.mjpeg", "clip.mxf"])
def test_films_of_cameras_and_studios_are_read(name: str, tmp_path: Path) -> None:
    frames = read(write_clip(tmp_path / name))
    assert len(frames) == 20
    assert square_of(frames[10])[0] == pytest.approx(square_of(frames[0])[0] + 20, abs=0.5)


@pytest.mark.parametrize("name", ["clip.jpg", "clip.mjpeg", "clip"])
def test_a_single_picture_is_no_film(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(cv2.imencode(".jpg", picture(0))[1].tobytes())
    with pytest.raises(TensorsimError, match=f"{name}: got a single picture, expected a video"):
        VideoReader(tmp_path / name)


def test_refuses_names_that_are_not_utf_8(clip: Path) -> None:
    """In a process of its own, which OpenCV would end."""
    code = """
import os, shutil, sys
from tensorsim.data.video import VideoReader
from tensorsim.data.video_writer import VideoWriter
from tensorsim.errors import TensorsimError
name = os.fsdecode(os.fsencode(sys.argv[1]) + b"\\xe9.mp4")
shutil.copy(sys.argv[1], name)
for opened in (lambda: VideoReader(name), lambda: VideoWriter(name, 24.0)):
    try:
        opened()
    except TensorsimError as error:
        print(ascii(str(error)))
"""
    done = subprocess.run([sys.executable, "-c", code, str(clip)], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f"'path: got {clip}\\\\udce9.mp4, expected a name in UTF-8'"] * 2


def test_refuses_what_is_no_film(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no such file"):
        VideoReader(tmp_path / "missing.mp4")
    with pytest.raises(TensorsimError, match="got a folder"):
        VideoReader(tmp_path)
    for name, content in (
        ("text.mp4", b"to whom it may concern\n" * 50),
        ("empty.avi", b""),
        ("zeros.mp4", bytes(4096)),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TensorsimError, match=f"{name}: unsupported file type, expected a video"):
            VideoReader(tmp_path / name)
    # A header, and not one frame behind it.
    path = write_clip(tmp_path / "head.avi")
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"movi") + 4])
    with pytest.raises(TensorsimError, match=r"head\.avi: .*expected a video"):
        VideoReader(path)


def test_says_it_on_one_line_and_leaves_no_trace_of_ffmpeg(tmp_path: Path) -> None:
    """In a separate process: FFmpeg is silenced before it starts."""
    (tmp_path / "text.mp4").write_bytes(b"to whom it may concern\n" * 50)
    cut = write_clip(tmp_path / "cut.mp4")
    cut.write_bytes(cut.read_bytes()[:-600])
    program = (
        "import sys\nfrom tensorsim.data.video import VideoReader\n"
        "for path in sys.argv[1:]:\n"
        "    try:\n        VideoReader(path)\n"
        "    except ValueError as error:\n        print(error)\n"
    )
    root = Path(__file__).resolve().parents[2]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("OPENCV_")} | {
        "PYTHONPATH": str(root)
    }
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "text.mp4"), str(cut)],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 2


def test_log_level_of_opencv_comes_back(clip: Path) -> None:
    from cv2.utils import logging

    before = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_WARNING)
    try:
        with pytest.raises(TensorsimError):
            VideoReader(clip, start_s=100.0)
        assert logging.getLogLevel() == logging.LOG_LEVEL_WARNING
    finally:
        logging.setLogLevel(before)


def test_uneven_times_are_said(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    pictures = [image.fromarray(picture(i)) for i in range(20)]
    durations = [40] * 20
    durations[8] = 2000
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:], duration=durations)
    with pytest.warns(
        TensorsimWarning, match=r"a\.gif: .* up to 1\.96 s away from even times at 25 per second"
    ):
        read(tmp_path / "a.gif")
    # Before the pause all is even, and a rate that is given is taken.
    assert len(read(tmp_path / "a.gif", fps=25.0)) == 20
    assert len(read(tmp_path / "a.gif", fps=25.0, end_s=0.2)) == 5


@pytest.mark.filterwarnings("ignore:.* its frames are up to")
def test_frames_at_even_times(tmp_path: Path) -> None:
    """A pause of two seconds repeats its frame, and does not make the film slower than its other frames are."""
    image = pytest.importorskip("PIL.Image")
    durations = [100] * 5 + [2030] + [100] * 4
    pictures = [image.fromarray(picture(i)) for i in range(10)]
    path = tmp_path / "pause.gif"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations)
    reader = VideoReader(path)
    assert reader.uneven_times_s is None  # not read yet
    assert (reader.fps, reader.duration_s) == (10.0, pytest.approx(2.93))
    frames = torch.cat(list(reader.chunks(4)))
    times = np.concatenate([[0.0], np.cumsum(durations[:-1]) / 1000])
    np.testing.assert_allclose(reader.uneven_times_s, times, atol=1e-6)
    even = [
        int(np.abs(times - k / reader.fps).argmin()) for k in range(int(times[-1] * reader.fps + 1e-3) + 1)
    ]
    for size in (3, 100):
        chunks = list(reader.even_chunks(size))
        assert max(len(chunk) for chunk in chunks) <= size
        assert torch.equal(torch.cat(chunks), frames[even])
    assert even.count(5) + even.count(6) > 4
    clip = read_video(path)
    assert torch.equal(clip.video[0], frames[even])
    assert clip.video.shape[1] / clip.fps == pytest.approx(times[-1], abs=1.01 / clip.fps)
    given = VideoReader(path, fps=10.0)
    assert sum(len(chunk) for chunk in given.even_chunks(4)) == 10
    assert given.uneven_times_s is None


@pytest.mark.filterwarnings("ignore:.* its frames are up to")
@pytest.mark.parametrize(
    ("cut", "kept"),
    [
        ({"start_s": 0.3}, range(3, 10)),
        ({"start_s": 1.0}, range(6, 10)),  # in the pause: the next frame is after it
        ({"start_s": 2.55}, range(7, 10)),
        ({"end_s": 2.4}, range(6)),
        ({"start_s": 0.2, "end_s": 2.65, "stride": 2}, (2, 4, 6)),
        ({"fps": 10.0, "start_s": 0.6}, range(6, 10)),  # evenly spaced, as was said
    ],
)
def test_cuts_of_uneven_films_are_in_seconds_of_the_film(
    tmp_path: Path, cut: dict[str, float], kept: range | tuple[int, ...]
) -> None:
    """Frames at 0, 0.1, ... 0.5, and after a pause at 2.5, 2.6, 2.7 and 2.8 s."""
    image = pytest.importorskip("PIL.Image")
    path = tmp_path / "pause.gif"
    pictures = [image.fromarray(picture(i)) for i in range(10)]
    durations = [100] * 5 + [2000] + [100] * 4
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations)
    whole = read(path, fps=10.0)
    assert torch.equal(read(path, **cut), whole[list(kept)])
    with pytest.raises(
        TensorsimError, match=r"a start of 9\.0 s, expected less than its length of [23]\.\d+ s"
    ):
        VideoReader(path, start_s=9.0)
    with pytest.raises(TensorsimError, match=r"no frame lies between 1\.0 and 2\.0 s"):
        VideoReader(path, start_s=1.0, end_s=2.0)


def test_playlists_are_not_opened(clip: Path) -> None:
    for name, text in (
        ("list.m3u8", f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{clip}\n#EXT-X-ENDLIST\n"),
        ("list.mp4", f"ffconcat version 1.0\nfile {clip.name}\n"),
        ("list.sdp", "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n"),
    ):
        path = clip.with_name(name)
        path.write_text(text)
        with pytest.raises(TensorsimError, match=f"{name}: unsupported file type, expected a video"):
            VideoReader(path)


def test_settings_of_opencv_come_back(clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
    monkeypatch.delenv(name, raising=False)
    VideoReader(clip)
    assert name not in os.environ
    monkeypatch.setenv(name, "threads;1")
    VideoReader(clip)
    assert os.environ[name] == "threads;1"


def test_settings_of_opencv_hold_in_every_thread_and_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
    monkeypatch.delenv(name, raising=False)
    level = cv2.utils.logging.getLogLevel()
    first, second = opening(), opening()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert os.environ[name] == "protocol_whitelist;file"
    assert cv2.utils.logging.getLogLevel() == cv2.utils.logging.LOG_LEVEL_SILENT
    second.__exit__(None, None, None)
    assert name not in os.environ
    assert cv2.utils.logging.getLogLevel() == level


def test_huge_frames_are_refused_when_the_film_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "huge.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (8192, 32))
    writer.write(np.zeros((32, 8192, 3), np.uint8))
    writer.release()
    with pytest.raises(TensorsimError, match="frames of 8192x32 pixels: got 8192, expected image side"):
        VideoReader(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fps": 1e-300}, "fps: got 1e-300, expected frame rate from 0.1 to 1000"),
        ({"start_s": 1e308}, r"start_s: got 1e\+308, expected time from 0 to"),
        ({"stride": 10**25}, "stride: got 1e"),
    ],
)
def test_implausible_numbers_are_refused(clip: Path, arguments: dict[str, float], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        VideoReader(clip, **arguments)  # type: ignore[arg-type]
    assert len(read(clip, end_s=1e308)) == 20


@pytest.mark.parametrize(
    ("name", "height", "width", "frames", "fps"),
    [
        ("juggle_kick_1person_24fps.mp4", 720, 1280, 247, 24.0),
        ("walk_away_1person_16fps.gif", 270, 480, 71, 14.99),
        ("walk_across_1person_30fps.mp4", 352, 640, 145, 29.76),
        ("hug_2people_28fps.mp4", 1080, 1920, 72, 30.0),
        ("drink_standing_1person_30fps.avi", 1080, 1920, 103, 30.0),
    ],
)
def test_real_films(shared_data: Path, name: str, height: int, width: int, frames: int, fps: float) -> None:
    reader = VideoReader(shared_data / "video" / name)
    assert (reader.height, reader.width, reader.frame_count) == (height, width, frames)
    assert reader.fps == pytest.approx(fps, abs=0.01)
    with collected_warnings() as messages:
        assert sum(chunk.shape[0] for chunk in reader.chunks(16)) == frames
    assert ["30 per second" in message for message in messages] == [True] * (name == "hug_2people_28fps.mp4")


# ---- write_video -----------------------------------------------------------------------------------------


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    write_video(tmp_path / "out.mp4", (picture(i) for i in range(12)), 24.0)
    reader = VideoReader(tmp_path / "out.mp4")
    assert (reader.fps, reader.frame_count) == (24.0, 12)
    for i, frame in enumerate(torch.cat(list(reader.chunks(5)))):
        assert square_of(frame)[0] == pytest.approx(2 * i + (SIDE - 1) / 2, abs=0.3)
        assert frame[:, 40, 40].tolist() == pytest.approx(list(BACKGROUND), abs=12)
    assert [p.name for p in tmp_path.iterdir()] == ["out.mp4"]


def test_odd_sizes_grow_by_a_pixel(tmp_path: Path) -> None:
    write_video(tmp_path / "out.mp4", [picture(i)[:-1, :-1] for i in range(3)], 24.0)
    reader = VideoReader(tmp_path / "out.mp4")
    assert (reader.height, reader.width) == (HEIGHT, WIDTH)


def frames_until(error: Callable[[], BaseException]) -> Iterator[np.ndarray]:
    yield picture(0)
    yield picture(1)
    raise error()


def test_nothing_half_written_stays(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    for error in (KeyboardInterrupt, ZeroDivisionError):
        with pytest.raises(error):
            write_video(path, frames_until(error), 24.0)
        assert list(tmp_path.iterdir()) == []
    write_video(path, [picture(0)], 24.0)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_video(path, frames_until(KeyboardInterrupt), 24.0)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("out.mp4", [], 24.0, "got no frames"),
        ("out.mp4", [picture(0)], 0.0, "fps: got 0.0"),
        (
            "out.mp4",
            [picture(0)[..., 0]],
            24.0,
            r"got a frame of uint8 \(48, 64\), expected uint8 \(H, W, 3\)",
        ),
        ("out.mp4", [picture(0).astype(float)], 24.0, "got a frame of float64"),
        ("out.mp4", [picture(0), picture(1)[1:]], 24.0, r"\(47, 64, 3\), expected uint8 \(48, 64, 3\)"),
        ("out.txt", [picture(0)], 24.0, "out.txt: OpenCV cannot write this file"),
        ("missing/out.mp4", [picture(0)], 24.0, "no such folder"),
    ],
)
def test_refuses_to_write(
    tmp_path: Path, name: str, frames: list[np.ndarray], fps: float, message: str
) -> None:
    with pytest.raises(TensorsimError, match=message):
        write_video(tmp_path / name, frames, fps)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_noticed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A limit on the size of files stands for the end of the disk."""
    import resource

    noise = np.random.default_rng(0).integers(0, 255, (20, 96, 128, 3), np.uint8)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, before[1]))
    try:
        with pytest.raises(TensorsimError, match=r"out\.mp4: could not be written \(.*is the disk full"):
            write_video(tmp_path / "out.mp4", noise, 24.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kept_mb", [0.0, 1.0])
def test_films_that_fit_into_memory_are_decoded_once(
    clip: Path, kept_mb: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = VideoReader(clip, kept_mb=kept_mb)  # 20 frames, 0.18 MB
    expected = read(clip)
    next(reader.chunks(8))  # a pass that ends early keeps nothing
    assert torch.equal(torch.cat(list(reader.chunks(8))), expected)
    decoded = []
    chunks = VideoReader._chunks
    monkeypatch.setattr(VideoReader, "_chunks", lambda *given: decoded.append(given) or chunks(*given))
    assert [len(chunk) for chunk in reader.chunks(4)] == [4] * 5
    assert torch.equal(torch.cat(list(reader.even_chunks(8))), expected)
    assert len(decoded) == (0 if kept_mb else 2)
    # In chunks that do not fit into those that are kept, it is decoded again.
    assert [len(chunk) for chunk in reader.chunks(6)] == [6, 6, 6, 2]
    assert torch.equal(torch.cat(list(reader.chunks(3))), expected)


def test_films_with_more_frames_than_announced_are_not_kept(clip: Path) -> None:
    reader = VideoReader(clip, kept_mb=10 * HEIGHT * WIDTH * 3 / 1e6)
    assert len(torch.cat(list(reader.chunks(4)))) == 20
    reader.frame_count = 10
    for _ in range(2):
        assert len(torch.cat(list(reader.chunks(5)))) == 20
