"""Crops to train on: what is drawn at a keypoint is still there after every augmentation."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.training.cutouts import Cutouts
from tensorsim.training.pose_data import (
    MILD_AUGMENTATION,
    Augmentation,
    RenderedPeople,
    box_matrix,
    crop_person,
    cut_picture,
    lean_deg,
    people,
    rotation,
    turned_box,
    upright,
)
from tensorsim.training.shards import Sample, split
from tensorsim.vision.pose2d.crops import BoxCrop, crop_to_image
from tests.training.tars import write_tar
from tests.training.test_shards import jpg

SIZE = (128, 96)
LEFT_WRIST, RIGHT_WRIST, NOSE = 9, 10, 0


def standing(shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """A standing person facing the camera, (19, 3): the left side is on the right of the picture."""
    points = {
        0: (100, 50),
        5: (120, 80),
        6: (80, 80),
        9: (140, 130),
        10: (60, 130),
        11: (112, 140),
        12: (88, 140),
    }
    points |= {13: (112, 180), 14: (88, 180), 15: (112, 220), 16: (88, 220), 17: (100, 70), 18: (100, 35)}
    rows = np.zeros((19, 3), np.float32)
    for joint, (x, y) in points.items():
        rows[joint] = x + shift[0], y + shift[1], 2
    return rows


BOX = np.array([50, 25, 150, 230], np.float32)


def dot(image: np.ndarray, channel: int, point: np.ndarray) -> None:
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    bump = 255 * np.exp(-((u - point[0]) ** 2 + (v - point[1]) ** 2) / (2 * 4.0**2))
    image[..., channel] = np.maximum(image[..., channel], bump.astype(np.uint8))


def centroid(image: np.ndarray, channel: int) -> np.ndarray:
    weight = image[..., channel].astype(np.float64) ** 2
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def drawn(keypoints: np.ndarray) -> np.ndarray:
    """Left wrist red, right wrist green, nose blue."""
    image = np.zeros((280, 200, 3), np.uint8)
    for channel, joint in enumerate((LEFT_WRIST, RIGHT_WRIST, NOSE)):
        dot(image, channel, keypoints[joint])
    return image


def test_without_augmentation_it_is_the_crop_of_the_pipeline() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (280, 200, 3), np.uint8), (0, 0), 3)
    crop = crop_person(image, BOX, standing(), SIZE)
    images = torch.from_numpy(image).permute(2, 0, 1)[None]
    box = torch.from_numpy(BOX)[None]
    expected = 255 * BoxCrop(SIZE)(images, box, torch.zeros(1, dtype=torch.int64))[0].permute(1, 2, 0)
    assert np.abs(crop.image - expected.numpy()).max() < 2  # OpenCV rounds to 1/32 pixel
    back = crop_to_image(torch.from_numpy(crop.points)[None], box, *SIZE, 1.25)[0].numpy()
    np.testing.assert_allclose(back, standing()[:17, :2], atol=1e-3)
    np.testing.assert_array_equal(crop.known, standing()[:17, 2] > 0)


def test_points_stay_on_what_they_label_and_sides_are_exchanged_in_the_mirror() -> None:
    keypoints = standing()
    image = drawn(keypoints)
    straight = mirrored = 0
    for seed in range(60):
        crop = crop_person(
            image, BOX, keypoints, SIZE, Augmentation(half=0, cut=0), np.random.default_rng(seed)
        )
        red, green, blue = (centroid(crop.image, channel) for channel in range(3))
        # Anticlockwise or not: the mirror alone changes it.
        (a, b), (c, d) = red - blue, green - blue
        left, right = (red, green) if a * d - b * c > 0 else (green, red)
        straight, mirrored = straight + (left is red), mirrored + (left is green)
        for joint, place in ((LEFT_WRIST, left), (RIGHT_WRIST, right), (NOSE, blue)):
            if (np.abs(place - np.array([48, 64])) < (30, 46)).all():  # a dot cut by the border has moved
                np.testing.assert_allclose(crop.points[joint], place, atol=0.35)
    assert min(straight, mirrored) > 15


def test_others_are_moved_as_the_person_is() -> None:
    """By the mirror, whose sides change, the edge that cuts and the turn: where they are the person, they stay it."""
    keypoints = standing()
    labelled = keypoints[:17, 2] > 0
    for seed in range(40):
        crop = crop_person(
            drawn(keypoints),
            BOX,
            keypoints,
            SIZE,
            Augmentation(cut=0.5),
            np.random.default_rng(seed),
            keypoints[None, :17],
        )
        np.testing.assert_allclose(crop.rivals[0][labelled], crop.points[labelled], atol=1e-2)
        assert (crop.rivals[0][~labelled] < -1000).all()


def test_mild_crops_are_nearer_to_those_of_the_pipeline() -> None:
    image, keypoints = np.zeros((*SIZE, 3), np.uint8), standing()
    plain = crop_person(image, BOX, keypoints, SIZE).points

    def strays(augmentation: Augmentation) -> float:
        found = []
        for seed in range(200):
            crop = crop_person(image, BOX, keypoints, SIZE, augmentation, np.random.default_rng(seed))
            of_mirror = plain[list(MIRRORED)] * np.float32([-1, 1]) + np.float32([SIZE[1] - 1, 0])
            found.append(min(np.abs(crop.points - way).max() for way in (plain, of_mirror)))
        return float(np.median(found))

    assert 0 < strays(MILD_AUGMENTATION) < 0.7 * strays(Augmentation())


def test_the_mirror_image_is_the_crop_turned_over() -> None:
    points = np.array([[60.0, 30.0, 1.0], [140.0, 200.0, 1.0]])
    straight, mirrored = (points @ box_matrix(BOX, SIZE, mirror).T for mirror in (False, True))
    np.testing.assert_allclose(mirrored, straight * [-1, 1] + [SIZE[1] - 1, 0])


def test_points_outside_or_not_labelled_are_not_known() -> None:
    keypoints = standing()
    keypoints[12, 2] = 0
    small = np.array([80, 120, 120, 160], np.float32)
    crop = crop_person(drawn(keypoints), small, keypoints, (64, 64))
    inside = ((crop.points > -0.5) & (crop.points < 63.5)).all(1)
    np.testing.assert_array_equal(crop.known, inside & (keypoints[:17, 2] > 0))
    assert set(np.flatnonzero(crop.known)) == {11}
    np.testing.assert_array_equal(crop.gone, ~inside & (keypoints[:17, 2] > 0))
    assert not crop_person(drawn(keypoints), BOX, keypoints, SIZE).gone.any()


def test_what_the_edge_cuts_away_is_gone_even_where_the_crop_reaches_beyond() -> None:
    keypoints = standing()
    keypoints[9, 2] = 0
    options = Augmentation(scale=0, turn_deg=0, shift=0, edge=0, lay=0, half=0, cut=1)
    beyond = 0
    for seed in range(20):
        # The mirror image comes first, then the border, then the cut.
        generator = np.random.default_rng(seed)
        mirrored = generator.random() < 0.5
        generator.random(2)
        _part, _box, points = cut_picture(drawn(keypoints), BOX, keypoints, generator)
        crop = crop_person(drawn(keypoints), BOX, keypoints, SIZE, options, np.random.default_rng(seed))
        v = points[list(MIRRORED) if mirrored else slice(17), 2]
        np.testing.assert_array_equal(crop.gone, v < 0)
        np.testing.assert_array_equal(crop.known, v > 0)
        inside = ((crop.points >= 0) & (crop.points <= [SIZE[1] - 1, SIZE[0] - 1])).all(1)
        beyond += int((crop.gone & inside).sum())
    assert beyond > 10


def test_half_bodies() -> None:
    keypoints = standing()
    shown = set()
    for seed in range(30):
        options = Augmentation(scale=0, turn_deg=0, shift=0, edge=0, lay=0, half=1, cut=0)
        known = crop_person(
            drawn(keypoints), BOX, keypoints, SIZE, options, np.random.default_rng(seed)
        ).known
        assert known[[11, 12]].all()
        shown.add((bool(known[NOSE]), bool(known[15])))
    assert shown == {(True, False), (False, True)}


def test_pictures_that_end_within_the_person() -> None:
    keypoints = standing()
    image = drawn(keypoints)
    edges = set()
    for seed in range(60):
        part, box, points = cut_picture(image, BOX, keypoints, np.random.default_rng(seed))
        height, width = part.shape[:2]
        assert (points[:, 2] > 0).sum() >= 4
        assert (box[:2] >= 0).all()
        assert (box[2:] <= [width - 1, height - 1]).all()
        np.testing.assert_array_equal(points[:, 2] != 0, keypoints[:, 2] != 0)
        known = points[points[:, 2] > 0]
        assert (known[:, :2] < [width, height]).all()
        assert (known[:, :2] >= 0).all()
        for joint, channel in ((LEFT_WRIST, 0), (RIGHT_WRIST, 1), (NOSE, 2)):
            u, v = points[joint, :2]
            if points[joint, 2] > 0 and 6 < u < width - 7 and 6 < v < height - 7:
                np.testing.assert_allclose(centroid(part, channel), [u, v], atol=0.05)
        edges.add((part.shape[0] < image.shape[0], part.shape[1] < image.shape[1], points[NOSE, 2] > 0))
    assert {(True, False, True), (True, False, False), (False, True, True)} <= edges


def test_a_person_with_few_labels_is_not_cut() -> None:
    keypoints = standing()
    keypoints[4:, 2] = 0
    for seed in range(10):
        _part, box, points = cut_picture(drawn(keypoints), BOX, keypoints, np.random.default_rng(seed))
        assert box is BOX or (points[:4, 2] > 0).all()


@pytest.mark.parametrize("angle", [-120, -30, 0, 45, 90])
def test_lean_is_clockwise(angle: float) -> None:
    keypoints = standing((-100, -130))
    keypoints[:, :2] = keypoints[:, :2] @ rotation(angle).T
    assert lean_deg(keypoints) == pytest.approx(angle, abs=1e-4)
    keypoints[[5, 6], 2] = 0
    assert np.isnan(lean_deg(keypoints))


def test_clockwise_as_seen() -> None:
    np.testing.assert_allclose(rotation(90) @ [0, -1], [1, 0], atol=1e-12)  # from the top to the right


def test_who_lies_is_stood_upright() -> None:
    keypoints = standing((-100, -130))
    keypoints[:, :2] = keypoints[:, :2] @ rotation(100).T + [120, 100]
    box = np.concatenate([keypoints[:, :2][keypoints[:, 2] > 0].min(0), keypoints[:, :2].max(0)])
    options = Augmentation(scale=0, turn_deg=0, shift=0, edge=0, lay=0, half=0, cut=0, upright=1)
    for seed in range(5):
        crop = crop_person(
            np.zeros((200, 240, 3), np.uint8), box, keypoints, SIZE, options, np.random.default_rng(seed)
        )
        rows = np.concatenate([crop.points, crop.known[:, None]], 1).astype(np.float32)
        assert abs(lean_deg(rows)) < 1
        assert crop.known[[0, 15, 16]].all()


def test_box_turns_with_the_person() -> None:
    keypoints = standing()
    box = BOX - np.array([10, 0, 0, 0], np.float32)
    np.testing.assert_allclose(turned_box(box, keypoints, np.eye(2)), box, atol=1e-4)
    # A quarter turn clockwise takes (x, y) to (-y, x).
    np.testing.assert_allclose(turned_box(box, keypoints, rotation(90)), [-230, 40, -25, 150], atol=1e-4)


def test_bad_calls_are_refused() -> None:
    image = np.zeros((9, 9, 3), np.uint8)
    with pytest.raises(TensorsimError, match="without labelled"):
        crop_person(image, BOX, np.zeros((17, 3), np.float32), SIZE)
    with pytest.raises(TensorsimError, match="generator"):
        crop_person(image, BOX, standing(), SIZE, Augmentation())


def sample(path: Path, key: str = "a", keypoints: np.ndarray | None = None) -> Sample:
    rows = standing() if keypoints is None else keypoints
    return Sample(key, BOX[None], rows[None], np.array([9.0], np.float32), True, path)


def test_people_are_those_with_points_enough(tmp_path: Path) -> None:
    few = standing()
    few[5:17, 2] = 0
    samples = [sample(tmp_path), sample(tmp_path, keypoints=few)]
    assert [person.area for person in people(samples)] == [9.0]
    assert len(people(samples, least=1)) == 2
    assert people(samples, least_px=500) == []
    lying = standing()
    lying[:, :2] = lying[:, :2] @ rotation(80).T
    assert len(upright(people([samples[0], sample(tmp_path, keypoints=lying)]))) == 1


def test_the_same_pictures_are_held_out_whatever_else_there_is(tmp_path: Path) -> None:
    samples = [sample(tmp_path, f"im{n}") for n in range(400)]
    train, held_out = split(samples, 10)
    assert len(train) + len(held_out) == 400
    assert 20 < len(held_out) < 60
    again = split(samples[::-1][:200], 10)[1]
    assert {s.key for s in again} <= {s.key for s in held_out}


def write_cutouts(path: Path, count: int = 2) -> Path:
    """Red disks with a green hole, keypoints on a circle."""
    rgba = np.full((60, 40, 4), (255, 255, 0, 0), np.uint8)  # what is transparent has a colour all the same
    cv2.ellipse(rgba, (20, 30), (18, 28), 0, 0, 360, (0, 0, 255, 255), -1)
    angles = np.linspace(0, 2 * np.pi, 17, endpoint=False)
    points = np.stack([20 + 12 * np.cos(angles), 30 + 20 * np.sin(angles), np.full(17, 2)], -1)
    png = cv2.imencode(".png", rgba)[1].tobytes()
    pictures = {f"{number:06d}.png": png for number in range(count)}
    labels = {f"{number:06d}.json": {"keypoints": points.tolist()} for number in range(count)}
    return write_tar(path, pictures | labels)


def test_rendered_people_cover_the_place_and_nothing_else(tmp_path: Path) -> None:
    picture = tmp_path / "place.jpg"
    picture.write_bytes(jpg(3, 80, 60))
    place = Sample(
        "place",
        np.zeros((0, 4), np.float32),
        np.zeros((0, 19, 3), np.float32),
        np.zeros(0, np.float32),
        True,
        picture,
    )
    colour = place.image()[0, 0].astype(int)
    rendered = RenderedPeople(Cutouts([write_cutouts(tmp_path / "cutouts-000.tar")]), [place])
    for seed in range(8):
        crop = rendered.crop(0, SIZE, Augmentation(half=0, cut=0), np.random.default_rng(seed))
        at = np.rint(crop.points[crop.known]).astype(int).clip(0, [95, 127])
        assert (np.abs(crop.image[at[:, 1], at[:, 0]].astype(int) - [255, 0, 0]) <= 8).all()
        # Every pixel is a mixture of the two colours: no black seam, no repeated border.
        share = (
            (crop.image.astype(float) - colour) @ ([255, 0, 0] - colour) / (([255, 0, 0] - colour) ** 2).sum()
        )
        mixture = colour + share[..., None] * ([255, 0, 0] - colour)
        assert np.abs(mixture - crop.image).max() < 12
        assert (share < 0.05).any()
    with pytest.raises(TensorsimError, match="some of each"):
        RenderedPeople(rendered.cutouts, [])
