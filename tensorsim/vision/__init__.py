"""Frames -> metric 3D joints at video rate."""

from tensorsim.body.skeleton import coco_to_body
from tensorsim.vision.calibration.calibrator import CameraCalibrator, CameraEstimate
from tensorsim.vision.detection.acf import AcfDetector
from tensorsim.vision.detection.rtmdet import RTMDet
from tensorsim.vision.lifting.bone_fit import BoneFit
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose
from tensorsim.vision.lifting.range_rate import RangeRate
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.videopose3d import VideoPose3D, VideoPoseLifter
from tensorsim.vision.lifting.walking_legs import WalkingLegs
from tensorsim.vision.pose2d.cpm import CPM
from tensorsim.vision.pose2d.hrnet import HRNet
from tensorsim.vision.pose2d.onnx_heatmaps import OnnxHeatmaps
from tensorsim.vision.pose2d.rtmpose import RtmPose
from tensorsim.vision.pose2d.topdown import TopDownPose
from tensorsim.vision.smoothing.kalman import KalmanSmoother
from tensorsim.vision.tracking.mosse import MosseTracker
from tensorsim.vision.tracking.tracker import GNNTracker

__all__ = [
    "CPM",
    "AcfDetector",
    "BoneFit",
    "CameraCalibrator",
    "CameraEstimate",
    "GNNTracker",
    "HRNet",
    "KalmanSmoother",
    "MetricPose",
    "MosseTracker",
    "NearestPoseLifter",
    "OnnxHeatmaps",
    "RTMDet",
    "RangeRate",
    "RtmPose",
    "TemporalLifter",
    "TopDownPose",
    "VideoPose3D",
    "VideoPoseLifter",
    "WalkingLegs",
    "coco_to_body",
]
