"""Reading data sets: what a sample is, who gets which, and how batches are changed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import tensorsim as ts
from tensorsim.data.sets.outputs import OutputConfig
from tensorsim.data.sets.stored import StoredArrays
from tensorsim.errors import TensorsimError
from tests.data.sets.recipes import small_recipe


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("set")
    views = (
        ts.data.RadarView("front", "through-wall"),
        ts.data.RadarView("left", "through-wall", -3.0, 3.5, -90.0),
    )
    outputs = OutputConfig(kinds=("doppler_time", "picture"), picture_size=32)
    ts.data.build_dataset(small_recipe(radars=views, outputs=outputs), out / "set", quiet=True)
    return out / "set"


def test_samples_are_the_stored_maps(folder: Path) -> None:
    maps = ts.data.MapDataset(folder, output="doppler_time")
    assert len(maps) == 4
    assert maps.labels == ("S8 Walking", "S5 Sitting Down")
    sample = maps[2]
    row = next(row for row in ts.data.sets.manifest.rows_of(folder, id=sample["id"]))
    read = StoredArrays(folder, maps.recipe)
    for channel, radar in enumerate(("front", "left")):
        stored = read(row, f"{radar}.doppler_time")
        assert (sample["map"][channel].numpy() == stored.astype(np.float32) / 255).all()
    assert sample["label"] == row["class_index"]
    assert maps[-1]["id"] == maps[3]["id"]
    with pytest.raises(IndexError):
        maps[4]


def test_parts_radars_and_classes(folder: Path) -> None:
    train, validation = (ts.data.MapDataset(folder, split) for split in ("train", "validation"))
    assert sorted(train.ids + validation.ids) == ts.data.MapDataset(folder).ids
    assert train[0]["map"].shape == (2, 32, 32)
    assert ts.data.MapDataset(folder, radars=["left"])[0]["map"].shape == (1, 32, 32)
    sitting = ts.data.MapDataset(folder, labels=["S5 Sitting Down"])
    assert sitting.targets.tolist() == [0, 0]
    for options, message in (
        ({"split": "all"}, "MapDataset.split: got 'all'"),
        ({"output": "ridges"}, "MapDataset.output: got 'ridges', expected one of picture, doppler_time"),
        ({"radars": ["back"]}, "MapDataset.radars: got 'back'"),
        ({"labels": ["run"]}, "MapDataset.labels: got 'run'"),
        ({"split": "test"}, "got no samples of the part test"),
    ):
        with pytest.raises(TensorsimError, match=message):
            ts.data.MapDataset(folder, **options)  # type: ignore[arg-type]


def test_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=r"got no manifest\.parquet, expected a finished data set"):
        ts.data.MapDataset(tmp_path)


def test_every_class_counts_alike(folder: Path) -> None:
    maps = ts.data.MapDataset(folder)
    maps.targets = torch.tensor([0, 0, 0, 1])
    weights = maps.class_weights()
    assert float(weights[1] / weights[0]) == pytest.approx(3.0)
    assert float(weights[maps.targets].mean()) == pytest.approx(1.0)


def test_short_maps_are_padded_in_a_batch() -> None:
    samples = [{"map": torch.ones(1, 4, n), "label": n, "id": str(n)} for n in (3, 5)]
    batch = ts.data.collate_maps(samples)
    assert batch["map"].shape == (2, 1, 4, 5)
    assert float(batch["map"][0].sum()) == 12.0
    assert batch["label"].tolist() == [3, 5]


def test_ranks_and_workers_share_the_shards(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    maps = ts.data.MapDataset(folder)
    stream = ts.data.MapStream(maps, seed=3)
    whole = [sample["id"] for sample in stream]
    assert sorted(whole) == maps.ids
    monkeypatch.setenv("WORLD_SIZE", "2")
    shared = []
    for rank in range(2):
        monkeypatch.setenv("RANK", str(rank))
        shared.append([sample["id"] for sample in stream])
    assert sorted(shared[0] + shared[1]) == maps.ids
    assert shared[0]
    assert shared[1]
    monkeypatch.delenv("WORLD_SIZE")
    monkeypatch.setenv("RANK", "0")
    orders = set()
    for epoch in range(6):
        stream.set_epoch(epoch)
        orders.add(tuple(sample["id"] for sample in stream))
    assert len(orders) > 1
    loader = DataLoader(ts.data.MapStream(maps, shuffle=False), 3, collate_fn=ts.data.collate_maps)
    assert [len(batch["label"]) for batch in loader] == [3, 1]


#: Whether a worker that persists has the order of its epoch, four times, in a process of its own.
PERSISTENT = """
import sys
import tensorsim as ts
from torch.utils.data import DataLoader
stream = ts.data.MapStream(ts.data.MapDataset(sys.argv[1]), seed=3)
loader = DataLoader(stream, None, num_workers=1, persistent_workers=True)
for epoch in range(4):
    stream.set_epoch(epoch)
    print([sample["id"] for sample in loader] == [sample["id"] for sample in stream])
"""


def test_workers_that_persist_see_the_epoch(folder: Path) -> None:
    command = [sys.executable, "-c", PERSISTENT, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "True\n" * 4, done.stderr


def test_simulated_maps_are_those_of_the_data_set_and_then_others(folder: Path) -> None:
    maps = ts.data.MapDataset(folder, "train")
    simulated = ts.data.SimulatedMaps(maps.recipe, "train", rounds=2)
    found = list(simulated)
    assert len(found) == 4
    for sample, other in zip(found[:2], found[2:], strict=True):
        stored = maps[maps.ids.index(sample["id"].removesuffix("-0"))]
        assert sample["label"] == stored["label"] == other["label"]
        assert sample["map"].equal(stored["map"])
        assert not other["map"].equal(stored["map"])


def test_a_worker_without_samples_ends_and_a_round_without_any_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = ts.data.SimulatedMaps(ts.data.MapDataset(folder, "train").recipe, "train")
    monkeypatch.setattr("tensorsim.data.sets.reading.share_of_worker", lambda: (7, 8))
    assert list(simulated) == []
    monkeypatch.setattr("tensorsim.data.sets.reading.share_of_worker", lambda: (0, 1))
    monkeypatch.setattr(simulated, "_samples", lambda numbers, done: iter(()))
    with pytest.raises(TensorsimError, match="none of 2 samples of a round could be made"):
        list(simulated)


def test_bands_are_masked_in_training_only() -> None:
    maps = torch.ones(6, 1, 40, 60)
    augment = ts.data.SpecAugment(0.5, 0.5)
    masked = augment(maps)
    rows, columns = (masked == 0).all(3).any(1), (masked == 0).all(2).any(1)
    assert rows.sum(1).max() <= 20
    assert columns.sum(1).max() <= 30
    assert len({int(n) for n in rows.sum(1)}) > 1
    assert augment.eval()(maps) is maps


def test_shifts_move_and_fill_with_the_floor() -> None:
    maps = torch.rand(8, 2, 20, 30) + 0.5
    moved = ts.data.RandomShift(3, 4)(maps)
    seen = set()
    for before, after in zip(maps, moved, strict=True):
        fits = [
            (dy, dx) for dy in range(-3, 4) for dx in range(-4, 5)
            if after.equal(torch.nn.functional.pad(before, (4, 4, 3, 3))[:, 3 - dy : 23 - dy, 4 - dx : 34 - dx])
        ]  # fmt: skip
        assert len(fits) == 1
        seen.add(fits[0])
    assert len(seen) > 1


def test_noise_differs_and_stays_in_range() -> None:
    maps = torch.full((50, 1, 20, 20), 0.5)
    noisy = ts.data.AddNoise(0.1)(maps)
    deviation = (noisy - maps).flatten(1).std(1)
    assert 0 < float(deviation.min()) < 0.03
    assert 0.07 < float(deviation.max()) < 0.12
    assert ts.data.AddNoise(5.0)(maps).aminmax() == (0.0, 1.0)


def test_folded_doppler_keeps_the_stronger_sign() -> None:
    maps = torch.zeros(1, 8, 3)
    maps[0, 6, 0] = 0.9  # +2
    maps[0, 1, 1] = 0.7  # -3
    maps[0, 4, 2] = 0.5  # 0
    folded = ts.data.SignFold()(maps)
    assert folded.shape == (1, 4, 3)
    assert [(int(r), int(c)) for _, r, c in folded.nonzero()] == [(0, 2), (2, 0), (3, 1)]
    assert torch.jit.script(ts.data.SignFold())(maps).equal(folded)


@pytest.mark.parametrize(
    "make",
    [lambda: ts.data.SpecAugment(2.0), lambda: ts.data.RandomShift(-1), lambda: ts.data.AddNoise(-0.1)],
)
def test_settings_that_make_no_sense(make: object) -> None:
    with pytest.raises(TensorsimError, match="got"):
        make()  # type: ignore[operator]


def test_sources_travel_to_the_workers_of_a_loader(tmp_path: Path) -> None:
    import pickle

    motion = ts.motion.ActivityGenerator().generate("walking", seed=1, duration_s=1.0, rate_hz=30.0)
    (tmp_path / "walk").mkdir()
    np.savez(tmp_path / "walk" / "a.npz", joints_m=motion.joints[0].numpy(), fps=30.0)
    recipe = small_recipe(sources=(ts.data.SourceConfig("motion", str(tmp_path)),))
    simulated = ts.data.SimulatedMaps(recipe, "train", rounds=1)
    (sample,) = pickle.loads(pickle.dumps(simulated))
    assert sample["map"].equal(next(iter(simulated))["map"])
    assert sample["id"] == "00000000-0"
