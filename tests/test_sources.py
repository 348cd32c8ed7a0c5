"""People from films, keypoints and motion files: what is kept, where they are put, what is drawn."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.body.skeleton import mid_hips
from tensorsim.data.coco import load_coco_keypoints
from tensorsim.data.video import VideoReader
from tensorsim.data.video_writer import write_video
from tensorsim.errors import TensorsimError
from tensorsim.geometry.framing import camera_on, seen_keypoints
from tensorsim.pipeline.reach import NEAREST_M
from tensorsim.sources import CANVAS, Cut, keypoint_source, kind_of, motion_source
from tests.bvh import write_bvh

FPS = 30.0


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    """(45, 14, 3) metres of a person who walks."""
    return ts.motion.ActivityGenerator().generate("walking", seed=3, rate_hz=FPS).joints[0, :45].numpy()


def coco_json(
    keypoints: np.ndarray, scores: np.ndarray, size: tuple[int, int] | None = None
) -> dict[str, Any]:
    """Keypoints (P, T, 17, 2) with scores (P, T, 17) as annotations of a video, entries without scores left out."""
    annotations = [
        {
            "image_id": t,
            "track_id": p,
            "keypoints": np.concatenate([keypoints[p, t], scores[p, t, :, None]], axis=1).ravel().tolist(),
        }
        for p in range(len(keypoints))
        for t in range(keypoints.shape[1])
        if scores[p, t].any()
    ]
    shape = {} if size is None else {"height": size[0], "width": size[1]}
    return {"images": [{"id": t, **shape} for t in range(keypoints.shape[1])], "annotations": annotations}


def lifter(camera: ts.CameraConfig, height_m: float) -> ts.VideoToPose:
    stage = ts.VideoToPose(nn.Identity(), nn.Identity(), person_height_m=(height_m,), camera=camera)
    return stage.eval().requires_grad_(False)


def test_kinds(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "0.json").write_text("[]")
    names = {"a.BVH": "motion", "a.npz": "motion", "a.json": "keypoints", "frames": "keypoints"}
    names |= {"a.mp4": "video", "a": "video", ".": "video"}
    assert {name: kind_of(tmp_path / name) for name in names} == names


@pytest.mark.parametrize("cut", [Cut(), Cut(0.5), Cut(None, 1.0), Cut(0.31, 1.29, 3), Cut(0, math.inf, 7)])
def test_a_cut_keeps_the_frames_that_a_film_keeps(tmp_path: Path, cut: Cut) -> None:
    path = tmp_path / "film.avi"
    write_video(path, (np.full((16, 16, 3), 12 * k, np.uint8) for k in range(20)), 10.0)
    reader = VideoReader(path, start_s=cut.start_s, end_s=cut.end_s, stride=cut.stride)
    levels = torch.cat(list(reader.chunks(9))).float().mean(dim=(1, 2, 3))
    kept = (levels / 12).round().int().tolist()
    assert kept == list(range(20))[cut.frames(20, 10.0, path)]


@pytest.mark.parametrize(
    ("cut", "message"),
    [
        (Cut(stride=0), "stride: got 0"),
        (Cut(-1.0), "start, end: got -1.0"),
        (Cut(1.0, 0.5), "start, end: got 1.0 and 0.5"),
        (Cut(math.nan), "start, end: got nan"),
        (Cut(1.95), "got 0 of its 20 frames"),
        (Cut(stride=20), "got 1 of its 20 frames"),
    ],
)
def test_a_cut_that_leaves_nothing_is_refused(cut: Cut, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        cut.frames(20, 10.0, Path("x"))


def test_bvh_of_generated_motion_comes_back(walk: np.ndarray, tmp_path: Path) -> None:
    write_bvh(tmp_path / "walk.bvh", walk, FPS)
    source = motion_source(tmp_path / "walk.bvh")
    assert source.fps == pytest.approx(FPS)
    assert source.frame_count == 45
    pose = source.find(True).pose
    assert pose.valid.all()
    # Placing puts the lowest ankle at its height over the floor, where the generator had it within 2 cm.
    shift = pose.joints[0, 0].numpy() - walk
    assert np.abs(shift - [0, 0, shift[0, 0, 2]]).max() < 1e-5
    assert abs(shift[0, 0, 2]) < 0.03
    assert source.about["moved_in_front_of_the_radar"] is False


def test_who_comes_too_near_is_moved_away_unless_placed(walk: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "walk.npz"
    np.savez(path, joints=walk - [3.0, 5.0, 0.0], fps=FPS)
    source = motion_source(path)
    joints = source.find(True).pose.joints[0, 0]
    assert float(joints[..., 1].min()) == pytest.approx(NEAREST_M, abs=1e-5)
    hips = mid_hips(joints)[:, 0]
    assert float(hips.min() + hips.max()) == pytest.approx(0, abs=1e-5)
    assert source.about["moved_in_front_of_the_radar"] is True
    placed = motion_source(path, start_range_m=4.0, heading_rad=math.pi).find(True).pose.joints[0, 0]
    assert float(mid_hips(placed)[0, 1]) == pytest.approx(4.0, abs=1e-5)
    turned = (mid_hips(placed)[-1] - mid_hips(placed)[0])[:2]
    original = walk[-1, (8, 11), :2].mean(0) - walk[0, (8, 11), :2].mean(0)
    np.testing.assert_allclose(turned.numpy(), -original, atol=1e-5)


def test_cut_clip_and_people_who_are_never_there(walk: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "many.npz"
    people = np.stack([walk, walk + np.array([0.5, 1.0, 0.0]), walk * 0.0])
    valid = np.ones((3, 45), bool)
    valid[1, :20] = False
    valid[2] = False
    np.savez(path, joints=people, joints_fps=FPS, valid=valid, other=walk)
    source = motion_source(path, "joints", cut=Cut(0.5, None, 3))
    pose = source.find(True).pose
    assert source.fps == pytest.approx(10.0)
    assert pose.valid.tolist() == valid[None, :2, 15::3].tolist()
    assert pose.joints.isfinite().all()
    assert pose.keypoint_scores[0, 1, :1].max() == 0
    np.testing.assert_allclose(
        (pose.joints[0, 0, 4, 3] - pose.joints[0, 0, 0, 3]).numpy(), walk[27, 3] - walk[15, 3], atol=1e-5
    )
    with pytest.raises(TensorsimError, match="expected one of joints, other"):
        motion_source(path, "nothing")
    with pytest.raises(TensorsimError, match="contains no people in these frames"):
        motion_source(_never_there(tmp_path, walk))


def _never_there(folder: Path, walk: np.ndarray) -> Path:
    np.savez(folder / "empty.npz", joints=walk, fps=FPS, valid=np.zeros((1, 45), bool))
    return folder / "empty.npz"


def test_drawn_people_are_where_the_summary_says_the_camera_sees_them(
    walk: np.ndarray, tmp_path: Path
) -> None:
    np.savez(tmp_path / "walk.npz", joints=walk, fps=FPS)
    source = motion_source(tmp_path / "walk.npz")
    pose, about = source.find(True).pose, source.about["camera"]
    camera = ts.CameraConfig(
        horizontal_fov_rad=math.radians(about["horizontal_fov_deg"]),
        pitch_rad=math.radians(about["pitch_deg"]),
        yaw_rad=math.radians(about["yaw_deg"]),
        position_m=tuple(about["position_m"]),
    )
    keypoints = seen_keypoints(pose.joints[0], pose.valid[0], camera, *about["image_size"])[0]
    torch.testing.assert_close(pose.keypoints[0], keypoints, atol=0.1, rtol=0)
    assert pose.keypoint_scores.min() == 1
    frames = torch.cat(list(source.frames()))
    assert frames.shape == (45, 3, *CANVAS)
    assert frames.dtype == torch.uint8


@pytest.fixture(scope="module")
def filmed(walk: np.ndarray) -> tuple[ts.CameraConfig, np.ndarray, np.ndarray]:
    """A camera and the keypoints (1, 45, 17, 2) and scores that it sees of the walk."""
    joints, valid = torch.from_numpy(walk)[None], torch.ones(1, 45, dtype=torch.bool)
    camera = camera_on(joints, valid, *CANVAS)
    keypoints, scores = seen_keypoints(joints, valid, camera, *CANVAS)
    return camera, keypoints.numpy(), scores.numpy()


def test_true_keypoints_lead_back_to_the_motion(
    walk: np.ndarray, filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    camera, keypoints, scores = filmed
    path = tmp_path / "walk.json"
    path.write_text(json.dumps(coco_json(keypoints, scores, CANVAS)))
    people = ts.motion.ActivityGenerator().generate("walking", seed=3, rate_hz=FPS).people
    source = keypoint_source(path, lifter(camera, float(people.height_m[0])), FPS)
    joints = source.find(True).pose.joints[0, 0].numpy()
    assert source.frame_count == 45
    assert torch.cat(list(source.frames())).shape == (45, 3, *CANVAS)
    error = np.linalg.norm(joints - walk, axis=-1)
    assert error.mean() < 0.35, "one camera, range by apparent size"
    away = joints[:, (8, 11), 1].mean(1) - walk[:, (8, 11), 1].mean(1)
    assert np.abs(away).mean() < 0.3
    assert np.abs(away - away.mean()).max() < 0.2, "range follows the walk"


def test_gaps_of_a_track_are_bridged_and_frames_are_cut(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    camera, keypoints, scores = filmed
    scores = scores.copy()
    scores[0, :4] = 0
    scores[0, 20:24] = 0
    path = tmp_path / "walk.json"
    path.write_text(json.dumps(coco_json(keypoints, scores)))
    source = keypoint_source(path, lifter(camera, 1.75), 60.0, CANVAS, Cut(0.0, None, 2))
    pose = source.find(True).pose
    assert source.fps == 30.0
    assert pose.valid[0, 0].tolist() == [False] * 2 + [True] * 21
    assert pose.keypoint_scores[0, 0, 10:12].max() == 0
    assert (pose.boxes[0, 0, 2:, 2] > pose.boxes[0, 0, 2:, 0]).all(), "a box in every frame of the track"
    steps = pose.joints[0, 0, 3:].diff(dim=0).norm(dim=-1).amax(dim=-1)
    assert float(steps.max()) < 0.3, "coasts through the gap"


def test_every_second_frame_is_a_file_of_half_the_rate(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    """Also in the smoother, which takes times from the rate: the same joints, to the bit."""
    camera, keypoints, scores = filmed
    whole, half = tmp_path / "whole.json", tmp_path / "half.json"
    whole.write_text(json.dumps(coco_json(keypoints, scores)))
    half.write_text(json.dumps(coco_json(keypoints[:, ::2], scores[:, ::2])))
    kept = keypoint_source(whole, lifter(camera, 1.75), 2 * FPS, CANVAS, Cut(None, None, 2)).find(True).pose
    alone = keypoint_source(half, lifter(camera, 1.75), FPS, CANVAS).find(True).pose
    assert torch.equal(kept.joints, alone.joints)


def write_results(
    path: Path, keypoints: np.ndarray, scores: np.ndarray, orders: list[tuple[int, ...]]
) -> None:
    """Results without ``track_id`` of people (P, T, 17, 2), in each frame those of an order."""
    results = [
        {"image_id": t, "keypoints": np.c_[keypoints[p, t], scores[p, t]].ravel().tolist(), "score": 1.0}
        for t, order in enumerate(orders)
        for p in order
    ]
    path.write_text(json.dumps(results))


def test_people_without_track_id_are_told_apart_by_where_they_are(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    _, keypoints, scores = filmed
    both = np.concatenate([keypoints, keypoints[:, ::-1] + [60.0, 0.0]])
    orders = [((0, 1), (1, 0), (1,), (0,))[int(k)] for k in np.random.default_rng(0).integers(0, 4, 45)]
    write_results(tmp_path / "two.json", both, np.repeat(scores, 2, 0), [(0, 1), *orders[1:]])
    found = load_coco_keypoints(tmp_path / "two.json")
    for p in range(2):
        there = found.valid[:, p]
        assert there.tolist() == [p in order for order in [(0, 1), *orders[1:]]]
        torch.testing.assert_close(found.keypoints[there, p], torch.tensor(both[p]).float()[there])


def test_people_without_track_id_have_the_numbers_in_which_they_come(tmp_path: Path) -> None:
    body = np.random.default_rng(0).uniform(0, 100, (17, 2))
    keypoints = np.stack([np.stack([body + 200.0 * p] * 3) for p in range(5)])
    write_results(
        tmp_path / "five.json", keypoints, np.full((5, 3, 17), 0.9), [(0, 1, 2), (1, 3, 0), (4, 3, 2, 1, 0)]
    )
    found = load_coco_keypoints(tmp_path / "five.json")
    left = found.keypoints[..., 0].mean(dim=-1)[2] - float(body[:, 0].mean())
    assert left.tolist() == pytest.approx([0.0, 200.0, 400.0, 600.0, 800.0], abs=1e-3)


def test_somebody_of_whom_one_keypoint_is_seen_keeps_the_place(tmp_path: Path) -> None:
    body = np.random.default_rng(0).uniform(0, 100, (17, 2))
    keypoints = np.stack([np.stack([body + (200.0 * p + 8.0 * t) for t in range(3)]) for p in range(3)])
    scores = np.full((3, 3, 17), 0.9)
    scores[1, 1, 1:] = 0.0
    write_results(tmp_path / "three.json", keypoints, scores, [(0, 1), (0, 1), (0, 1, 2)])
    found = load_coco_keypoints(tmp_path / "three.json")
    assert found.valid.tolist() == [[True, True, False]] * 2 + [[True] * 3]


def test_somebody_far_from_everybody_before_is_somebody_new(tmp_path: Path) -> None:
    """One leaves and another appears elsewhere; then the first one, absent for a while, is back nearby."""
    body = np.random.default_rng(0).uniform(0, 100, (17, 2))
    keypoints = np.stack([np.stack([body + 250.0 * p + [3.0 * t, 0.0] for t in range(60)]) for p in range(2)])
    scores = np.full((2, 60, 17), 0.9)
    who = [(0,)] * 20 + [(1,)] * 20 + [(0,)] * 20
    write_results(tmp_path / "both.json", keypoints, scores, who)
    found = load_coco_keypoints(tmp_path / "both.json")
    assert found.valid.tolist() == [[0 in here, 1 in here] for here in who]
    torch.testing.assert_close(found.keypoints[50, 0], torch.tensor(keypoints[0, 50]).float())


def test_hidden_keypoints_make_nobody_new(tmp_path: Path) -> None:
    """Of a walking person only the ankles are seen for a while, then only the head, then nothing."""
    body = np.random.default_rng(0).uniform(0, 100, (17, 2))
    body[15:] = [[40.0, 90.0], [42.0, 91.0]]
    keypoints = np.stack([body + np.array([8.0 * t, 0.0]) for t in range(20)])[None]
    scores = np.full((1, 20, 17), 0.9)
    scores[0, 5:12, :15] = 0.0
    scores[0, 12:16, 5:] = 0.0
    scores[0, 16:18] = 0.0
    write_results(tmp_path / "one.json", keypoints, scores, [(0,)] * 20)
    assert load_coco_keypoints(tmp_path / "one.json").valid.tolist() == [[True]] * 20


def test_more_people_one_after_the_other_than_a_scene_has_are_refused(tmp_path: Path) -> None:
    body = np.random.default_rng(0).uniform(0, 10, (17, 2))
    keypoints = np.stack([body + np.array([40.0 * p, 0.0]) for p in range(300)])[:, None]
    write_results(tmp_path / "many.json", keypoints, np.full((300, 1, 17), 0.9), [tuple(range(60))])
    assert load_coco_keypoints(tmp_path / "many.json").valid.shape == (1, 60)
    results = [
        {"image_id": p, "keypoints": np.c_[keypoints[p, 0], np.ones(17)].ravel().tolist()} for p in range(300)
    ]
    (tmp_path / "many.json").write_text(json.dumps(results))
    with pytest.raises(TensorsimError, match=r"many\.json: got 257, expected people from 1 to 256"):
        load_coco_keypoints(tmp_path / "many.json")


def test_scores_above_one_count_as_one_and_percents_are_refused(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    _, keypoints, scores = filmed
    write_results(tmp_path / "walk.json", keypoints, 0 * scores + 1.04, [(0,)] * 45)
    assert torch.equal(load_coco_keypoints(tmp_path / "walk.json").scores, torch.ones(45, 1, 17))
    write_results(tmp_path / "walk.json", keypoints, 0 * scores + 87.5, [(0,)] * 45)
    with pytest.raises(TensorsimError, match=r"got a score of 87\.5 for a keypoint, expected 0 to 1"):
        load_coco_keypoints(tmp_path / "walk.json")


def test_shares_of_the_picture_are_no_pixels(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray], tmp_path: Path
) -> None:
    camera, keypoints, scores = filmed
    (tmp_path / "walk.json").write_text(json.dumps(coco_json(keypoints / CANVAS[::-1], scores)))
    with pytest.raises(TensorsimError, match=r"keypoints: got coordinates up to 0\.\d+, expected pixels"):
        keypoint_source(tmp_path / "walk.json", lifter(camera, 1.75), FPS, CANVAS)


def test_names_of_pictures_and_files_go_by_their_numbers(tmp_path: Path) -> None:
    """Results of AlphaPose have the names of pictures as image ids, and lack pictures without people."""
    numbers = [0, 1, 2, 3, 8, 9, 10, 11]
    results = [
        {"image_id": f"{n}.jpg", "keypoints": [float(n), 2.0, 0.9] * 16 + [50.0, 50.0, 0.9]}
        for n in sorted(numbers, key=str)
    ]
    (tmp_path / "results.json").write_text(json.dumps(results))
    found = load_coco_keypoints(tmp_path / "results.json")
    assert torch.nonzero(found.valid[:, 0]).flatten().tolist() == numbers
    assert found.keypoints[numbers, 0, 0, 0].tolist() == numbers
    folder = tmp_path / "frames"
    folder.mkdir()
    for n in (9, 10, 11):
        (folder / f"clip2_{n}.json").write_text(json.dumps([{"keypoints": [float(n), 2.0, 0.9] * 17}]))
    assert load_coco_keypoints(folder).keypoints[:, 0, 0, 0].tolist() == [9.0, 10.0, 11.0]


@pytest.mark.parametrize("step", [1, 5])
def test_frames_without_anybody_are_not_left_out_of_results(step: int, tmp_path: Path) -> None:
    person = {"keypoints": [1.0, 2.0, 0.9] * 17, "score": 1.0, "category_id": 1}
    numbers = [*range(4), *range(7, 10)]
    results = [{"image_id": 3 + step * number, **person} for number in numbers]
    (tmp_path / "results.json").write_text(json.dumps(results))
    found = load_coco_keypoints(tmp_path / "results.json")
    assert torch.nonzero(found.valid[:, 0]).flatten().tolist() == numbers


@pytest.mark.parametrize(
    "name",
    [
        "cam1_{:06d}.jpg",
        "walk-2/{:06d}.jpg",
        "S001_frame_{:06d}.png",
        "frame-{:04d}.jpg",
        "2026-01-31 {}.jpg",
    ],
)
def test_the_last_number_of_a_name_numbers_the_frame(name: str, tmp_path: Path) -> None:
    numbers = [*range(4), *range(7, 12)]
    results = [{"image_id": name.format(number), "keypoints": [1.0, 2.0, 0.9] * 17} for number in numbers]
    (tmp_path / "results.json").write_text(json.dumps(results))
    found = load_coco_keypoints(tmp_path / "results.json")
    assert torch.nonzero(found.valid[:, 0]).flatten().tolist() == numbers


@pytest.mark.parametrize(
    ("numbers", "frames"),
    [
        ([*range(20), *range(280, 300)], 300),  # seen in a small part of the film
        ([*range(0, 40, 2), 39], 40),  # in every second frame and in the last one
        ([0, 3, 4, 7, 9, 12, 13, 16], 17),
        ([139, 397133, 37777], 3),  # pictures of a data set
        ([*range(0, 5000, 9), 5001, 5003], 558),
        ([*range(20), 2_000_000_000], 21),
        ([*range(20), 99_999], 100_000),
        (["1.jpg", "01.jpg", "2.jpg", "5.jpg"], 4),
        (["a1.jpg", "a2.jpg", "b4.jpg", "b5.jpg"], 4),
        (["a", "b", "c"], 3),
        ([-7, -3, -2, -1], 4),
        ([1, 5], 2),
    ],
)
def test_which_ids_number_frames(numbers: list[int | str], frames: int, tmp_path: Path) -> None:
    results = [{"image_id": number, "keypoints": [1.0, 2.0, 0.9] * 17} for number in numbers]
    (tmp_path / "results.json").write_text(json.dumps(results))
    found = load_coco_keypoints(tmp_path / "results.json")
    assert found.valid.shape == (frames, 1)
    assert int(found.valid.sum()) == len(numbers)


@pytest.mark.parametrize(
    ("fps", "size", "message"),
    [(None, CANVAS, "give --fps"), (0.0, CANVAS, "fps: got 0.0"), (30.0, None, "give --image-size")],
)
def test_keypoints_need_a_rate_and_a_size(
    filmed: tuple[ts.CameraConfig, np.ndarray, np.ndarray],
    tmp_path: Path,
    fps: float | None,
    size: tuple[int, int] | None,
    message: str,
) -> None:
    path = tmp_path / "walk.json"
    path.write_text(json.dumps(coco_json(filmed[1], filmed[2])))
    with pytest.raises(TensorsimError, match=message):
        keypoint_source(path, lifter(filmed[0], 1.75), fps, size)
