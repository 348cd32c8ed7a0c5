import io
import json
import math
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.data import h36m as h36m_file
from tensorsim.data import npz
from tensorsim.data.coco import load_coco_keypoints
from tensorsim.data.h36m import H36M_JOINTS
from tensorsim.data.motion_files import load_motion, motion_keys, place
from tensorsim.data.npz import SMPL_JOINTS
from tensorsim.data.skeletons import Motion, body_joints
from tensorsim.errors import TensorsimError


def walker(frames: int = 5) -> np.ndarray:
    """(frames, 14, 3) metres: a standing body that moves away."""
    joints = forward_kinematics(BodyPose.standing((frames,)), 1.75).numpy()
    return joints + np.linspace(0, 1, frames)[:, None, None] * [0.1, 1.0, 0.0] + [0.3, 3.0, 0.9]


# ---- BVH -----------------------------------------------------------------------------------------------

LIMBS = {
    "mixamo": "mixamorig:{side}Arm mixamorig:{side}ForeArm mixamorig:{side}Hand "
    "mixamorig:{side}UpLeg mixamorig:{side}Leg mixamorig:{side}Foot mixamorig:Head mixamorig:{side}Shoulder",
    "cmu": "{side}Arm {side}ForeArm {side}Hand {side}UpLeg {side}Leg {side}Foot Head {side}Shoulder",
    "biovision": "{side}Shoulder {side}Elbow {side}Wrist {side}Hip {side}Knee {side}Ankle Head {side}Collar",
    "unreal": "upperarm_{s} lowerarm_{s} hand_{s} thigh_{s} calf_{s} foot_{s} head clavicle_{s}",
}


def bvh(style: str, unit: float = 100.0, root_degrees: float = 0.0) -> str:
    """A T-pose of simple lengths, y up, facing +z, so that its left is +x; two frames, 60 Hz."""

    def joint(name: str, offset: tuple[float, float, float], inner: str = "") -> str:
        numbers = " ".join(str(o * unit) for o in offset)
        inner = inner or "End Site\n{\nOFFSET 0 0 0\n}\n"
        return f"JOINT {name}\n{{\nOFFSET {numbers}\nCHANNELS 3 Zrotation Xrotation Yrotation\n{inner}}}\n"

    body = ""
    count = 0
    for side, x in (("Left", 1.0), ("Right", -1.0)):
        arm, fore, hand, thigh, shank, foot, head, collar = (
            LIMBS[style].format(side=side, s=side[0].lower()).split()
        )
        leg = joint(thigh, (0.1 * x, 0, 0), joint(shank, (0, -0.43, 0), joint(foot, (0, -0.42, 0))))
        chain = joint(arm, (0.15 * x, 0, 0), joint(fore, (0.3 * x, 0, 0), joint(hand, (0.25 * x, 0, 0))))
        body += leg + joint(collar, (0.03 * x, 0.5, 0), chain)
        count += 7
    tip = f"End Site\n{{\nOFFSET 0 {0.2 * unit} 0\n}}\n"
    body += joint(head, (0, 0.6, 0), tip)
    count += 1
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    still = " 0" * (3 * count)
    lines = [f"{0.5 * unit * t} {0.92 * unit} {0.0} 0 0 {root_degrees}{still}" for t in range(2)]
    return (
        f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\n{channels}\n{body}}}\nMOTION\nFrames: 2\n"
        f"Frame Time: {1 / 60:.7f}\n" + "\n".join(lines) + "\n"
    )


@pytest.mark.parametrize("style", list(LIMBS))
def test_bvh_of_common_skeletons(style: str, tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text(bvh(style))
    motion = load_motion(path)
    assert motion.joints.shape == (1, 2, 14, 3)
    assert motion.fps == pytest.approx(60, rel=1e-4)
    assert motion.valid.all()
    # Facing +z of a y-up file is facing the radar, -y; so the body's right is at -x.
    expected = {
        "head": (0.0, -0.1, 1.62),
        "neck": (0.0, 0.0, 1.42),
        "right_shoulder": (-0.18, 0.0, 1.42),
        "right_elbow": (-0.48, 0.0, 1.42),
        "right_wrist": (-0.73, 0.0, 1.42),
        "left_wrist": (0.73, 0.0, 1.42),
        "right_hip": (-0.1, 0.0, 0.92),
        "left_knee": (0.1, 0.0, 0.49),
        "left_ankle": (0.1, 0.0, 0.07),
    }
    for name, place_m in expected.items():
        joint = motion.joints[0, 0, JOINTS.index(name)]
        torch.testing.assert_close(joint, torch.tensor(place_m), atol=1e-4, rtol=0, msg=f"{name}: {joint}")
    torch.testing.assert_close(
        motion.joints[0, 1] - motion.joints[0, 0], torch.tensor([0.5, 0, 0]).expand(14, 3)
    )


def test_bvh_rotations_are_right_handed(tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text(bvh("cmu", root_degrees=90.0))
    # A quarter turn about +y takes +z (its front) to +x.
    joints = load_motion(path).joints[0, 0]
    assert float(joints[0, 0]) == pytest.approx(0.1, abs=1e-4)
    torch.testing.assert_close(joints[7, :2], torch.tensor([0.0, 0.73]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("unit", [1.0, 100.0, 1000.0, 1 / 0.0254])
def test_unit_of_a_bvh_is_guessed_or_given(unit: float, tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text(bvh("cmu", unit))
    assert float(load_motion(path).joints[0, 0, 1, 2]) == pytest.approx(1.42, rel=1e-3)
    assert float(load_motion(path, unit_m=0.5 / unit).joints[0, 0, 1, 2]) == pytest.approx(0.71, rel=1e-3)


def test_bad_bvh_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text("HIERARCHY\nnonsense")
    with pytest.raises(TensorsimError, match=r"clip\.bvh.*BVH"):
        load_motion(path)
    path.write_text(bvh("cmu").replace("LeftForeArm", "Gadget"))
    with pytest.raises(TensorsimError, match="left_elbow"):
        load_motion(path)


# ---- npz -----------------------------------------------------------------------------------------------


def test_own_joints_come_back_as_they_are(tmp_path: Path) -> None:
    joints = walker().astype(np.float32)
    np.savez(tmp_path / "pose.npz", joints_m=joints[None], valid=np.array([[True] * 4 + [False]]), fps=24.0)
    motion = load_motion(tmp_path / "pose.npz")
    torch.testing.assert_close(motion.joints[0], torch.from_numpy(joints))
    assert motion.valid.tolist() == [[True] * 4 + [False]]
    assert motion.fps == 24.0


def test_named_joints_in_any_order(tmp_path: Path) -> None:
    joints = walker()
    order = np.random.default_rng(0).permutation(14)
    names = [JOINTS[i] if i else "Nose" for i in order]
    names = [f"{name.split('_')[1]}.{name[0].upper()}" if "_" in name else name for name in names]
    np.savez(tmp_path / "a.npz", poses=joints[:, order] * 100, joint_names=np.array(names), fps=30)
    motion = load_motion(tmp_path / "a.npz", unit_m=0.01)
    np.testing.assert_allclose(motion.joints[0], joints, atol=1e-5)
    np.savez(tmp_path / "b.npz", poses=joints[:, order])
    again = load_motion(tmp_path / "b.npz", fps=30, joint_names=tuple(names))
    np.testing.assert_allclose(again.joints[0], joints, atol=1e-5)


@pytest.mark.parametrize(("scale", "height"), [(1000.0, "1750"), (0.0, "0")])
def test_people_of_impossible_size_are_refused(scale: float, height: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", joints=walker() * scale, fps=30)
    with pytest.raises(TensorsimError, match=rf"a person {height} m tall, expected 0\.3 to 3 m: .* metres"):
        load_motion(tmp_path / "a.npz")
    if scale:
        assert float(load_motion(tmp_path / "a.npz", unit_m=1 / scale).joints.abs().max()) < 5


def test_those_who_are_not_there_have_any_size(tmp_path: Path) -> None:
    joints = np.stack([walker(), np.zeros((5, 14, 3))])
    valid = np.array([[True] * 5, [False] * 5])
    np.savez(tmp_path / "a.npz", joints=joints, valid=valid, fps=30)
    assert load_motion(tmp_path / "a.npz").valid.tolist() == valid.tolist()


def test_frame_rate_as_an_array_of_one_number(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", joints=walker(), fps=np.array([[120.0]]))
    assert load_motion(tmp_path / "a.npz").fps == 120.0


def test_npz_without_motion_says_what_it_has(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", poses=np.zeros((5, 156)), trans=np.zeros((5, 3)))
    with pytest.raises(TensorsimError, match=r"poses \[5, 156\], trans \[5, 3\], expected one of shape"):
        load_motion(tmp_path / "a.npz")


def test_neck_is_the_middle_of_the_shoulders_and_coco_joints_fit() -> None:
    positions = torch.randn(3, 17, 3)
    joints = body_joints(positions, COCO_KEYPOINTS)
    torch.testing.assert_close(joints[:, 1], positions[:, 5:7].mean(1))
    torch.testing.assert_close(joints[:, 0], positions[:, 0])
    torch.testing.assert_close(joints[:, 10], positions[:, 16])
    torch.testing.assert_close(joints[:, 7], positions[:, 9])


@pytest.mark.parametrize(
    ("key", "rate", "count"), [("joints", "mocap_framerate", 22), ("Jtr", "mocap_frame_rate", 24)]
)
def test_amass_joints(key: str, rate: str, count: int, tmp_path: Path) -> None:
    own = walker()
    smpl = np.zeros((5, count, 3))
    for i, name in enumerate(SMPL_JOINTS):
        if name in JOINTS:
            smpl[:, i] = own[:, JOINTS.index(name)]
    np.savez(tmp_path / "amass.npz", **{key: smpl, rate: np.float64(120.0)}, betas=np.zeros(16))
    motion = load_motion(tmp_path / "amass.npz")
    np.testing.assert_allclose(motion.joints[0, :, 2:], own[:, 2:], atol=1e-6)
    assert motion.fps == 120.0
    # No nose in SMPL: it is put before the head, which this body has facing +y.
    ahead = motion.joints[0, :, 0].numpy() - own[:, 0]
    np.testing.assert_allclose(ahead, np.broadcast_to([0.0, 0.1, 0.04], (5, 3)), atol=1e-6)


def test_several_clips_need_a_key(tmp_path: Path) -> None:
    np.savez(tmp_path / "many.npz", walk=walker(), run=walker(3), run_fps=50.0, walk_fps=25.0)
    with pytest.raises(TensorsimError, match="expected one of walk, run"):
        load_motion(tmp_path / "many.npz")
    assert load_motion(tmp_path / "many.npz", key="run").joints.shape == (1, 3, 14, 3)
    assert load_motion(tmp_path / "many.npz", key="run").fps == 50.0
    assert load_motion(tmp_path / "many.npz", key="walk", fps=12.0).fps == 12.0


def test_real_motion_capture(shared_data: Path) -> None:
    path = shared_data / "mocap" / "deepmimic_14joints.npz"
    with np.load(path) as arrays:
        expected, rate = arrays["walk"], float(arrays["walk_fps"])
    motion = load_motion(path, key="walk")
    np.testing.assert_allclose(motion.joints[0], expected, atol=1e-6)
    assert motion.fps == pytest.approx(rate)


# ---- Human3.6M -----------------------------------------------------------------------------------------


def h36m(tmp_path: Path) -> tuple[Path, np.ndarray]:
    own = walker()
    positions = np.full((5, 32, 3), 9.0, np.float32)
    for i, name in H36M_JOINTS.items():
        positions[:, i] = own[:, 0 if name == "nose" else JOINTS.index(name)]
    path = tmp_path / "data_3d_h36m.npz"
    np.savez_compressed(path, positions_3d={"S1": {"Walking": positions, "Sitting 1": positions[:2]}})
    return path, own


def test_h36m_of_videopose3d(tmp_path: Path) -> None:
    path, own = h36m(tmp_path)
    motion = load_motion(path, key="S1/Walking")
    np.testing.assert_allclose(motion.joints[0], own, atol=1e-6)
    assert motion.fps == 50.0
    with pytest.raises(TensorsimError, match="S1/Walking, S1/Sitting 1"):
        load_motion(path)


class _Hostile:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path(self.target),)  # type: ignore[attr-defined]


def test_hostile_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    hostile = _Hostile()
    hostile.target = str(tmp_path / "pwned")  # type: ignore[attr-defined]
    path = tmp_path / "data_3d_h36m.npz"
    np.savez(path, positions_3d=np.array({"S1": {"Walking": hostile}}, dtype=object))
    with pytest.raises(TensorsimError, match="arrays only"):
        load_motion(path, key="S1/Walking")
    assert not (tmp_path / "pwned").exists()
    with zipfile.ZipFile(path) as archive:  # a free pickle would have run it
        content = archive.read("positions_3d.npy")
    pickle.loads(content[content.index(b"\x80") :])
    assert (tmp_path / "pwned").exists()


class _Pickled:
    """Pickles as this call and this state."""

    def __init__(self, *reduced: object) -> None:
        self.reduced = reduced

    def __reduce__(self) -> Any:
        return self.reduced


#: A structure whose field is said to be an object, but not its whole: NumPy takes its bytes for addresses.
DTYPE = _Pickled(np.dtype, ("V8", False, True), (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0))
ADDRESSES = {
    "a buffer": _Pickled(np.ndarray, ((1,), DTYPE, b"\x01" * 8)),
    "a state": _Pickled(
        np._core.multiarray._reconstruct,
        (np.ndarray, (0,), b"b"),
        (1, (1,), DTYPE, False, b"\x01" * 8),
    ),
    "a scalar": _Pickled(np._core.multiarray.scalar, (DTYPE, b"\x01" * 8)),
    "objects": np.array([1, "a", None], dtype=object),
    "text": np.array(["a", "b"]),
    "too few bytes": _Pickled(
        np._core.multiarray._reconstruct,
        (np.ndarray, (0,), b"b"),
        (1, (9, 32, 3), np.dtype("f4"), False, b"\x01" * 8),
    ),
}


def test_a_pickle_cannot_make_addresses_of_its_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.npz" for name in ADDRESSES]
    for path in paths:
        np.savez(path, positions_3d=np.array({"S1": {"Walking": ADDRESSES[path.stem]}}, dtype=object))
    read = (
        "import sys; from tensorsim.data import load_motion\nfor path in sys.argv[1:]:\n"
        " try: load_motion(path)\n except ValueError as error: print(type(error).__name__, error, flush=True)"
    )
    command = [sys.executable, "-c", read, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"a segmentation fault is -11; {done.stdout} {done.stderr}"
    lines = done.stdout.splitlines()
    assert len(lines) == len(paths)
    for line, path in zip(lines, paths, strict=True):
        assert line.startswith(f"TensorsimError {path}: ")


def test_names_in_a_pickle_of_arrays_are_those_of_both_numpys_and_no_others() -> None:
    reader = h36m_file._ArraysOnly(io.BytesIO(b"."))
    for core in ("numpy.core.multiarray", "numpy._core.multiarray"):
        assert reader.find_class(core, "_reconstruct") is h36m_file._Array
    assert reader.find_class("numpy", "ndarray") is h36m_file._Array
    assert reader.find_class("numpy", "dtype") is h36m_file._Dtype
    assert reader.find_class("_codecs", "encode") is h36m_file._Encoded
    for module, name in (
        ("numpy.core.multiarray", "scalar"), ("numpy._core.multiarray", "frombuffer"), ("numpy", "load"),
        ("numpy", "_reconstruct"), ("_codecs", "decode"), ("codecs", "encode"), ("builtins", "eval"),
        ("os", "system"), ("collections", "OrderedDict"), ("numpy.core", "_reconstruct"), ("numpy", "memmap"),
    ):  # fmt: skip
        with pytest.raises(pickle.UnpicklingError, match="expected arrays only"):
            reader.find_class(module, name)


def test_a_memo_without_end_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|O", "fortran_order": False, "shape": ()})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        # LONG_BINPUT 2**30: the unpickler would fill 16 GB with zeros.
        archive.writestr("positions_3d.npy", header.getvalue() + b"\x80\x04}r\x00\x00\x00\x40.")
    with pytest.raises(TensorsimError, match="memo"):
        load_motion(tmp_path / "a.npz")


def test_sizes_are_read_before_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "MAX_BYTES", 10_000)
    np.savez_compressed(tmp_path / "big.npz", joints_m=np.zeros((30, 14, 3)), fps=30.0)
    np.savez_compressed(tmp_path / "big3d.npz", positions_3d={"S1": {"Walking": np.zeros((30, 32, 3))}})
    for name in ("big", "big3d"):
        with pytest.raises(TensorsimError, match=f"{name}.npz: .* unpacks to .* MB"):
            load_motion(tmp_path / f"{name}.npz")


# ---- COCO ----------------------------------------------------------------------------------------------


def entry(value: float, score: float = 0.5, **more: int) -> dict[str, object]:
    return {"keypoints": [number for i in range(17) for number in (value + i, value - i, score)], **more}


def test_coco_results_by_image(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps([entry(5, image_id=12), entry(1, image_id=7), entry(2, image_id=7)]))
    people = load_coco_keypoints(path)
    assert people.keypoints.shape == (2, 2, 17, 2)
    # The one of image 12 is nearest to the second of image 7.
    assert people.valid.tolist() == [[True, True], [False, True]]
    assert people.keypoints[0, 1, 3].tolist() == [5.0, -1.0]
    assert people.keypoints[1, 1, 0].tolist() == [5.0, 5.0]
    assert float(people.scores[0, 0, 0]) == 0.5


def test_coco_annotations_with_tracks_and_empty_frames(tmp_path: Path) -> None:
    path = tmp_path / "annotations.json"
    annotations = [entry(1, 2, image_id=1, track_id=9), entry(2, 0, image_id=3, track_id=4)]
    path.write_text(json.dumps({"images": [{"id": i} for i in (1, 2, 3)], "annotations": annotations}))
    people = load_coco_keypoints(path)
    assert people.valid.tolist() == [[False, True], [False, False], [True, False]]
    assert people.scores[0, 1].tolist() == [1.0] * 17  # visibility 2 is seen
    assert people.scores[2, 0].tolist() == [0.0] * 17


def test_a_track_id_of_null_is_none_and_one_is_once_in_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    people = [entry(x, image_id=i, track_id=None) for i in (1, 2) for x in (1, 100)]
    path.write_text(json.dumps(people))
    assert load_coco_keypoints(path).valid.tolist() == [[True, True], [True, True]]
    people = [entry(x, image_id=i, track_id=7) for i, x in ((1, 1), (2, 1), (2, 100))]
    path.write_text(json.dumps(people))
    with pytest.raises(
        TensorsimError, match=r"results\.json: got track_id 7 twice in frame 1, expected it once"
    ):
        load_coco_keypoints(path)


def test_coco_folder_of_frames(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i:04d}.json").write_text(json.dumps([] if i == 1 else [entry(i)]))
    people = load_coco_keypoints(tmp_path)
    assert people.valid.tolist() == [[True], [False], [True]]
    assert float(people.keypoints[2, 0, 0, 0]) == 2.0


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "5",
        "null",
        '[{"keypoints": [1, 2, 3]}]',
        '[{"keypoints": null}]',
        json.dumps([{"keypoints": ["a"] * 51}]),
        json.dumps([entry(1, image_id=1), entry(1) | {"image_id": "b"}]),
        json.dumps([entry(1, image_id=1, track_id=4), entry(1, image_id=1), entry(2, image_id=1)]),
        json.dumps([entry(1, image_id=1, track_id=4), entry(2, image_id=2, track_id=None)]),
        '{"annotations": []}',
        '{"annotations": null}',
        '{"images": [{"file_name": "a.jpg"}], "annotations": []}',
    ],
)
def test_bad_coco_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(TensorsimError, match=r"bad\.json"):
        load_coco_keypoints(path)


def test_more_people_than_a_scene_has_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "many.json"
    for people, message in (
        ([entry(1, image_id=1)] * 200, "got 200, expected people in a frame from 1 to 64"),
        ([entry(1, image_id=i, track_id=i) for i in range(1500)], "got 1500, expected people from 1 to 256"),
    ):
        path.write_text(json.dumps(people))
        with pytest.raises(TensorsimError, match=f"many.json: {message}"):
            load_coco_keypoints(path)
    images = [{"id": 1, "height": 100_000, "width": 100_000}]
    path.write_text(json.dumps({"images": images, "annotations": [entry(1, image_id=1)]}))
    with pytest.raises(TensorsimError, match="size of the images: got 100000, expected image side"):
        load_coco_keypoints(path)
    np.savez(tmp_path / "many.npz", joints_m=np.zeros((200, 2, 14, 3)), fps=30.0)
    with pytest.raises(TensorsimError, match=r"many\.npz: got 200, expected people in a frame"):
        load_motion(tmp_path / "many.npz")
    np.savez(tmp_path / "slow.npz", joints_m=np.zeros((2, 14, 3)), fps=1e-300)
    with pytest.raises(TensorsimError, match=r"slow\.npz: fps: got 1e-300, expected frame rate from 0.1"):
        load_motion(tmp_path / "slow.npz")


# ---- placement and refusals ----------------------------------------------------------------------------


def test_placement_turns_about_the_start_and_stands_on_the_floor() -> None:
    joints = torch.from_numpy(walker()).float()[None]
    motion = Motion(joints, torch.ones(1, 5, dtype=torch.bool), 30.0)
    placed = place(motion, range_m=4.0, heading_rad=math.pi / 2)
    hips = (placed.joints[0, :, 8] + placed.joints[0, :, 11]) / 2
    torch.testing.assert_close(hips[0, :2], torch.tensor([0.0, 4.0]), atol=1e-5, rtol=0)
    # It went (0.1, 1); a quarter turn counter-clockwise makes that (-1, 0.1).
    torch.testing.assert_close((hips[-1] - hips[0])[:2], torch.tensor([-1.0, 0.1]), atol=1e-5, rtol=0)
    assert float(placed.joints[..., 2].min()) == pytest.approx(0.07, abs=1e-5)
    kept = place(motion)
    torch.testing.assert_close(kept.joints[..., :2], joints[..., :2])
    with pytest.raises(TensorsimError, match="first person"):
        place(motion._replace(valid=~motion.valid))


def test_files_that_are_not_motion_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TensorsimError, match="no such file"):
        load_motion(tmp_path / "none.bvh")
    np.save(tmp_path / "c.npy", walker())
    for name, content in (
        ("a.txt", b"x"),
        ("b.npz", b"not a zip"),
        ("c.npz", (tmp_path / "c.npy").read_bytes()),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TensorsimError, match=name):
            load_motion(tmp_path / name)
    bad = {
        "no frame rate": {"joints_m": walker()},
        "without names": {"joints_m": walker()[:, :9], "fps": 30.0},
        "cannot be read as npz": {"joints_m": walker(), "fps": np.array([30.0, 31.0])},
        "are not a dictionary": {"positions_3d": np.array({"S1": 5}, dtype=object)},
        "NaN": {"joints_m": np.full((2, 14, 3), np.nan), "fps": 30.0},
        "no frames": {"joints_m": np.zeros((0, 14, 3)), "fps": 30.0},
        r"other \[3\], expected one of shape": {"other": np.zeros(3)},
        "joint names, expected 14": {"joints_m": walker(), "fps": 30.0, "joint_names": np.array(["a"])},
        "valid of shape": {"joints_m": walker(), "fps": 30.0, "valid": np.ones((2, 5), bool)},
    }
    for message, arrays in bad.items():
        np.savez(tmp_path / "bad.npz", **arrays)
        with pytest.raises(TensorsimError, match=message):
            load_motion(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", joints_m=walker())
    with pytest.raises(TensorsimError, match="fps"):
        load_motion(tmp_path / "bad.npz", fps=-1.0)


def test_keys_name_the_motions_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "some.npz"
    np.savez(path, walk=walker(), run=walker()[None], other=np.zeros((4, 2)), fps=30.0)
    assert motion_keys(path) == ["walk", "run"]
    assert all(load_motion(path, key=key).joints.shape == (1, 5, 14, 3) for key in motion_keys(path))
    np.savez(path, walk=walker(), joints_m=walker(), fps=30.0)
    assert motion_keys(path) == [None]
    assert motion_keys(h36m(tmp_path)[0]) == [None]
    assert motion_keys(tmp_path / "none.bvh") == [None]
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(TensorsimError, match=r"text\.npz: got a file that cannot be read as npz"):
        motion_keys(tmp_path / "text.npz")
