"""Frames -> metric 3D joints at video rate."""

from tensorsim.vision.cpm import CPM
from tensorsim.vision.hrnet import HRNet
from tensorsim.vision.kalman import KalmanSmoother
from tensorsim.vision.lifter import NearestPoseLifter
from tensorsim.vision.metric_pose import MetricPose
from tensorsim.vision.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.rtmdet import RTMDet
from tensorsim.vision.skeleton import coco_to_body
from tensorsim.vision.topdown import TopDownPose
from tensorsim.vision.tracker import GNNTracker
from tensorsim.vision.videopose3d import VideoPose3D

__all__ = [
    "CPM",
    "GNNTracker",
    "HRNet",
    "KalmanSmoother",
    "MetricPose",
    "NearestPoseLifter",
    "OnnxHeatmaps",
    "RTMDet",
    "TopDownPose",
    "VideoPose3D",
    "coco_to_body",
]
