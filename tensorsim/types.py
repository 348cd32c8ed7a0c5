"""What stages pass to each other: NamedTuples of padded, batched tensors, and the letters used for their shapes.

Letters used in all docstrings:

=====  ==========================================================================================
``B``  clips in a batch
``T``  video frames
``P``  people, padded to one count per batch (``valid`` says which are real); in echo synthesis, paths
``K``  detections of a frame, padded likewise; in Doppler-time maps, frames of the STFT
``J``  joints: 17 of COCO in the image, 14 of the radar body in metres
``S``  scatterers
``V``  channels of an array: every transmitter with every receiver
``M``  pulses (slow time)
``N``  samples of a pulse (fast time)
``R``  range bins
``F``  Doppler bins
=====  ==========================================================================================
"""

from typing import NamedTuple

from torch import Tensor


class Detections(NamedTuple):
    """People (or other classes) found in images, best first, padded to one count.

    Attributes:
        boxes: (..., K, 4) ``xyxy`` pixels of the input image; zeros where not valid.
        scores: (..., K) in [0, 1]; zeros where not valid.
        labels: (..., K) int64 class index; 0 is the person class of COCO and of one-class models.
        valid: (..., K) bool.
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    valid: Tensor


class Tracks(NamedTuple):
    """People followed through clips.

    Attributes:
        boxes: (B, P, T, 4) ``xyxy`` pixels; zeros where not valid.
        valid: (B, P, T) bool, true from a track's first to its last matched frame, coasted frames included, and
            in adjacent frames in which the detector was not run.
        matched: (B, P, T) bool, true where a detection was assigned in that frame.
    """

    boxes: Tensor
    valid: Tensor
    matched: Tensor


class Lifted(NamedTuple):
    """3D poses found for 2D joints, one per frame.

    Attributes:
        depth: (..., T, 14) depth along the line of sight relative to the mid-hip point, in body heights, positive =
            further away.
        scale: (..., T) height in pixels that the body would have standing at its distance, whatever its pose.
        keypoints: (..., T, 14, 2) pixels, the found pose placed in the image: stands in for hidden joints.
        nearest: (..., T) int64 index of the best match, ``pose * yaws + heading``.
        distance: (..., T) its weighted squared error over the spread of the joints; 0 is a perfect fit.
        deviation: (..., T, 14) standard deviation of ``depth`` among the poses that fit, in body heights; 0 for a
            single pose.
    """

    depth: Tensor
    scale: Tensor
    keypoints: Tensor
    nearest: Tensor
    distance: Tensor
    deviation: Tensor


class Pose(NamedTuple):
    """People of clips with their joints.

    Attributes:
        boxes: (B, P, T, 4) ``xyxy`` pixels.
        keypoints: (B, P, T, 17, 2) COCO-17 ``uv`` pixels.
        keypoint_scores: (B, P, T, 17) from 0, higher means more certain.
        joints: (B, P, T, 14, 3) world metres in the order of ``tensorsim.JOINTS``; finite everywhere.
        valid: (B, P, T) bool, whether the person is in the scene.
    """

    boxes: Tensor
    keypoints: Tensor
    keypoint_scores: Tensor
    joints: Tensor
    valid: Tensor


class RadarMaps(NamedTuple):
    """What a radar shows of a scene. Magnitudes are linear, not dB.

    Attributes:
        range_time: (..., R, M) magnitude of the range profiles; with a display rate, M columns of several pulses each.
        range_time_mti: (..., R, M') the same after the moving target indicator (M' = M - 1 for two-pulse).
        doppler_time: (..., F, K) magnitude, Doppler ascending, positive = approaching.
        ridges: (..., C, K) int64 Doppler bin of each of C ridges.
        ridge_magnitudes: (..., C, K) values of ``doppler_time`` in these bins.
        snr_db: (...) realised signal-to-noise ratio per IF sample in dB; +inf without noise.
    """

    range_time: Tensor
    range_time_mti: Tensor
    doppler_time: Tensor
    ridges: Tensor
    ridge_magnitudes: Tensor
    snr_db: Tensor


class Simulation(NamedTuple):
    """Everything that :class:`tensorsim.VideoToDoppler` returns for clips: the fields of Pose, then of RadarMaps.

    ``valid`` is false throughout a clip in which nobody was found: its maps show the empty scene. Eager code also
    issues a warning; TorchScript cannot.

    Attributes:
        boxes: (B, P, T, 4) ``xyxy`` pixels.
        keypoints: (B, P, T, 17, 2) COCO-17 ``uv`` pixels.
        keypoint_scores: (B, P, T, 17).
        joints: (B, P, T, 14, 3) world metres in the order of ``tensorsim.JOINTS``.
        valid: (B, P, T) bool, whether the person is in the scene.
        range_time: (B, R, M) linear magnitude.
        range_time_mti: (B, R, M') linear magnitude.
        doppler_time: (B, F, K) linear magnitude.
        ridges: (B, C, K) int64 Doppler bins.
        ridge_magnitudes: (B, C, K) linear magnitude.
        snr_db: (B,) dB.
    """

    boxes: Tensor
    keypoints: Tensor
    keypoint_scores: Tensor
    joints: Tensor
    valid: Tensor
    range_time: Tensor
    range_time_mti: Tensor
    doppler_time: Tensor
    ridges: Tensor
    ridge_magnitudes: Tensor
    snr_db: Tensor


class Recognition(NamedTuple):
    """Everything that :class:`tensorsim.VideoToActivity` returns: the fields of :class:`Simulation`, then logits.

    Attributes:
        logits: (B, classes) in the order of the recognizer's ``class_names``.
    """

    boxes: Tensor
    keypoints: Tensor
    keypoint_scores: Tensor
    joints: Tensor
    valid: Tensor
    range_time: Tensor
    range_time_mti: Tensor
    doppler_time: Tensor
    ridges: Tensor
    ridge_magnitudes: Tensor
    snr_db: Tensor
    logits: Tensor
