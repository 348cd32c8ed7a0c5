"""The recipe for films: pictures, augmentation, a step of training, calibration, and the store behind it."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from tensorsim.commands.train_everyday import TrainEveryday
from tensorsim.errors import TensorsimError
from tensorsim.radar.presets import PRESETS
from tensorsim.recognition import ActivityRecognizer, SPGNet
from tensorsim.recognition.calibration import fit_temperature
from tensorsim.training.everyday_classifier import (
    PASSING,
    REVERSED,
    WALKING,
    EverydayRecipe,
    augmented,
    folded,
    load_between,
    masked,
    passing,
    save_calibrated,
)
from tensorsim.training.everyday_maps import (
    ClipMaker,
    EverydaySettings,
    EverydayStore,
    Radars,
    build_everyday,
    make_group,
)
from tensorsim.training.maps import to_bytes
from tensorsim.training.order import shuffled
from tensorsim.weights import load_state_dict, read_metadata, save_weights

SETTINGS = EverydaySettings(size=32, filmed=1, true=1)


def store(folder: Path, settings: EverydaySettings, groups: int) -> None:
    """Groups whose activity k lights row 2 k + 3 of 32."""
    folder.mkdir()
    (folder / "settings.json").write_text(json.dumps(asdict(settings)))
    power = torch.full((24, 2, 32, 32), 1e-3)
    labels = torch.arange(12).repeat_interleave(2)
    for clip, label in enumerate(labels.tolist()):
        power[clip, :, 2 * label + 3] = 1.0
    power = torch.nn.functional.interpolate(power, settings.size)
    for group in range(groups):
        save_file(
            {"pictures": to_bytes(power), "activity": labels, "filmed": torch.arange(24) % 2 == 0},
            folder / f"everyday-{group:05d}.safetensors",
        )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    store(tmp_path / "store", SETTINGS, 10)
    return tmp_path / "store"


def test_augmentation_keeps_what_a_clip_shows():
    power = torch.full((32, 32), 1e-6)
    power[8, :16] = 1.0
    generator = torch.Generator().manual_seed(0)
    noise = torch.linspace(1, 0, 32)
    seen = set()
    for _ in range(60):
        picture, label = augmented(power, 4, noise, generator)
        row = int(picture[:, 4:-4].mean(1).argmax())
        early = float(picture[row, :16].mean()) > float(picture[row, 16:].mean())
        assert row in (8, 23)
        assert label == (4 if early else REVERSED[4])
        assert float(picture[:, 20].argmin()) >= 0
        seen.add((row, early))
    assert len(seen) == 4


def test_a_fifth_of_the_pictures_has_both_signs_of_speed_in_one():
    power = torch.rand(32, 32, generator=torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(0)
    pictures = [augmented(power, 2, torch.zeros(32), generator)[0] for _ in range(400)]
    same = [float((picture - picture.flip(0)).abs().max()) < 1e-6 for picture in pictures]
    assert 0.14 < sum(same) / 400 < 0.26
    both = folded(power)
    torch.testing.assert_close(both, (power + power.flip(0)) / (power + power.flip(0)).max())
    assert float(folded(torch.zeros(32, 32)).max()) == 0.0


def test_some_who_walk_come_late_or_leave_early():
    power = torch.ones(32, 40)
    power[8] = 2.0
    seen = passing(power / 2, 0.25, 0.1)
    assert float(seen.max()) == 1.0
    assert (seen[0] > 0).nonzero().flatten().tolist() == list(range(10, 36))
    assert float(passing(power, 0.6, 0.6).max()) == 0.0
    generator = torch.Generator().manual_seed(0)
    shares = {}
    for activity in (2, WALKING):
        pictures = [augmented(power, activity, torch.zeros(32), generator)[0] for _ in range(300)]
        shares[activity] = sum(bool((picture.amax(0) < 1e-6).any()) for picture in pictures) / 300
    assert shares[2] == 0.0
    # Of those, a quarter are there all the time.
    assert shares[WALKING] == pytest.approx(PASSING * 0.75, abs=0.08)


def test_falls_are_never_played_backwards():
    power = torch.zeros(32, 32)
    power[8, :8] = 1.0
    generator = torch.Generator().manual_seed(0)
    for activity in (10, 11):
        for _ in range(20):
            picture, label = augmented(power, activity, torch.zeros(32), generator)
            assert label == activity
            assert float(picture[:, :16].sum()) > 0.9 * float(picture.sum())


def test_masks_are_bands():
    pictures = masked(torch.ones(50, 1, 32, 32), torch.Generator().manual_seed(0))
    blank = pictures[:, 0] == 0
    for picture in blank:
        rows, columns = picture.all(1), picture.all(0)
        assert torch.equal(picture, rows[:, None] | columns)
        assert int(rows.sum()) <= 4
        assert int(columns.sum()) <= 4
    assert 0.0 < float(blank.double().mean()) < 0.2


def test_masks_do_not_depend_on_the_augmentation(folder, monkeypatch):
    recipe, flips = EverydayRecipe("spgnet", EverydayStore(folder)), []

    def noted(power, activity, noise, generator):
        flips.append(float(torch.rand((), generator=generator)))
        return torch.ones_like(power), activity

    monkeypatch.setattr("tensorsim.training.everyday_classifier.augmented", noted)
    looks = torch.stack([recipe.collate([recipe.sample(k)])["picture"][0, 0] for k in range(200)])
    rows = (looks == 0).all(2).sum(1).float()
    assert abs(float(torch.corrcoef(torch.stack([torch.tensor(flips), rows]))[0, 1])) < 0.25


def test_samples_come_from_groups_that_are_not_held_out_and_depend_on_their_number(folder):
    store = EverydayStore(folder)
    recipe = EverydayRecipe("spgnet", store, seed=1)
    assert set(store.group[recipe.validation[:, 0]].tolist()) == {4, 9}
    assert len(recipe.training) == 8 * 24 * 2
    torch.testing.assert_close(recipe.sample(7)["picture"], recipe.sample(7)["picture"], rtol=0, atol=0)
    count = len(recipe.training)
    first, second = ([shuffled(e * count + k, count, recipe.seed) for k in range(count)] for e in range(2))
    assert sorted(first) == list(range(count))
    assert first != second
    batch = recipe.collate([recipe.sample(k) for k in range(8)])
    losses = recipe.loss(recipe.net.train(), batch)
    losses["loss"].backward()
    assert batch["picture"].shape == (8, 1, 32, 32)
    assert recipe.rate(0, 100) < recipe.rate(5, 100)
    assert recipe.rate(99, 100) < 0.02
    recipe.net.eval()
    figures = recipe.validate(recipe.net)
    assert set(figures) >= {"free-space filmed", "through-wall true", "through-wall folded", "score"}


def test_calibration_writes_the_temperature_that_fits_the_held_out_films(folder, tmp_path):
    recipe = EverydayRecipe("spgnet", EverydayStore(folder))
    path = tmp_path / "w.safetensors"
    temperature, error = save_calibrated(recipe, path)
    logits, labels = recipe.judged(recipe.net)
    films = recipe.store.filmed[recipe.validation[:, 0]]
    assert temperature == pytest.approx(fit_temperature(logits[films], labels[films]), rel=1e-3)
    assert float(read_metadata(path)["temperature"]) == temperature
    assert 0 <= error <= 1
    recognizer = ActivityRecognizer.from_pretrained(PRESETS["free-space"].radar, path)
    assert recognizer.temperature == temperature


def test_weights_between_two_files_are_their_weighted_mean(tmp_path):
    nets = []
    for seed in range(2):
        torch.manual_seed(seed)
        nets.append(SPGNet(12))
        save_weights(nets[-1], tmp_path / f"{seed}.safetensors", {})
    net = SPGNet(12)
    load_between(net, tmp_path / "0.safetensors", tmp_path / "1.safetensors", 0.25)
    before, after, mean = (one.state_dict() for one in (*nets, net))
    for name in ("fc2.weight", "body.0.0.weight"):
        torch.testing.assert_close(mean[name], 0.75 * before[name] + 0.25 * after[name], rtol=2e-3, atol=1e-4)
    with pytest.raises(TensorsimError, match=r"share: got 1\.5, expected a number from 0 to 1"):
        load_between(net, tmp_path / "0.safetensors", tmp_path / "1.safetensors", 1.5)


def test_the_command_trains_and_writes_a_classifier_that_the_recognizer_takes(tmp_path, monkeypatch):
    store(tmp_path / "maps", EverydaySettings(), groups=5)
    start = tmp_path / "start.safetensors"
    save_weights(SPGNet(12), start, {})
    command = TrainEveryday(
        maps=tmp_path / "maps",
        out=tmp_path / "out",
        groups=5,
        epochs=1,
        init=start,
        share=0.5,
        workers=0,
        quiet=True,
    )
    command.run()
    path = tmp_path / "out" / "classifier.safetensors"
    made = load_state_dict(path)
    assert ActivityRecognizer.from_pretrained(PRESETS["through-wall"].radar, path).temperature > 0
    command.run()  # nothing is left to train
    for name, value in load_state_dict(path).items():
        torch.testing.assert_close(value, made[name], rtol=0, atol=0)
    path.unlink()
    monkeypatch.setattr(TrainEveryday, "train", lambda self, recipe, loop: path)
    monkeypatch.setenv("RANK", "1")
    command.run()  # of several processes the first one calibrates
    assert not path.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"groups": 4}, "--groups: got 4, expected at least 5"),
        ({"share": 0.5}, "--share below 1 needs --init"),
        ({"share": 1.5}, "--share: got 1.5, expected a number from 0 to 1"),
        ({"maps_seed": -1}, "--maps-seed"),
        ({"size": 7}, "--size: got 7, expected a divisor of 64"),
        ({"epochs": 0}, "steps: got 0"),
        ({"learning_rate": 0.0}, "--learning-rate: got 0.0"),
    ],
)
def test_the_command_refuses_before_anything_is_made(options, message, tmp_path):
    with pytest.raises(TensorsimError, match=message):
        TrainEveryday(maps=tmp_path / "maps", out=tmp_path / "out", quiet=True, **options).run()
    assert not list(tmp_path.iterdir())


def test_refuses_stores_and_sizes_that_do_not_serve(folder, tmp_path):
    with pytest.raises(TensorsimError, match="size: got 24, expected a divisor of the store's 32"):
        EverydayRecipe("spgnet", EverydayStore(folder), size=24)
    with pytest.raises(TensorsimError, match="expected groups for training and validation"):
        EverydayRecipe("spgnet", EverydayStore(folder, range(3)))
    with pytest.raises(TensorsimError, match="some are missing"):
        EverydayStore(folder, range(12))
    with pytest.raises(TensorsimError, match=r"no settings\.json"):
        EverydayStore(tmp_path / "nothing")
    with pytest.raises(TensorsimError, match="got maps of"):
        build_everyday(folder, 1, EverydaySettings(seed=3))
    with pytest.raises(TensorsimError, match="EverydaySettings: got"):
        EverydaySettings(filmed=0, true=0)


@pytest.mark.slow
def test_a_group_has_every_activity_in_both_scenes():
    group = make_group(0, EverydaySettings(size=16, filmed=2, true=1), ClipMaker(), Radars(16, 3.8))
    assert group["pictures"].shape[1:] == (2, 16, 16)
    assert set(group["activity"].tolist()) == set(range(12))
    assert bool((group["pictures"].flatten(2).amax(-1) == 255).all())
    counts = torch.bincount(group["activity"])
    assert int(counts.max()) <= 3
    assert 0 < int(group["filmed"].sum()) < len(group["filmed"])
