"""Networks for the pipeline, from files or names."""

import os

from torch import nn

from tensorsim.config import PoseConfig
from tensorsim.protocols import check_part, is_pose_estimator
from tensorsim.vision.detection.acf import AcfDetector
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.pose_library import load_pose_library
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.pose2d.cpm import CPM
from tensorsim.vision.pose2d.hrnet import HRNet
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.pose2d.rtmpose import RtmPose, has_simcc
from tensorsim.vision.pose2d.topdown import TopDownPose


def top_down(pose: nn.Module, flip_test: bool = True) -> nn.Module:
    """A heat-map network as a stage (frames, boxes, valid) -> (keypoints, scores); such a stage is returned as is."""
    if is_pose_estimator(pose):
        return check_part(pose, "pose")
    return TopDownPose(check_part(pose, "network"), flip_test=flip_test, stand_up=True)


def pretrained_detector(source: str | os.PathLike[str] | None = None) -> RTMDet | AcfDetector:
    """The detector from a file or name, in evaluation mode: ACF if the file header says so, else RTMDet.

    Args:
        source: a path, a name of ``tensorsim models list``, or None for the shipped RTMDet.

    Raises:
        TensorsimError: no such file or name, or weights of another network.
    """
    from tensorsim.registry import locate
    from tensorsim.weights import read_metadata

    path = locate(source, "RTMDet", "AcfDetector")
    if read_metadata(path).get("network") == "AcfDetector":
        return AcfDetector.from_pretrained(path)
    return RTMDet.from_pretrained(path)


def pretrained_pose(source: str | os.PathLike[str] | None = None, flip_test: bool = True) -> TopDownPose:
    """Pose estimation with a network from a file or name: ``.onnx`` (heat maps, or RTMPose) runs in ONNX Runtime;
    others are CPM or HRNet.

    Args:
        source: a path, a name of ``tensorsim models list``, or None for the shipped weights.
        flip_test: average with the mirror image, as for published accuracies: better, at twice the cost.

    Raises:
        TensorsimError: no such file or name, or weights of another network.
    """
    from tensorsim.registry import locate
    from tensorsim.weights import read_metadata

    path = locate(source, "HRNet", "CPM")
    if path.suffix == ".onnx":
        if has_simcc(path):
            return RtmPose(path, flip_test)
        network: nn.Module = OnnxHeatmaps(path)
    elif "cpm" in path.name or read_metadata(path).get("network") == "CPM":
        network = CPM.from_pretrained(path)
    else:
        network = HRNet.from_pretrained(path)
    return TopDownPose(network, flip_test=flip_test, stand_up=True)


def pretrained_lifter(people: PoseConfig) -> NearestPoseLifter | TemporalLifter:
    """The lifter described by a configuration, for its camera and the heights of its people.

    Raises:
        TensorsimError: weights or a library that do not exist.
    """
    if people.lifter == "temporal":
        return TemporalLifter.from_pretrained(
            people.lifter_weights, people.camera, people.person_height_m, people.keypoint_threshold
        ).double()
    library = None if people.library is None else load_pose_library(people.library)
    return NearestPoseLifter(
        library,
        neighbours=people.neighbours,
        temporal=people.temporal,
        pitch_rad=people.camera.pitch_rad,
        roll_rad=people.camera.roll_rad,
    ).eval()
