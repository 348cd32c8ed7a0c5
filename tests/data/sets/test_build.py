"""Building: the same bytes every time, whole or not at all, and everything listed."""

import csv
import gc
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from safetensors.torch import save_file

from tensorsim import cli
from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.data.sets import engines, made_with
from tensorsim.data.sets.again import sample_again
from tensorsim.data.sets.build import build_dataset, plan_of
from tensorsim.data.sets.card import card
from tensorsim.data.sets.engines import Processes, RayCluster
from tensorsim.data.sets.made_with import digest
from tensorsim.data.sets.manifest import recipe_of, rows_of
from tensorsim.data.sets.outputs import OF_ARRAY, OF_PAIR, OutputConfig
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.reading import MapDataset
from tensorsim.data.sets.recipe import DatasetRecipe, RadarView, SourceConfig, SplitConfig, StorageConfig
from tensorsim.data.sets.samples import content_hash, make_sample
from tensorsim.data.sets.shards import write_shard
from tensorsim.data.sets.sheet import draw_sheet
from tensorsim.data.sets.stored import StoredArrays
from tensorsim.data.sets.variations import VariationConfig
from tensorsim.data.sets.verify import wrong_files
from tensorsim.enhance import DnCNN
from tensorsim.errors import TensorsimError
from tensorsim.motion import ActivityGenerator
from tensorsim.radar.presets import save_radar_yaml
from tests.data.sets.recipes import small_recipe


def contents(folder: Path) -> dict[str, bytes]:
    """Everything in the folder of a data set except what is specific to one run."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".people" not in path.parts
    }


@pytest.fixture(scope="module")
def recipe() -> DatasetRecipe:
    return small_recipe()


@pytest.fixture(scope="module")
def built(recipe: DatasetRecipe, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("built") / "set"
    assert build_dataset(recipe, folder, quiet=True) == (4, 0, 4)
    return folder


def test_what_is_in_the_folder(built: Path, recipe: DatasetRecipe) -> None:
    names = {path.name for path in built.iterdir()} - {".rows"}
    files = {
        "README.md",
        "contact_sheet.png",
        "dataset.json",
        "failures.csv",
        "manifest.csv",
        "manifest.parquet",
    }
    assert names == files | {"recipe.yaml", "shards"}
    rows = list(rows_of(built))
    assert [row["id"] for row in rows] == ["00000000", "00000001", "00000002", "00000003"]
    with (built / "manifest.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["sha256"] for row in table] == [row["sha256"] for row in rows]
    assert {row["person"] for row in rows_of(built, part="train")}.isdisjoint(
        row["person"] for row in rows_of(built, part="validation")
    )
    assert recipe_of(built) == recipe
    summary = json.loads((built / "dataset.json").read_text())
    assert summary["labels"] == ["S8 Walking", "S5 Sitting Down"]
    assert "| S8 Walking | 1 | 1 | 0 |" in (built / "README.md").read_text()


@pytest.mark.parametrize(
    ("kinds", "changes", "words"),
    [
        (("picture",), {}, ["0 at 40 dB below", "(-3.8 to 3.8 m/s"]),
        (("doppler_time", "ridges"), {}, ["0 at 60 dB below", "in Hz"]),
        (("range_time", "joints"), {"dtype": "float16"}, ["dB, 0 at the peak", "moments (60 per second)"]),
        (OF_PAIR, {}, ["real and imaginary part"]),
        (
            (*OF_ARRAY, "joints"),
            {},
            ["frames (10 per second)", "range in m, speed in m/s, sine of the azimuth"],
        ),
    ],
)
def test_the_card_says_what_every_output_is(
    kinds: tuple[str, ...], changes: dict[str, Any], words: list[str]
) -> None:
    preset = "ti-awr1843-array" if "point_cloud" in kinds else "through-wall"
    storage = StorageConfig("png" if kinds == ("picture",) else "webdataset")
    recipe = small_recipe(
        radars=(RadarView("a", preset),), outputs=OutputConfig(kinds=kinds, **changes), storage=storage
    )
    text = card(Plan(recipe), Counter(), 0, 0)
    assert all(f"\n- `{kind}`: " in text for kind in kinds)
    assert all(word in text for word in words)
    assert ("60 dB" in text) == (bool(set(kinds) - {"picture", "joints"}) and not changes)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset_reads_the_shards(built: Path) -> None:
    import webdataset

    urls = [str(path) for path in sorted((built / "shards").glob("*.tar"))]
    samples = list(webdataset.WebDataset(urls, shardshuffle=False, empty_check=False).decode())
    gc.collect()  # it leaves its files open
    rows = {row["id"]: row for row in rows_of(built)}
    assert [sample["__key__"] for sample in samples] == list(rows)
    for sample in samples:
        row = rows[sample["__key__"]]
        assert sample["cls"] == row["class_index"]
        assert sample["json"] == row
        array = sample["front.doppler_time.npy"]
        assert (array.dtype, array.shape) == (np.uint8, (256, 17))
        assert content_hash({"front.doppler_time": array}, row["class_index"]) == row["sha256"]


@pytest.mark.parametrize("storage", ["hdf5", "mat", "webdataset"])
def test_every_format_holds_the_same_arrays(storage: Any, tmp_path: Path) -> None:
    kinds = ("doppler_time", "ridges", "joints")
    recipe = small_recipe(storage=StorageConfig(storage), outputs=OutputConfig(kinds=kinds, dtype="float16"))
    plan = plan_of(json.dumps(recipe.to_document(), sort_keys=True), "")
    samples = [make_sample(plan, number, "train-000000") for number in (0, 1)]
    first, second = (write_shard(tmp_path / name, recipe.storage, "train-000000", samples) for name in "ab")
    assert first == second
    read = StoredArrays(tmp_path / "a", recipe)
    for sample in samples:
        arrays = {name: read(sample.row, name).astype(array.dtype) for name, array in sample.arrays.items()}
        assert content_hash(arrays, sample.row["class_index"]) == sample.row["sha256"]


@pytest.mark.parametrize("name", ["_a", "-a", "24GHz", "é"])
def test_every_name_of_a_radar_is_one_in_matlab(name: str, tmp_path: Path) -> None:
    import scipy.io

    recipe = small_recipe(storage=StorageConfig("mat"), radars=(RadarView(name, "through-wall"),))
    sample = make_sample(Plan(recipe), 0, "train-000000")
    (file,) = write_shard(tmp_path, recipe.storage, "train-000000", [sample])
    read = StoredArrays(tmp_path, recipe)(sample.row, f"{name}.doppler_time")
    assert (read == sample.arrays[f"{name}.doppler_time"]).all()
    (variable,) = {n for n in scipy.io.loadmat(tmp_path / file) if n.endswith("time")}
    assert re.fullmatch("[A-Za-z][A-Za-z0-9_]*", variable)


def test_the_contact_sheet_takes_any_name_and_leaves_what_the_next_build_finds(
    built: Path, recipe: DatasetRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from matplotlib.figure import Figure

    def named(out: Path) -> Iterator[dict[str, Any]]:
        return (row | {"label": "a$b_$c", "person": "a$b_$c"} for row in rows_of(out))

    def seen(figure: Figure, path: Path, **options: Any) -> None:
        save(figure, path, **options)
        assert path.name == f".contact_sheet.png.{os.getpid()}.tmp"
        assert path.read_bytes().startswith(b"\x89PNG")

    shutil.copytree(built, tmp_path / "set")
    (tmp_path / "set" / "contact_sheet.png").unlink()
    save = Figure.savefig
    monkeypatch.setattr("tensorsim.data.sets.manifest.rows_of", named)
    monkeypatch.setattr(Figure, "savefig", seen)
    assert draw_sheet(tmp_path / "set", replace(recipe, name="a$b_$c"))
    assert (tmp_path / "set" / "contact_sheet.png").is_file()


def test_pictures_in_folders_of_classes(tmp_path: Path) -> None:
    recipe = small_recipe(
        storage=StorageConfig("png", 3), outputs=OutputConfig(kinds=("picture",), picture_size=32)
    )
    build_dataset(recipe, tmp_path / "set", quiet=True)
    found = sorted(str(path.relative_to(tmp_path / "set")) for path in (tmp_path / "set").rglob("0*.png"))
    assert len(found) == 4
    assert found[0].startswith("train/S5_Sitting_Down/0000000")
    read = StoredArrays(tmp_path / "set", recipe)
    for row in rows_of(tmp_path / "set"):
        assert (
            content_hash({"front.picture": read(row, "front.picture")}, row["class_index"]) == row["sha256"]
        )


class Interrupted:
    """An engine that does jobs in a different order and is interrupted after some."""

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs

    def run(self, work: Any, jobs: Iterable[Any]) -> Iterator[int]:
        for number, job in enumerate(reversed(list(jobs))):
            if number == self.jobs:
                raise KeyboardInterrupt
            yield work(job)


def test_files_that_were_changed_are_read_again(tmp_path: Path) -> None:
    """A table that was corrected counts in the next build of the same process, and failures are tried again."""
    motion = ActivityGenerator().generate("walking", seed=0, duration_s=1.0, rate_hz=30.0).joints[0].numpy()
    table = tmp_path / "table.csv"
    table.write_text("path,label\na.npz,run\n")
    recipe = small_recipe(
        sources=(SourceConfig("table", str(table)),), split=SplitConfig(shares=(1.0, 0.0, 0.0))
    )
    with pytest.raises(TensorsimError, match="got no samples"):
        build_dataset(recipe, tmp_path / "set", quiet=True)
    np.savez(tmp_path / "a.npz", joints_m=motion, fps=30.0)
    assert build_dataset(recipe, tmp_path / "set", quiet=True).samples == 1
    table.write_text("path,label\na.npz,walk\n")
    build_dataset(recipe, tmp_path / "other", quiet=True)
    assert [row["label"] for row in rows_of(tmp_path / "other")] == ["walk"]


@pytest.fixture
def captured(tmp_path: Path) -> DatasetRecipe:
    """Two captured walks in one class and a file that is no motion in another, each in a shard of its own."""
    for seed, name in enumerate(("a", "b")):
        joints = ActivityGenerator().generate("walking", seed=seed, duration_s=1.0, rate_hz=30.0).joints[0]
        (tmp_path / "motion" / "walk").mkdir(parents=True, exist_ok=True)
        np.savez(tmp_path / "motion" / "walk" / f"{name}.npz", joints_m=joints.numpy(), fps=30.0)
    (tmp_path / "motion" / "run").mkdir()
    (tmp_path / "motion" / "run" / "c.npz").write_text("nothing")
    return small_recipe(
        sources=(SourceConfig("motion", str(tmp_path / "motion")),),
        split=SplitConfig(shares=(1.0, 0.0, 0.0)),
        variations=VariationConfig(count=2),
        storage=StorageConfig(shard_samples=1),
    )


def test_samples_that_failed_are_tried_again_when_asked(captured: DatasetRecipe, tmp_path: Path) -> None:
    out, mended = tmp_path / "set", tmp_path / "motion" / "run" / "c.npz"
    assert build_dataset(captured, out, quiet=True) == (4, 1, 4)
    assert {row["present_s"] for row in rows_of(out)} == {1.0}
    with (out / "failures.csv").open(newline="") as file:
        (failure,) = csv.DictReader(file)
    assert (failure["clip"], failure["samples"]) == ("run/c.npz", "2")
    mended.write_bytes((tmp_path / "motion" / "walk" / "a.npz").read_bytes())
    assert build_dataset(captured, out, quiet=True) == (4, 1, 0)
    with pytest.raises(KeyboardInterrupt):
        build_dataset(captured, out, Interrupted(1), quiet=True, retry=True)
    # It is not marked as finished: one of the samples in the old manifest may have changed.
    assert not {"dataset.json", "manifest.parquet", "manifest.csv"} & {path.name for path in out.iterdir()}
    assert build_dataset(captured, out, quiet=True, retry=True) == (6, 0, 1)
    build_dataset(captured, tmp_path / "whole", quiet=True)
    assert contents(out) == contents(tmp_path / "whole")


@pytest.mark.parametrize("storage", [StorageConfig(shard_samples=2), StorageConfig("png", 2)])
def test_files_that_are_missing_or_cut_are_noticed_and_made_again(
    storage: StorageConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds: Any = ("picture",) if storage.format == "png" else ("doppler_time",)
    recipe, out = small_recipe(storage=storage, outputs=OutputConfig(kinds=kinds)), tmp_path / "set"
    build_dataset(recipe, out, quiet=True)
    whole = contents(out)
    first, *_, last = json.loads((out / "dataset.json").read_text())["sha256"]
    cli.main(["dataset", "verify", str(out)])
    assert f"{len(list(out.rglob('0*.png'))) or 2} files" in capsys.readouterr().out
    (out / last).unlink()
    (out / first).write_bytes(whole[first][:-1])
    with pytest.raises(SystemExit):
        cli.main(["dataset", "verify", str(out)])
    said = capsys.readouterr()
    assert f"WRONG {last}: no such file" in said.out
    assert f"WRONG {first}: got SHA-256" in said.out
    assert "dataset verify: 2 of" in said.err
    assert build_dataset(recipe, out, quiet=True) == (4, 0, 4)
    assert contents(out) == whole
    (out / first).write_bytes(b"x" + whole[first][1:])
    count, wrong = wrong_files(out)
    assert (count, list(wrong)) == (len(list(out.rglob("0*.png"))) or 2, [first])
    with pytest.raises(TensorsimError, match=r"got no dataset\.json, expected a finished data set"):
        wrong_files(tmp_path)


def test_strict_does_not_pass_over_earlier_failures(captured: DatasetRecipe, tmp_path: Path) -> None:
    build_dataset(captured, tmp_path / "set", quiet=True)
    with pytest.raises(TensorsimError, match=r"run/c\.npz"):
        build_dataset(captured, tmp_path / "set", strict=True, quiet=True)


def test_other_clips_than_at_the_start_are_refused(captured: DatasetRecipe, tmp_path: Path) -> None:
    """Parts and numbers of samples would change, and a person would be in two parts."""
    out, walks = tmp_path / "set", tmp_path / "motion" / "walk"
    with pytest.raises(KeyboardInterrupt):
        build_dataset(captured, out, Interrupted(1), quiet=True)
    (walks / "b.npz").rename(walks / "d.npz")
    with pytest.raises(TensorsimError, match="set: got sources with other clips, people or labels"):
        build_dataset(captured, out, quiet=True)
    (walks / "d.npz").rename(walks / "b.npz")
    assert build_dataset(captured, out, quiet=True).samples == 4
    (walks / "b.npz").unlink()
    sample = next(rows_of(out, clip="walk/b.npz"))["id"]
    with pytest.raises(TensorsimError, match=r"walk/b\.npz is missing"):
        sample_again(out, sample)


def test_names_that_are_not_utf8_are_written_as_text(captured: DatasetRecipe, tmp_path: Path) -> None:
    for name in ("walk/b.npz", "run/c.npz"):
        path = tmp_path / "motion" / name
        path.rename(os.fsdecode(os.fsencode(path).replace(b".npz", b"\xe9.npz")))
    assert build_dataset(captured, tmp_path / "set", quiet=True) == (4, 1, 4)
    rows = list(rows_of(tmp_path / "set"))
    assert {row["clip"] for row in rows} == {"walk/a.npz", r"walk/b\udce9.npz"}
    with (tmp_path / "set" / "failures.csv").open(newline="", encoding="utf-8") as file:
        (failure,) = csv.DictReader(file)
    assert failure["clip"] == r"run/c\udce9.npz"
    assert failure["path"] in failure["reason"]
    assert all(sample_again(tmp_path / "set", row["id"]).row == row for row in rows)


def test_the_manifest_says_how_long_anybody_is_there(captured: DatasetRecipe, tmp_path: Path) -> None:
    build_dataset(replace(captured, duration_s=3.0), tmp_path / "set", quiet=True)
    assert [row["present_s"] for row in rows_of(tmp_path / "set")] == pytest.approx([1.0] * 4, abs=0.05)


def test_a_source_that_is_not_there_leaves_no_folder(tmp_path: Path) -> None:
    recipe = small_recipe(sources=(SourceConfig("motion", str(tmp_path / "nothing")),))
    with pytest.raises(TensorsimError, match="no such folder"):
        build_dataset(recipe, tmp_path / "set", quiet=True)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_run_goes_on_to_the_same_files(
    built: Path, recipe: DatasetRecipe, tmp_path: Path
) -> None:
    folder = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        build_dataset(recipe, folder, Interrupted(1), quiet=True)
    assert not (folder / "dataset.json").exists()
    (folder / "shards" / ".train-000000.tar.1.tmp").write_bytes(b"half")
    assert build_dataset(recipe, folder, quiet=True) == (4, 0, 2)
    assert contents(folder) == contents(built)
    assert build_dataset(recipe, folder, quiet=True) == (4, 0, 0)


def of_a_radar_file(folder: Path) -> DatasetRecipe:
    """A recipe whose radar and denoiser are files."""
    radar = RadarConfig.through_wall()
    save_radar_yaml(folder / "radar.yaml", radar, WallConfig(), FloorConfig())
    save_file(DnCNN(depth=3).state_dict(), folder / "weights.safetensors")
    return small_recipe(
        radars=(RadarView("front", str(folder / "radar.yaml")),),
        variations=VariationConfig(denoisers=(str(folder / "weights.safetensors"),)),
    )


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ("radar", r"first difference: radars\.front\.radar\.antenna_gain_dbi 10.0 there, 9.0 here"),
        ("wall", r"first difference: radars\.front\.wall\.loss_tangent 0.03 there, 0.1 here"),
        ("floor", r"first difference: radars\.front\.floor"),
        ("weights", r"first difference: denoisers\..*weights\.safetensors"),
        ("version", r"first difference: version '0\.[^']*' there, '99' here"),
    ],
)
def test_samples_of_other_radars_weights_or_versions_are_not_mixed(
    changed: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe, out = of_a_radar_file(tmp_path), tmp_path / "set"
    before = digest(recipe, made_with.made_with(recipe))
    with pytest.raises(KeyboardInterrupt):
        build_dataset(recipe, out, Interrupted(0), quiet=True)
    radar = replace(RadarConfig.through_wall(), antenna_gain_dbi=9.0 if changed == "radar" else 10.0)
    wall = WallConfig(loss_tangent=0.1) if changed == "wall" else WallConfig()
    floor = None if changed == "floor" else FloorConfig()
    save_radar_yaml(tmp_path / "radar.yaml", radar, wall, floor)
    if changed == "weights":
        save_file(DnCNN(depth=4).state_dict(), tmp_path / "weights.safetensors")
    if changed == "version":
        monkeypatch.setattr(made_with, "version", lambda name: "99")
    with pytest.raises(TensorsimError, match=message):
        build_dataset(recipe, out, quiet=True)
    assert digest(recipe, made_with.made_with(recipe)) != before


def test_a_sample_of_another_radar_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyarrow.parquet as pq

    recipe, out = of_a_radar_file(tmp_path), tmp_path / "set"
    build_dataset(recipe, out, quiet=True)
    monkeypatch.setattr(made_with, "version", lambda name: "99")
    assert sample_again(out, "00000001").row["id"] == "00000001"  # the same bits, whatever made them
    assert MapDataset(out).digest == json.loads((out / "dataset.json").read_text())["recipe"]
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    table = pq.read_table(out / "manifest.parquet")
    stored = {name: text for name, text in table.schema.metadata.items() if name != b"tensorsim.made_with"}
    pq.write_table(table.replace_schema_metadata(stored), earlier / "manifest.parquet")
    assert sample_again(earlier, "00000001").row["id"] == "00000001"
    assert MapDataset(earlier).digest != MapDataset(out).digest
    save_radar_yaml(tmp_path / "radar.yaml", RadarConfig.through_wall(isolation_db=3.0), WallConfig())
    with pytest.raises(TensorsimError, match=r"radars\.front\.radar\.isolation_db .* there, 3\.0 here"):
        sample_again(out, "00000001")


def test_what_is_there_is_not_overwritten(built: Path, tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match=r"first difference: seed 0 there, 5 here"):
        build_dataset(small_recipe(seed=5), built, quiet=True)
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(TensorsimError, match="a folder with other files"):
        build_dataset(small_recipe(), tmp_path, quiet=True)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_recipe_in_the_folder_does_not_pass_for_that_of_the_data_set(tmp_path: Path) -> None:
    """Who edits it there would get samples of both."""
    recipe = small_recipe()
    recipe.to_yaml(tmp_path / "recipe.yaml")
    (tmp_path / ".other.tmp").write_text("mine")
    with pytest.raises(TensorsimError, match="a folder with other files"):
        build_dataset(recipe, tmp_path, quiet=True)
    assert (tmp_path / ".other.tmp").exists()
    with pytest.raises(KeyboardInterrupt):
        build_dataset(recipe, tmp_path / "set", Interrupted(1), quiet=True)
    edited = small_recipe(seed=5)
    edited.to_yaml(tmp_path / "set" / "recipe.yaml")
    with pytest.raises(TensorsimError, match=r"first difference: seed 0 there, 5 here"):
        build_dataset(edited, tmp_path / "set", quiet=True)


def test_the_manifest_alone_makes_a_sample_again(
    built: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "manifest.parquet").write_bytes((built / "manifest.parquet").read_bytes())
    cli.main(["dataset", "sample", str(tmp_path), "00000002", "--out", str(tmp_path / "again")])
    assert "the same to the bit" in capsys.readouterr().out
    row = next(rows_of(built, id="00000002"))
    again = np.load(tmp_path / "again" / "00000002.front.doppler_time.npy")
    assert (again == StoredArrays(built, recipe_of(built))(row, "front.doppler_time")).all()
    with pytest.raises(TensorsimError, match="got no sample '7', expected an id such as 00000003"):
        sample_again(tmp_path, "7")


def test_a_row_that_was_changed_is_noticed(built: Path, tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    table = pq.read_table(built / "manifest.parquet")
    place = table.schema.get_field_index("snr_db")
    pq.write_table(table.set_column(place, "snr_db", table["snr_db"].combine_chunks().fill_null(0).cast("double")),
                   tmp_path / "manifest.parquet")  # fmt: skip
    assert sample_again(tmp_path, "00000000").row["id"] == "00000000"
    import pyarrow.compute as pc

    louder = table.set_column(place, "snr_db", pc.subtract(table["snr_db"], 20.0))
    pq.write_table(louder, tmp_path / "manifest.parquet")
    with pytest.raises(TensorsimError, match="got other arrays for 00000000"):
        sample_again(tmp_path, "00000000")


def test_samples_do_not_depend_on_one_another(built: Path, recipe: DatasetRecipe) -> None:
    plan = plan_of(json.dumps(recipe.to_document(), sort_keys=True), "")
    rows = list(rows_of(built))
    for number in (3, 0):
        assert make_sample(plan, number, rows[number]["shard"]).row == rows[number]


def test_three_radars_in_one_sample(tmp_path: Path) -> None:
    views = (RadarView("front", "through-wall"), RadarView("left", "through-wall", -3.0, 3.5, -90.0))
    build_dataset(small_recipe(radars=views), tmp_path / "set", quiet=True)
    row = next(rows_of(tmp_path / "set"))
    read = StoredArrays(tmp_path / "set", recipe_of(tmp_path / "set"))
    front, left = (read(row, f"{name}.doppler_time") for name in ("front", "left"))
    assert front.shape == left.shape
    assert (front != left).mean() > 0.2


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 8])
def test_processes_make_the_same_bytes(workers: int, tmp_path: Path) -> None:
    # As many shards as workers: each of them does some.
    recipe = small_recipe(
        sources=(SourceConfig(classes=("walking", "sitting down"), people=4),),
        storage=StorageConfig(shard_samples=1),
    )
    build_dataset(recipe, tmp_path / "one", quiet=True)
    build_dataset(recipe, tmp_path / "set", Processes(workers), quiet=True)
    assert contents(tmp_path / "set") == contents(tmp_path / "one")
    assert len(list((tmp_path / "set" / "shards").iterdir())) == 8


def test_receiver_and_denoiser_are_in_the_manifest_and_are_made_again(tmp_path: Path) -> None:
    variations = VariationConfig(
        count=2,
        phase_noise_dbc_hz=(-95.0, -85.0),
        iq_imbalance_db=(0.1, 0.5),
        dc_offset_db=(-10.0, 0.0),
        adc_bits=(4, 12),
        real_receiver=0.5,
        denoisers=("none", "perona-malik"),
    )
    build_dataset(small_recipe(variations=variations), tmp_path / "set", quiet=True)
    rows = list(rows_of(tmp_path / "set"))
    assert {row["denoiser"] for row in rows} == {"none", "perona-malik"}
    assert all(isinstance(row["adc_bits"], int) and 4 <= row["adc_bits"] <= 12 for row in rows)
    assert all(row["iq_phase_rad"] is None and -95 <= row["phase_noise_dbc_hz"] <= -85 for row in rows)
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "manifest.parquet").write_bytes((tmp_path / "set" / "manifest.parquet").read_bytes())
    for row in rows:
        assert sample_again(alone, row["id"]).row == row


def die_once(marker: str) -> int:
    """A job whose first worker dies as if it were killed."""
    path = Path(marker)
    if path.name.startswith("deadly") and not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 1


def die(_: str) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 1


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(tmp_path: Path) -> None:
    jobs = [str(tmp_path / name) for name in ("a", "deadly", "b")]
    assert sum(Processes(2).run(die_once, jobs)) == 3
    with pytest.raises(TensorsimError, match="3 worker processes in a row died"):
        list(Processes(1).run(die, ["x"]))


def test_a_pool_that_breaks_while_jobs_are_given_out_loses_none(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = []

    class Worker:
        def terminate(self) -> None:
            ended.append("terminated")

        def join(self) -> None:
            ended.append("joined")

    class Pool:
        """Breaks at its second job, the first time."""

        pools = 0

        def __init__(self, *_: Any) -> None:
            self._processes = {1: Worker()}
            Pool.pools += 1
            self.jobs = 0

        def submit(self, work: Any, job: Any) -> Future[int]:
            self.jobs += 1
            if Pool.pools == 1 and self.jobs == 2:
                raise BrokenProcessPool
            future: Future[int] = Future()
            future.set_result(work(job))
            return future

        def shutdown(self, wait: bool, cancel_futures: bool) -> None:
            ended.append("shut down")

    monkeypatch.setattr(engines, "ProcessPoolExecutor", Pool)
    done: list[int] = []
    assert sum(Processes(2).run(lambda job: done.append(job) or 1, range(5))) == 5
    assert set(done) == {0, 1, 2, 3, 4}
    assert ended == 2 * ["shut down", "terminated", "joined"]


@pytest.mark.slow
def test_three_kills_at_random_moments_leave_no_trace(tmp_path: Path) -> None:
    recipe = small_recipe(storage=StorageConfig(shard_samples=1))
    recipe.to_yaml(tmp_path / "r.yaml")
    build_dataset(recipe, tmp_path / "whole", quiet=True)
    command = [sys.executable, "-c", "from tensorsim.cli import main; main()", "dataset", "build",
               str(tmp_path / "r.yaml"), "--out", str(tmp_path / "set"), "--quiet"]  # fmt: skip
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    moments = np.random.default_rng(int(os.environ.get("KILL_SEED", "0"))).uniform(0.0, 0.6, 3)
    for wait in moments:
        run = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
        while run.poll() is None and not (tmp_path / "set" / "recipe.yaml").exists():
            time.sleep(0.01)
        time.sleep(float(wait))
        run.kill()
        run.wait()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray
def test_ray_makes_the_same_bytes_and_reports_nothing(
    built: Path, recipe: DatasetRecipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    build_dataset(recipe, tmp_path / "set", RayCluster(workers=1), quiet=True)
    from ray._common.usage.usage_lib import usage_stats_enabled

    assert not usage_stats_enabled()
    assert contents(tmp_path / "set") == contents(built)


class Named(NamedTuple):
    """A job with one field, as an engine sends it."""

    path: str


def named_node(job: Named) -> int:
    """Leave a file with the name of the node, and give the other one time to take the next job."""
    import ray

    time.sleep(0.5)
    (Path(job.path).parent / ray.get_runtime_context().get_node_id()).touch()
    return 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray
def test_two_nodes_of_a_cluster_make_the_same_bytes(
    built: Path, recipe: DatasetRecipe, tmp_path: Path
) -> None:
    pytest.importorskip("ray", reason="the extra scale is not installed")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    try:
        cluster.add_node(**node)
        engine = RayCluster(cluster.address)
        build_dataset(recipe, tmp_path / "set", engine, quiet=True)
        (tmp_path / "nodes").mkdir()
        jobs = [Named(str(tmp_path / "nodes" / str(k))) for k in range(8)]
        assert sum(engine.run(named_node, jobs)) == 8
    finally:
        cluster.shutdown()
    assert contents(tmp_path / "set") == contents(built)
    assert len(list((tmp_path / "nodes").iterdir())) == 2
