"""The pose recipe: targets, losses, masks, metrics, a tiny network that learns, and a run that resumes."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.training.cutouts import Cutouts
from tensorsim.training.loop import LoopConfig, fit
from tensorsim.training.pose import (
    PosePeople,
    PoseRecipe,
    TrainedCPM,
    covered,
    distillation_loss,
    gaussian_maps,
    heatmap_loss,
    person_loss,
    sharpened,
)
from tensorsim.training.pose_data import Augmentation, Person, RenderedPeople
from tensorsim.training.pose_metrics import SIGMAS, evaluate_cut, evaluate_pose, oks, pck, pck_either_way
from tensorsim.training.shards import Sample
from tensorsim.vision.pose2d.heatmaps import HeatmapDecoder
from tensorsim.vision.pose2d.hrnet import HRNet, HRNetConfig
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tests.training.test_pose_data import BOX, drawn, sample, standing, write_cutouts
from tests.training.test_shards import jpg
from tests.vision.pose2d.test_onnx_heatmaps import WEIGHT, write_network

TINY = HRNetConfig(4, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=4)


def test_targets_are_gaussians_that_the_decoder_takes_back() -> None:
    points = torch.tensor([[10.3, 20.6], [14.0, 8.25]])
    maps = gaussian_maps(points, (32, 24), 1.5)
    v, u = np.mgrid[:32, :24]
    for (x, y), found in zip(points.tolist(), maps.numpy(), strict=True):
        expected = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 1.5**2))
        np.testing.assert_allclose(found, expected, atol=1e-6)
    decoded, _ = HeatmapDecoder("dark")(maps)
    torch.testing.assert_close(decoded, 4 * points, atol=0.1, rtol=0)


def test_loss_is_the_formula_and_zero_at_the_target_alone() -> None:
    targets = gaussian_maps(torch.tensor([[5.0, 6.0]]), (16, 12), 1.5).double()
    maps = (targets + 0.3 * torch.randn(1, 16, 12, dtype=torch.float64)).requires_grad_()
    t, m = targets[0].numpy(), maps[0].detach().numpy()
    p, q = (np.exp(10 * x) / np.exp(10 * x).sum() for x in (t, m))
    squares = ((1 + 20 * t) * (m - t) ** 2).sum() / (t**2).sum() / 21
    expected = squares + 0.1 * (p * np.log(p / q)).sum()
    found = heatmap_loss(maps, targets)
    assert found.shape == (1,)
    np.testing.assert_allclose(found[0].item(), expected, rtol=1e-9)
    assert torch.autograd.gradcheck(lambda x: heatmap_loss(x, targets), maps)
    assert heatmap_loss(targets, targets).abs().max() < 1e-12


#: No neighbours of three people.
NONE = torch.zeros(3, 0, 17, 2)


def random_people(count: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Points, and which of them are known and which gone."""
    points = 4 + torch.rand(count, 17, 2) * torch.tensor([40.0, 56.0])
    state = torch.rand(count, 17)
    return points, state < 0.6, state > 0.8


def test_unknown_keypoints_cost_nothing() -> None:
    points, known, gone = random_people()
    maps = torch.rand(3, 17, 16, 12, requires_grad=True)
    person_loss(maps, points, known, gone, NONE, torch.tensor([True, False, True]), 1.5).sum().backward()
    assert maps.grad is not None
    told = maps.grad.abs().amax((-2, -1)) > 0
    # A person whose sides are not sure is compared with straight labels as long as the net knows no better.
    torch.testing.assert_close(told, known | gone)
    none = torch.zeros_like(known)
    nobody = person_loss(maps, points, none, none, NONE, torch.ones(3, dtype=torch.bool), 1.5)
    assert (nobody == 0).all()


def test_what_is_gone_should_leave_no_peak() -> None:
    points, known, gone = random_people()
    sided = torch.ones(3, dtype=torch.bool)
    truth = gaussian_maps(points / 4, (16, 12), 1.5) * known[..., None, None]
    assert person_loss(truth, points, known, gone, NONE, sided, 1.5).abs().max() < 1e-5
    ghosts = gaussian_maps(points / 4, (16, 12), 1.5)
    assert person_loss(ghosts, points, known, gone, NONE, sided, 1.5).min() > 0.01


def test_a_peak_at_somebody_else_costs_more_than_one_elsewhere() -> None:
    """Also where the other's joint is not one that is known of the person."""
    sided = torch.ones(1, dtype=torch.bool)
    known = torch.ones(1, 17, dtype=torch.bool)
    gone = torch.zeros(1, 17, dtype=torch.bool)
    points = torch.full((1, 17, 2), 16.0)
    rivals = torch.stack([torch.full((1, 17, 2), 44.0), torch.full((1, 17, 2), -1e4)], dim=1)
    truth = gaussian_maps(points / 4, (16, 12), 1.5)
    at_other = truth + 0.3 * gaussian_maps(rivals[:, 0] / 4, (16, 12), 1.5)
    nobody_there = torch.full_like(rivals, -1e4)
    cheap = person_loss(at_other, points, known, gone, nobody_there, sided, 1.5)
    dear = person_loss(at_other, points, known, gone, rivals, sided, 1.5)
    assert float(dear) > 3 * float(cheap) > 0
    assert float(person_loss(truth, points, known, gone, rivals, sided, 1.5)) < 1e-5


def test_parts_of_crops_are_covered_in_one_colour_at_times() -> None:
    shares = []
    for seed in range(60):
        image = np.full((64, 48, 3), 90, np.uint8)
        changed = (covered(image, np.random.default_rng(seed)) != 90).any(-1)
        shares.append(changed.mean())
        if changed.any():
            assert len(np.unique(image[changed], axis=0)) == 1
    assert 0.15 < np.mean([share > 0 for share in shares]) < 0.55
    assert max(shares) < 0.3


def test_exchanged_sides_are_forgiven_only_where_they_may_be() -> None:
    points, known, gone = random_people()
    mirrored = list(MIRRORED)
    truth = gaussian_maps(points / 4, (16, 12), 1.5) * known[..., None, None]
    wrong = points[:, mirrored], known[:, mirrored], gone[:, mirrored]
    forgiven = person_loss(truth, *wrong, NONE, torch.zeros(3, dtype=torch.bool), 1.5)
    blamed = person_loss(truth, *wrong, NONE, torch.ones(3, dtype=torch.bool), 1.5)
    assert forgiven.abs().max() < 1e-5
    assert blamed.min() > 0.1


def test_oks_and_pck_by_hand() -> None:
    points = torch.zeros(1, 17, 2, dtype=torch.float64)
    area = torch.tensor([100.0], dtype=torch.float64)
    known = torch.zeros(1, 17, dtype=torch.bool)
    known[0, [0, 11]] = True
    found = points.clone()
    # exp(-d^2 / (2 area (2 sigma)^2)) = 1/2 for the nose; the hip is right; the others do not count.
    found[0, 0, 0] = (2 * 100 * (2 * SIGMAS[0]) ** 2 * np.log(2)) ** 0.5
    found[0, 5] = 1e3
    np.testing.assert_allclose(oks(found, points, known, area), [0.75])
    assert oks(found, points, torch.zeros_like(known), area).isnan().all()
    found[0, 0] = torch.tensor([3.0, 4.0])
    for side, share in ((51.0, 1.0), (49.0, 0.5)):
        assert pck(found, points, known, torch.tensor([side], dtype=torch.float64)) == share


class Brightness(nn.Module):
    """Sees every keypoint where the crop is bright."""

    def forward(self, crops: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(crops.mean(1, keepdim=True), 4).expand(-1, 17, -1, -1)


def picture_of(place: tuple[int, int], path: Path) -> Person:
    import cv2

    image = np.zeros((120, 100, 3), np.uint8)
    cv2.circle(image, place, 3, (255, 255, 255), -1)
    cv2.imwrite(str(path), image)
    keypoints = np.zeros((19, 3), np.float32)
    keypoints[:17] = *place, 2
    box = np.array([10, 10, 90, 110], np.float32)
    whole = Sample("a", box[None], keypoints[None], np.array([4000.0], np.float32), True, path)
    return Person(whole, box, keypoints, 4000.0)


def test_evaluation_goes_through_the_pipeline(tmp_path: Path) -> None:
    person = picture_of((60, 40), tmp_path / "a.png")
    right = evaluate_pose(Brightness(), [person])
    assert right["pck"] == right["pck_body"] == 1
    assert right["oks"] > 0.85
    elsewhere = person.keypoints + np.array([0, 30, 0], np.float32)
    wrong = evaluate_pose(Brightness(), [person, person._replace(keypoints=elsewhere)])
    assert wrong["pck"] == 0.5
    assert wrong["oks"] == pytest.approx(right["oks"] / 2, abs=0.02)
    with pytest.raises(TensorsimError, match="no people"):
        evaluate_pose(Brightness(), [])


def test_pairs_count_either_way_round() -> None:
    """Knees exchanged cost nothing, both ankles at the left one a half; pairs of which one is labelled are left out."""
    points = torch.arange(2 * 17 * 2, dtype=torch.float32).view(2, 17, 2) * 40
    known = torch.zeros(2, 17, dtype=torch.bool)
    known[:, 13:17] = True
    known[0, 9] = True
    found = points.clone()
    found[0, [13, 14]] = points[0, [14, 13]]
    found[1, 16] = points[1, 15]
    found[0, 9] = -500.0
    share = pck_either_way(found + 1.0, points, known, torch.tensor([100.0, 100.0]))
    assert float(share) == 7 / 8
    assert float(pck_either_way(found + 8.0, points, known, torch.tensor([100.0, 100.0]))) == 0
    assert float(pck_either_way(found + 8.0, points, known, torch.tensor([100.0, 200.0]))) == 3 / 8


class Channels(nn.Module):
    """Sees the face where the crop is blue, the left arm where it is red and the right one where it is green."""

    def forward(self, crops: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(crops, 4)[:, [2] * 5 + [0, 1] * 3 + [0] * 6]


class Everything(nn.Module):
    """Sees every keypoint everywhere."""

    def forward(self, crops: Tensor) -> Tensor:
        return torch.ones(len(crops), 17, crops.shape[-2] // 4, crops.shape[-1] // 4)


def test_scores_of_cut_people_tell_what_is_out_of_sight(tmp_path: Path) -> None:
    import cv2

    keypoints = standing()
    keypoints[11:, 2] = 0
    for joints, wrist in (((5, 7), 9), ((6, 8), 10), ((1, 2, 3, 4), 0)):
        keypoints[list(joints)] = keypoints[wrist]
    cv2.imwrite(str(tmp_path / "a.png"), drawn(keypoints)[..., ::-1])
    whole = Sample("a", BOX[None], keypoints[None], np.array([4000.0], np.float32), True, tmp_path / "a.png")
    persons = [Person(whole, BOX, keypoints, 4000.0)] * 20
    told = evaluate_cut(Channels(), persons)
    assert told["seen"] > 0.95
    assert told["ghosts"] < 0.05
    assert evaluate_cut(Everything(), persons) == {"seen": 1.0, "ghosts": 1.0}
    keypoints[3:, 2] = 0  # too few labels to cut
    assert np.isnan(list(evaluate_cut(Everything(), persons).values())).all()


def test_sharpened_maps_are_narrower_gaussians_of_the_same_height() -> None:
    points = torch.tensor([[5.0, 6.0], [7.0, 3.0]])
    heights = torch.tensor([0.7, 0.2])[:, None, None]
    found = sharpened(heights * gaussian_maps(points, (16, 12), 2.0), 1.5)
    torch.testing.assert_close(found, heights * gaussian_maps(points, (16, 12), 1.5))
    assert (sharpened(-torch.ones(1, 4, 4), 1.5) == 0).all()


def test_a_teacher_is_believed_where_the_labels_agree() -> None:
    """Of three people: it is right about all of one but a shoulder, about few of another, and about all of the third,
    of whom some are unknown."""
    points = 4 + (torch.rand(3, 17, 2) * torch.tensor([4.0, 24.0])).round()  # on pixels, where peaks are
    known, gone = torch.ones(3, 17, dtype=torch.bool), torch.zeros(3, 17, dtype=torch.bool)
    known[1:, :4], gone[1:, 0] = False, True
    places = points.clone()
    places[0, 5] += torch.tensor([6.0, 0.0])
    places[1, 9:] += torch.tensor([6.0, 0.0])
    taught = 0.6 * gaussian_maps(places, (32, 16), 1.5)
    maps = torch.rand(3, 17, 32, 16, requires_grad=True)
    loss = distillation_loss(maps, taught, points, known, gone)
    loss.sum().backward()
    assert maps.grad is not None
    told = torch.ones(3, 17, dtype=torch.bool)
    told[0, 5], told[1, :4], told[1, 9:], told[2, 0] = False, False, False, False
    torch.testing.assert_close(maps.grad.abs().amax((-2, -1)) > 0, told)
    # A label is as high as any; what has none keeps the teacher's height.
    best = taught / 0.6
    best[2, 1:4] *= 0.6
    torch.testing.assert_close(
        distillation_loss(best, taught, points, known, gone), torch.zeros(3), atol=1e-6, rtol=0
    )


def test_a_teacher_is_asked_about_what_the_network_is_shown(tmp_path: Path) -> None:
    teacher = OnnxHeatmaps(write_network(tmp_path / "teacher.onnx", size=(64, 64)), threads=1)
    with_teacher, alone = recipe(tmp_path, teacher=teacher), recipe(tmp_path)
    batch = with_teacher.collate([with_teacher.sample(n) for n in range(4)])
    crops = batch["crops"].float() / 255
    torch.testing.assert_close(batch["taught"].float(), sharpened(teacher(crops), 1.5), atol=1e-3, rtol=0)
    losses = with_teacher.loss(with_teacher.net, batch)
    expected = distillation_loss(
        with_teacher.net(crops), batch["taught"].float(), batch["points"] / 4, batch["known"], batch["gone"]
    ).mean()
    torch.testing.assert_close(losses["distillation"], expected)
    labels = alone.loss(with_teacher.net, batch)
    assert labels.keys() == {"loss"}
    torch.testing.assert_close(losses["loss"], labels["loss"] + expected)


def test_the_settings_tell_teachers_apart(tmp_path: Path) -> None:
    settings = [recipe(tmp_path).settings]
    for weight in (WEIGHT, 2 * WEIGHT):
        path = write_network(tmp_path / "teacher.onnx", size=(64, 64), weight=weight)
        settings.append(recipe(tmp_path, teacher=OnnxHeatmaps(path)).settings)
    assert len({each["teacher"] for each in settings}) == 3


def recipe(folder: Path, **options: object) -> PoseRecipe:
    (folder / "a.jpg").write_bytes(jpg(1, 280, 200))
    (folder / "place.jpg").write_bytes(jpg(3, 80, 60))
    persons = [Person(sample(folder / "a.jpg"), BOX, standing(), 9000.0)]
    rendered = RenderedPeople(
        Cutouts([write_cutouts(folder / "cutouts-000.tar")]), [sample(folder / "place.jpg")]
    )
    torch.manual_seed(0)
    net = HRNet(TINY, (64, 64))
    everyone = PosePeople(persons, persons, persons)
    return PoseRecipe(net, everyone, {"held_out": persons}, rendered, first_size=(32, 32), **options)  # type: ignore[arg-type]


def test_samples_depend_on_seed_and_number_only(tmp_path: Path) -> None:
    one, two = recipe(tmp_path, first_samples=6), recipe(tmp_path, first_samples=6, seed=1)
    samples = [one.sample(n) for n in range(40)]
    for n in (7, 3):
        for name, value in one.sample(n).items():
            np.testing.assert_array_equal(value, samples[n][name])
    assert not np.array_equal(two.sample(3)["points"], samples[3]["points"])
    assert [s["crops"].shape for s in samples[4:8]] == [(3, 32, 32)] * 2 + [(3, 64, 64)] * 2
    assert {s["sided"] for s in samples} == {True, False}


def test_legs_below_the_picture_are_gone(tmp_path: Path) -> None:
    some = recipe(tmp_path)
    legless, box = standing(), BOX.copy()
    legless[13:17, 2], box[3] = 0, 279
    person = some.groups[0][0]._replace(keypoints=legless, box=box)
    for shown, gone in ((person, True), (person._replace(box=BOX), False)):
        only = PoseRecipe(some.net, PosePeople([shown], [], []), {}, augmentation=Augmentation(cut=0, half=0))  # type: ignore[arg-type]
        assert all(only.sample(n)["gone"][13:17].all() == gone for n in range(5))


def test_who_stands_and_who_has_others_beside_comes_more_often(tmp_path: Path) -> None:
    some = recipe(tmp_path)
    alone = some.groups[0][0]
    lying = standing()
    lying[:, :2] = lying[:, [1, 0]]
    beside = alone._replace(others=standing()[None, :17])
    persons = [alone._replace(keypoints=lying), alone, beside]
    recipe_of_them = PoseRecipe(some.net, PosePeople(persons, [], []), {})  # type: ignore[arg-type]
    np.testing.assert_allclose(recipe_of_them.weights[0], [1 / 6, 2 / 6, 3 / 6])


def test_sources_left_out(tmp_path: Path) -> None:
    full = recipe(tmp_path)
    only = PoseRecipe(full.net, PosePeople(full.groups[0], [], []), {})  # type: ignore[arg-type]
    assert all(only.sample(n)["sided"] for n in range(10))
    with pytest.raises(TensorsimError, match="got no people to train on"):
        PoseRecipe(full.net, PosePeople([], [], []), {})  # type: ignore[arg-type]


def test_loss_of_a_batch_reaches_the_network(tmp_path: Path) -> None:
    some = recipe(tmp_path)
    batch = some.collate([some.sample(n) for n in range(4)])
    some.loss(some.net, batch)["loss"].backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in some.net.parameters())


def test_every_stage_of_cpm_learns(tmp_path: Path) -> None:
    """The loss is the mean of those of the stages, on maps of an eighth of the size of the crops."""
    some = recipe(tmp_path)
    net = TrainedCPM(3, (64, 64), width=8)
    of_cpm = PoseRecipe(net, PosePeople(some.groups[0], [], []), {})  # type: ignore[arg-type]
    batch = of_cpm.collate([of_cpm.sample(n) for n in range(2)])
    crops = batch["crops"].float() / 255
    stages = net.train()(crops)
    assert stages.shape == (3, 2, 17, 8, 8)
    known, gone = batch["known"][..., None, None], batch["gone"][..., None, None]
    expected = 0.0
    for maps in stages:
        targets = gaussian_maps(batch["points"] / 8, (8, 8), 1.5) * known
        told = (known | gone)[..., 0, 0]
        rivals = batch["rivals"]
        others = gaussian_maps(rivals / 8, (8, 8), 1.5).amax(1) if rivals.shape[1] else 0 * targets
        losses = heatmap_loss(maps, targets, torch.maximum(targets, others))
        expected += ((losses * told).sum(-1) / told.sum(-1).clamp_min(1)).mean().item() / 3
    loss = of_cpm.loss(net, batch)["loss"]
    assert loss.item() == pytest.approx(expected, rel=1e-4)
    loss.backward()
    assert all(p.grad is not None and float(p.grad.abs().max()) > 0 for p in net.parameters())
    assert torch.equal(net.eval()(crops), net.stages(crops)[-1])


def test_eight_crops_are_learnt(tmp_path: Path) -> None:
    some = recipe(tmp_path)
    batch = some.collate([some.sample(n) for n in range(8)])
    # Random pictures tell the crops apart; the tiny net only has to memorise.
    crops = nn.functional.interpolate(torch.rand(8, 3, 8, 8), size=(64, 64), mode="bilinear")
    net = HRNet(HRNetConfig(8, blocks=1, modules=(1, 1, 1), bottlenecks=1, planes=8), (64, 64))
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    losses = []
    for _ in range(80):
        loss = person_loss(
            net(crops), batch["points"], batch["known"], batch["gone"], batch["rivals"], batch["sided"], 1.5
        ).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]


def test_a_run_goes_on_to_the_same_result_and_loads(tmp_path: Path) -> None:
    def train(out: Path, steps: int) -> dict[str, Tensor]:
        some = recipe(tmp_path, first_samples=4, augmentation=Augmentation())
        some.rate = lambda step, steps: 0.1  # type: ignore[method-assign]
        config = LoopConfig(
            out, steps, 2, workers=0, checkpoint_every=2, validate_every=2, precision="float32", quiet=True
        )
        fit(some, config)
        return torch.load(out / "last.pt", weights_only=True)["net"]

    whole = train(tmp_path / "whole", 4)
    train(tmp_path / "parts", 2)
    for name, value in train(tmp_path / "parts", 4).items():
        assert torch.equal(value, whole[name]), name
    loaded = HRNet.from_pretrained(tmp_path / "whole" / "best.safetensors")
    assert loaded.config == TINY
    assert loaded.input_size == (64, 64)
