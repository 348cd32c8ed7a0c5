"""Layouts of public sets, on small files in the true layout."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensorsim.config import JOINTS
from tensorsim.data.layouts import listing
from tensorsim.data.layouts.movi import read_movi
from tensorsim.data.layouts.ntu import KINECT_JOINTS, ntu_name, read_ntu
from tensorsim.data.npz import SMPL_JOINTS
from tensorsim.data.sets.clips import Clip
from tensorsim.data.sets.files import FileClips, cut
from tensorsim.data.sets.plan import Plan
from tensorsim.data.sets.recipe import SourceConfig
from tensorsim.data.sets.variations import VariationConfig, draw
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError
from tensorsim.motion import ActivityGenerator
from tests.data.sets.recipes import small_recipe

WALK = ActivityGenerator().generate("walking", seed=1, duration_s=1.0, rate_hz=30.0).joints[0].numpy()


def kinect(joints: np.ndarray) -> np.ndarray:
    """Joints (T, 14, 3) of the world as the 25 of Kinect (T, 25, 3): x to the left, y up, z away."""
    sensor = np.stack([-joints[..., 0], joints[..., 2], joints[..., 1]], -1)
    found = np.repeat(sensor[:, :1], 25, axis=1)
    for name, joint in {"Head": "head", "Neck": "neck"}.items():
        found[:, KINECT_JOINTS.index(name)] = sensor[:, JOINTS.index(joint)]
    for side in ("Left", "Right"):
        for part in ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle"):
            place = KINECT_JOINTS.index(f"{part}{side}")
            found[:, place] = sensor[:, JOINTS.index(f"{side.lower()}_{part.lower()}")]
    return found


def skeleton_file(people: list[np.ndarray]) -> str:
    """Text of a .skeleton file: people (T, 25, 3), the last of whom is missing in the first frame."""
    lines = [str(len(people[0]))]
    for frame in range(len(people[0])):
        there = people[:-1] if frame == 0 and len(people) > 1 else people
        lines.append(str(len(there)))
        for number, person in enumerate(there):
            lines.append(f"7205759403792{number} 0 1 1 1 1 0 0.02 -0.01 2")
            lines.append("25")
            lines += [
                f"{x:.6f} {y:.6f} {z:.6f} 277.1 191.2 1036.0 519.3 -0.2 0.04 0.97 -0.05 2"
                for x, y, z in person[frame]
            ]
    return "\n".join(lines) + "\n"


def test_ntu_skeletons(tmp_path: Path) -> None:
    path = tmp_path / "S001C002P003R001A027.skeleton"
    path.write_text(skeleton_file([kinect(WALK), kinect(WALK + np.array([1.0, 0.0, 0.0]))]))
    motion = read_ntu(path)
    assert motion.fps == 30.0
    assert motion.joints.shape == (2, 30, 14, 3)
    assert np.abs(motion.joints[0, :, 2:].numpy() - WALK[:, 2:]).max() < 1e-5
    assert motion.valid.tolist() == [[True] * 30, [False] + [True] * 29]
    assert ntu_name(path) == (1, 2, 3, 1, 27)
    (clip,) = listing.ntu(SourceConfig("ntu", str(tmp_path)))
    assert (clip.label, clip.person, clip.name) == ("A027", "P003", path.name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[:2000], "cannot be read as NTU"),
        (lambda text: "", "no people in its frames"),
        (lambda text: "3\n0\n0\n0\n", "no people in its frames"),
        (lambda text: text.replace("\n25\n", "\n24\n", 1), "24 joints in frame 0"),
        (lambda text: text.replace(" 1036.0", " x", 1), "could not convert"),
    ],
)
def test_damaged_skeletons_say_why(change: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "S001C001P001R001A001.skeleton"
    path.write_text(change(skeleton_file([kinect(WALK[:4])])))  # type: ignore[operator]
    with pytest.raises(TensorsimError, match=message):
        read_ntu(path)


def test_ntu_names() -> None:
    with pytest.raises(TensorsimError, match="expected one such as S001C001P001R001A001"):
        ntu_name(Path("walk.skeleton"))


def write_csv(path: Path, rows: list[dict[str, object]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_kinetics(tmp_path: Path) -> None:
    films = tmp_path / "films"
    (films / "jogging").mkdir(parents=True)
    (films / "jogging" / "abc_000010_000020.mp4").touch()
    (films / "xyz.webm").touch()
    rows: list[dict[str, object]] = [
        {
            "label": "jogging",
            "youtube_id": "abc",
            "time_start": 10,
            "time_end": 20,
            "split": "train",
            "is_cc": 0,
        },
        {"label": "squat", "youtube_id": "xyz", "time_start": 3, "time_end": 13, "split": "val", "is_cc": 0},
        {
            "label": "squat",
            "youtube_id": "gone",
            "time_start": 0,
            "time_end": 10,
            "split": "test",
            "is_cc": 0,
        },
    ]
    write_csv(tmp_path / "k.csv", rows)
    cut_already, whole, gone = listing.kinetics(SourceConfig("kinetics", str(films), str(tmp_path / "k.csv")))
    assert cut_already == Clip(
        "abc_000010_000020",
        "jogging",
        "abc",
        "abc",
        "train",
        str(films / "jogging" / "abc_000010_000020.mp4"),
        "",
        10.0,
        20.0,
    )
    motion = Motion(torch.zeros(1, 150, 14, 3), torch.ones(1, 150).bool(), 10.0)
    assert cut(motion, cut_already).joints.shape[1] == 150
    assert cut(motion, whole).joints.shape[1] == 100
    assert (whole.path, whole.start_s, whole.end_s, whole.part) == (
        str(films / "xyz.webm"),
        3.0,
        13.0,
        "validation",
    )
    assert not Path(gone.path).exists()


@pytest.mark.parametrize("later", ["abc.mp4", "abc_000003_000013.mp4"])
def test_films_of_kinetics_that_come_later_do_not_change_its_clips(later: str, tmp_path: Path) -> None:
    write_csv(tmp_path / "k.csv", [{"label": "squat", "youtube_id": "abc", "time_start": 3, "time_end": 13}])
    source = SourceConfig("kinetics", str(tmp_path), str(tmp_path / "k.csv"))
    before = Plan(small_recipe(sources=(source,))).listing
    (tmp_path / later).touch()
    after = Plan(small_recipe(sources=(source,)))
    assert after.listing == before
    assert after.clip(0)[1].path == str(tmp_path / later)


def test_films_are_looked_for_once_however_many_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "id3.avi").touch()
    (tmp_path / "id3.mp4").touch()
    rows: list[dict[str, object]] = [
        {"label": "squat", "youtube_id": f"id{k}", "time_start": 0, "time_end": 10} for k in range(20)
    ]
    write_csv(tmp_path / "k.csv", rows)
    searches, glob = [], Path.glob
    monkeypatch.setattr(Path, "glob", lambda self, pattern: searches.append(pattern) or glob(self, pattern))
    clips = listing.kinetics(SourceConfig("kinetics", str(tmp_path), str(tmp_path / "k.csv")))
    assert (len(clips), clips[3].path, len(searches)) == (20, str(tmp_path / "id3.mp4"), 2)


def test_charades(tmp_path: Path) -> None:
    (tmp_path / "46GP8.mp4").touch()
    rows: list[dict[str, object]] = [
        {"id": "46GP8", "subject": "HR43", "scene": "Kitchen", "actions": "c092 11.90 21.20;c147 0.00 12.60"},
        {"id": "N11GT", "subject": "0KZ7", "scene": "Stairs", "actions": ""},
    ]  # fmt: skip
    write_csv(tmp_path / "c.csv", rows)
    source = SourceConfig("charades", str(tmp_path), str(tmp_path / "c.csv"))
    clips = listing.charades(source)
    assert [(c.label, c.start_s, c.end_s, c.person) for c in clips] == [
        ("c092", 11.9, 21.2, "HR43"),
        ("c147", 0.0, 12.6, "HR43"),
    ]
    assert clips[0].path == str(tmp_path / "46GP8.mp4")
    rows[0]["actions"] = "c092 eleven 21"
    write_csv(tmp_path / "c.csv", rows)
    with pytest.raises(TensorsimError, match="46GP8: got 'eleven', expected a number of seconds"):
        listing.charades(source)


def smpl(joints: np.ndarray) -> np.ndarray:
    """Joints (T, 14, 3) as the 52 of SMPL-H, where known."""
    found = np.repeat(joints[:, 1:2], 52, axis=1)
    names = {"head": "head", "neck": "neck"} | {
        f"{side}_{part}": f"{side}_{part}"
        for side in ("left", "right")
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
    }
    for name, joint in names.items():
        found[:, SMPL_JOINTS.index(name)] = joints[:, JOINTS.index(joint)]
    return found


def test_movi(tmp_path: Path) -> None:
    from scipy.io import savemat

    moves = np.empty((1, 2), object)
    for k, description in enumerate(("walking", "jumping jacks")):
        moves[0, k] = {
            "description": description,
            "jointsLocation_amass": smpl(WALK) + k,
            "jointsParent": np.arange(52),
        }
    path = tmp_path / "F_amass_Subject_7.mat"
    savemat(path, {"Subject_7_F_amass": {"id": "Subject_7", "subject": "F", "move": moves}})
    clips = listing.movi(SourceConfig("movi", str(tmp_path)))
    assert [(c.label, c.person, c.key) for c in clips] == [
        ("walking", "Subject_7", "0"),
        ("jumping jacks", "Subject_7", "1"),
    ]
    motion = read_movi(path, "1")
    assert motion.fps == 120.0
    assert np.abs(motion.joints[0, :, 2:].numpy() - WALK[:, 2:] - 1).max() < 1e-5
    for key, got in (("2", "motion 2"), ("-1", "motion -1"), ("walking", "motion walking"), ("", "no key")):
        with pytest.raises(TensorsimError, match=f"got {got}, expected the number of a motion, 0 to 1"):
            read_movi(path, key)
    path.write_bytes(path.read_bytes()[:300])
    assert [c.label for c in listing.movi(SourceConfig("movi", str(tmp_path)))] == ["unreadable"]


def test_tables_of_both_kinds(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: list[dict[str, object]] = [
        {"path": "a.mp4", "start": 1.0, "end": 2.5, "label": "sit", "person": "Ann", "split": "train"},
        {"path": "b.bvh", "start": None, "end": None, "label": "walk", "person": None, "split": "test"},
    ]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "t.parquet")
    write_csv(tmp_path / "t.csv", rows)
    for name in ("t.parquet", "t.csv"):
        first, second = listing.table(SourceConfig("table", str(tmp_path / name)))
        assert first == Clip("a.mp4#0", "sit", "Ann", "a.mp4", "train", str(tmp_path / "a.mp4"), "", 1.0, 2.5)
        assert (second.person, second.start_s, second.part) == ("b.bvh", None, "test")
    (tmp_path / "t.csv").write_text("file,label\na,b\n")
    with pytest.raises(TensorsimError, match="got the columns file, label, expected path as well"):
        listing.table(SourceConfig("table", str(tmp_path / "t.csv")))


def test_person_and_key_may_be_zero(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: list[dict[str, object]] = [
        {"path": name, "file": name, "label": 0, "person": person, "key": 0}
        for name, person in (("a.npz", 0), ("b.npz", 0), ("c.npz", 1), ("d.npz", None))
    ]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "t.parquet")
    write_csv(tmp_path / "t.csv", rows)
    for name in ("t.parquet", "t.csv"):
        clips = listing.table(SourceConfig("table", str(tmp_path / name)))
        assert [(c.person, c.key, c.label) for c in clips] == [
            ("0", "0", "0"),
            ("0", "0", "0"),
            ("1", "0", "0"),
            ("d.npz", "0", "0"),
        ]
        of_movi = listing.movi(SourceConfig("movi", str(tmp_path), str(tmp_path / name)))
        assert [c.person for c in of_movi] == ["0", "0", "1", "d.npz"]


@pytest.mark.parametrize(
    ("kind", "header", "row", "missing"),
    [
        ("table", "path,label", "a.npz", "label"),
        ("table", "path,label", "a.npz,", "label"),
        ("table", "path,label", " ,walk", "path"),
        ("movi", "file,label", "a.npz,", "label"),
        ("movi", "file,label", ",walk", "file"),
        ("kinetics", "label,youtube_id,time_start,time_end", ",abc,0,10", "label"),
        ("kinetics", "label,youtube_id,time_start,time_end", "squat,,0,10", "youtube_id"),
        ("charades", "id,subject,actions", ",HR43,c092 1 2", "id"),
    ],
)
def test_rows_without_a_file_or_label_are_refused(
    kind: Any, header: str, row: str, missing: str, tmp_path: Path
) -> None:
    path = tmp_path / "t.csv"
    path.write_text(f"{header}\n{row}\n")
    source = SourceConfig(kind, *([str(path)] if kind == "table" else [str(tmp_path), str(path)]))
    with pytest.raises(TensorsimError, match=rf"t\.csv: row 1: got no {missing}, expected one"):
        getattr(listing, kind)(source)


@pytest.mark.parametrize("start", ["nan", "inf", "-0.5", "soon"])
def test_times_of_a_table_are_seconds(start: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"path,label,start\na.npz,walk,{start}\n")
    with pytest.raises(TensorsimError, match=f"got '{start}', expected a number of seconds from 0 on"):
        listing.table(SourceConfig("table", str(tmp_path / "t.csv")))


def test_captured_motion_in_folders_of_classes(tmp_path: Path) -> None:
    for label in ("walk", "run"):
        (tmp_path / label).mkdir()
        np.savez(tmp_path / label / "m.npz", joints_m=WALK, fps=30.0)
    (tmp_path / "run" / "notes.txt").touch()
    (tmp_path / "run" / "damaged.npz").write_bytes(b"no archive")
    recipe = small_recipe(sources=(SourceConfig("motion", str(tmp_path)),))
    clips = FileClips(recipe, recipe.sources[0], 0)
    assert clips.labels == ("run", "walk")
    assert [clips.clip(k).name for k in range(len(clips))] == ["run/damaged.npz", "run/m.npz", "walk/m.npz"]
    scene = clips.scene(clips.clip(2), draw(VariationConfig(), 0))
    assert scene.joints.shape == (1, 60, 14, 3)
    with pytest.raises(TensorsimError, match=r"damaged\.npz: got a file that cannot be read as npz"):
        clips.scene(clips.clip(0), draw(VariationConfig(), 0))
    assert not clips.finds_people


def test_motions_are_kept_within_their_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "walk").mkdir()
    for name, seconds in (("a", 1), ("b", 1), ("c", 1), ("d", 9)):
        np.savez(tmp_path / "walk" / f"{name}.npz", joints_m=np.tile(WALK, (seconds, 1, 1)), fps=30.0)
    recipe = small_recipe(sources=(SourceConfig("motion", str(tmp_path)),))
    clips = FileClips(recipe, recipe.sources[0], 0)
    read: list[str] = []
    find = clips.finder.motion
    monkeypatch.setattr(
        clips.finder, "motion", lambda path, key: read.append(Path(path).stem) or find(path, key)
    )
    one = find(clips.clip(0).path, "").joints.nbytes
    monkeypatch.setattr("tensorsim.data.sets.files._KEPT_MB", 2.5 * one / 1e6)
    for place in (0, 1, 0, 1, 2, 1, 2, 0, 3, 3, 2):
        clips.scene(clips.clip(place), draw(VariationConfig(), 0))
    assert "".join(read) == "abcadc"


def test_keypoints_in_folders_of_classes(tmp_path: Path) -> None:
    from tests.film import STANDING
    from tests.test_sources import coco_json

    standing = 300 * np.array(STANDING)[None, None] + np.linspace(100, 150, 30)[None, :, None, None]
    (tmp_path / "stand").mkdir()
    people = coco_json(standing, np.ones((1, 30, 17)), size=(480, 640))
    (tmp_path / "stand" / "a.json").write_text(json.dumps(people))
    recipe = small_recipe(sources=(SourceConfig("keypoints", str(tmp_path), fps=30.0),))
    clips = FileClips(recipe, recipe.sources[0], 0)
    scene = clips.scene(clips.clip(0), draw(VariationConfig(), 0))
    assert bool(torch.isfinite(scene.joints).all())
    assert scene.valid.any()


def test_human36m(tmp_path: Path) -> None:
    joints = np.random.default_rng(0).normal(size=(40, 32, 3)).astype(np.float32)
    data = {"S1": {"Walking": joints, "Walking 1": joints}, "S5": {"Posing": joints}}
    np.savez(tmp_path / "data_3d_h36m.npz", positions_3d=np.array(data, dtype=object))
    clips = listing.h36m(SourceConfig("h36m", str(tmp_path / "data_3d_h36m.npz")))
    assert [(c.label, c.person, c.key) for c in clips] == [
        ("Walking", "S1", "S1/Walking"),
        ("Walking", "S1", "S1/Walking 1"),
        ("Posing", "S5", "S5/Posing"),
    ]


def test_parts_of_films_are_cut_by_time() -> None:
    motion = Motion(
        torch.arange(30.0).reshape(1, 30, 1, 1).expand(1, 30, 14, 3), torch.ones(1, 30).bool(), 10.0
    )
    part = cut(motion, Clip("a", "b", "c", "d", start_s=0.5, end_s=1.0))
    assert part.joints[0, :, 0, 0].tolist() == [5.0, 6.0, 7.0, 8.0, 9.0]
    with pytest.raises(TensorsimError, match="expected at least two frames"):
        cut(motion, Clip("a", "b", "c", "d", start_s=5.0, end_s=6.0))


@pytest.mark.parametrize("kind", ["films", "keypoints", "motion", "ntu", "movi"])
def test_empty_folders_are_refused(kind: str, tmp_path: Path) -> None:
    for folder, message in ((tmp_path, "got no clips, expected"), (tmp_path / "none", "no such folder")):
        fps = 30.0 if kind == "keypoints" else None
        source = SourceConfig(kind, str(folder), fps=fps)  # type: ignore[arg-type]
        with pytest.raises(TensorsimError, match=message):
            FileClips(small_recipe(), source, 0)
