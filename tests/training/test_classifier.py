import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.recognition.confusion import confusion
from tensorsim.training.classifier import (
    NETWORKS,
    ClassifierRecipe,
    Clip,
    clips_of,
    drawn_snr,
    held_out,
    logits_of,
    masked,
    picture,
)
from tensorsim.training.loop import LoopConfig, fit
from tensorsim.training.maps import MapSettings, MapStore, to_bytes
from tensorsim.training.order import shuffled

pytest.importorskip("tensorboard")
SIZE = 32


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    """Ten people whose activity k lights row 2 k + 3, a little elsewhere along time for each."""
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "settings.json").write_text(json.dumps(asdict(MapSettings(size=SIZE))))
    for person in range(10):
        generator = torch.Generator().manual_seed(person)
        power = torch.zeros(12, SIZE, SIZE)
        for activity in range(1, 12):
            first = int(torch.randint(0, 16, (), generator=generator))
            power[activity, 2 * activity + 3, first : first + 16] = 1.0
        noise = torch.rand(SIZE, SIZE, generator=generator) + 0.1
        save_file(
            {
                "signal": to_bytes(power),
                "cross": torch.zeros(12, SIZE, SIZE, dtype=torch.int8),
                "noise": to_bytes(noise / noise.max()),
                "gain_db": torch.full((12,), -10.0),
            },
            folder / f"through-wall-{person:05d}.safetensors",
        )
    return MapStore(folder)


def recipe(store: MapStore, **options: object) -> ClassifierRecipe:
    return ClassifierRecipe("spgnet", store, ("through-wall",), 10, **options)  # type: ignore[arg-type]


class Tiny(nn.Module):
    """Reads off which row is lit."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(1))
        self.linear = nn.Linear(SIZE, num_classes)

    def forward(self, pictures: Tensor) -> Tensor:
        return self.linear(pictures.mean(-1).squeeze(-2) - self.mean)


def test_learns_patterns_of_people_it_has_not_seen(
    store: MapStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(NETWORKS, "tiny", (Tiny, SIZE))
    mine = ClassifierRecipe("tiny", store, ("through-wall",), 10, snr_db=(20.0, 50.0))
    monkeypatch.setattr(mine, "optimiser", lambda: torch.optim.Adam(mine.net.parameters(), 0.05))
    before = mine.validate(mine.net)
    config = LoopConfig(tmp_path, 60, 24, workers=0, validate_every=60, ema_decay=0.0, quiet=True)
    figures = fit(mine, config)
    assert before["accuracy through-wall"] < 0.5
    assert figures["accuracy through-wall"] > 0.9
    clips = clips_of(store, ("through-wall",), 10, validation=True)
    counts = confusion(logits_of(mine.net, store, clips, (50.0, 50.0), SIZE), torch.arange(12).repeat(2))
    assert counts.sum(1).tolist() == [2] * 12
    assert int(counts.diagonal().sum()) >= 22


def test_no_body_is_in_both_parts(store: MapStore) -> None:
    mine = recipe(store)
    trained = {clip.person for _, clip in mine.training}
    kept = {clip.person for clip in mine.validation[""][1]}
    assert not trained & kept
    assert kept == {4, 9} == {p for p in range(10) if held_out(p)}
    assert len(mine.training) == 8 * 12


def test_trains_on_motion_that_a_camera_saw_as_well(store: MapStore) -> None:
    filmed = MapStore(store.folder)
    mine = recipe(store, filmed=filmed, filmed_people=5)
    assert [sum(s is one for s, _ in mine.training) for one in (store, filmed)] == [8 * 12, 4 * 12]
    assert {clip.person for clip in mine.validation[" films"][1]} == {4}
    with torch.no_grad():
        figures = mine.validate(mine.net.eval())
    assert set(figures) == {"score", "loss", "accuracy through-wall", "accuracy through-wall films"}


def test_a_training_does_not_go_on_with_other_films(store: MapStore) -> None:
    runs = []
    for films in ("a", "b"):
        filmed = MapStore(store.folder)
        filmed.settings = replace(filmed.settings, films=films)
        runs.append(recipe(store, filmed=filmed, filmed_people=5))
    assert runs[0].settings != runs[1].settings


def test_an_epoch_shows_every_clip_once_in_another_order(store: MapStore) -> None:
    mine = recipe(store)
    count = len(mine.training)
    orders = [[shuffled(e * count + k, count, mine.seed) for k in range(count)] for e in range(2)]
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == list(range(count))
    labels = [mine.sample(index)["label"] for index in range(count)]
    assert all(labels.count(k) == 8 for k in range(12))


def test_a_sample_depends_on_its_number_only(store: MapStore) -> None:
    first = recipe(store).sample(1234)["picture"]
    mine = recipe(store)
    mine.sample(7)
    assert torch.equal(mine.sample(1234)["picture"], first)
    assert first.shape == (1, SIZE, SIZE)
    assert 0 <= float(first.min()) <= float(first.max()) <= 1


def test_a_picture_is_pooled_in_power(store: MapStore) -> None:
    clip = Clip("through-wall", 0, 5)
    power = store.power("through-wall", 0, 5, 50.0)
    pooled = power.reshape(8, 4, 8, 4).mean((1, 3))
    expected = (1 + 10 * (pooled / pooled.max()).clamp_min(1e-4).log10() / 40)[None]
    torch.testing.assert_close(picture(store, clip, 50.0, 8), expected, rtol=0, atol=1e-6)
    with pytest.raises(TensorsimError, match="got size 7, expected a divisor"):
        picture(store, clip, 50.0, 7)


def test_logits_are_in_single_precision(store: MapStore) -> None:
    torch.manual_seed(0)
    net, clips = Tiny(12), clips_of(store, ("through-wall",), 1, None)
    pictures = [picture(store, clip, 50.0, SIZE) for clip in clips]
    torch.testing.assert_close(logits_of(net, store, clips, (50.0, 50.0), SIZE), net(torch.stack(pictures)))


def test_draws_of_ratios_cover_the_range() -> None:
    drawn = torch.tensor([drawn_snr(0, index, (10.0, 50.0)) for index in range(400)])
    assert float(drawn.min()) < 11
    assert float(drawn.max()) > 49
    assert abs(float(drawn.mean()) - 30) < 2
    assert drawn_snr(3, 5, (50.0, 50.0)) == 50.0


def test_mean_of_pictures_is_subtracted(store: MapStore) -> None:
    mine = recipe(store)
    pictures = torch.stack([mine.sample(index)["picture"] for index in range(200)])
    torch.testing.assert_close(mine.net.get_buffer("mean"), pictures.mean().reshape(1), rtol=1e-5, atol=0)


def test_rate_falls_to_a_tenth_after_half() -> None:
    rates = [ClassifierRecipe.rate(None, step, 20) for step in range(20)]  # type: ignore[arg-type]
    assert rates == [1.0] * 10 + [0.1] * 10


def test_biases_are_not_decayed(store: MapStore) -> None:
    decayed, rest = recipe(store).optimiser().param_groups
    assert decayed["weight_decay"] == 1e-4
    assert rest["weight_decay"] == 0
    assert all(p.dim() > 1 for p in decayed["params"])
    assert all(p.dim() == 1 for p in rest["params"])


def test_refuses_bad_settings(store: MapStore) -> None:
    with pytest.raises(TensorsimError, match="got 'resnet', expected one of"):
        ClassifierRecipe("resnet", store, ("through-wall",), 10)
    with pytest.raises(TensorsimError, match="got 10 people in through-wall, expected 11"):
        ClassifierRecipe("spgnet", store, ("through-wall",), 11)
    with pytest.raises(TensorsimError, match="the lower one first"):
        recipe(store, snr_db=(50.0, 10.0))
    with pytest.raises(TensorsimError, match="got 0 people in free-space"):
        clips_of(store, ("free-space",), 2, None)


def test_masks_are_bands_within_their_limits_drawn_anew_for_each_look(store: MapStore) -> None:
    pictures = torch.ones(2, 1, 20, 40)
    state = torch.get_rng_state()
    widths = []
    for seed in range(200):
        look = masked(pictures, (0.25, 0.5), seed)
        rows, columns = (look == 0).all(-1)[0, 0], (look == 0).all(-2)[0, 0]
        covered = rows[:, None] | columns[None, :]
        assert torch.equal(look, (~covered).float().expand_as(look)), (
            "bands of rows and columns, nothing else"
        )
        for band in (rows, columns):
            assert int(band.int().diff().clamp_min(0).sum()) + int(band[0]) <= 1, "one band"
        widths.append((int(rows.sum()), int(columns.sum())))
    most = [max(w) for w in zip(*widths, strict=True)]
    assert most[0] in (4, 5)
    assert most[1] in range(18, 21)
    assert torch.equal(state, torch.get_rng_state())
    assert masked(pictures, (0.0, 0.0), 0) is pictures
    plain, noted = recipe(store), recipe(store, masks=(0.5, 0.5))
    same = [torch.equal(plain.sample(i)["picture"], noted.sample(i)["picture"]) for i in range(8)]
    assert not any(same)
    assert torch.equal(noted.sample(3)["picture"], noted.sample(3)["picture"])
    with pytest.raises(TensorsimError, match="masks: got"):
        recipe(store, masks=(0.0, 1.5))


def test_masks_do_not_depend_on_the_ratio(store: MapStore, monkeypatch: pytest.MonkeyPatch) -> None:
    ratios: list[float] = []

    def blank(store: MapStore, clip: object, snr_db: float, size: int) -> Tensor:
        ratios.append(snr_db)
        return torch.ones(1, 100, 100)

    noted = recipe(store, masks=(0.5, 0.5))
    monkeypatch.setattr("tensorsim.training.classifier.picture", blank)
    looks = torch.stack([noted.sample(index)["picture"][0] for index in range(200)])
    rows, columns = ((looks == 0).all(dim).sum(-1).float() for dim in (-1, -2))
    assert torch.corrcoef(torch.stack([torch.tensor(ratios), rows, columns]))[0, 1:].abs().max() < 0.25
