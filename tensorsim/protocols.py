"""Signatures of the replaceable stages of a pipeline.

A custom stage is an ``nn.Module`` whose ``forward`` has the signature of the matching ``__call__`` below; it need not
inherit from anything here. :func:`check_part` refuses others when a pipeline is built. For the letters in shapes see
:mod:`tensorsim.types`.
"""

import inspect
import typing
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.types import Detections, Lifted, RadarMaps, Tracks


class Detector(Protocol):
    """Finds people in images, e.g. :class:`tensorsim.vision.RTMDet`."""

    def __call__(self, images: Tensor) -> Detections:
        """Find people in images (B, 3, H, W), RGB, uint8 or float in [0, 1].

        Returns:
            boxes (B, K, 4) ``xyxy`` in pixels of the images, scores (B, K), labels (B, K) with 0 for people, and
            valid (B, K), which is False for padding.
        """
        ...


class Tracker(Protocol):
    """Follows detections through clips, e.g. :class:`tensorsim.vision.GNNTracker`."""

    def __call__(self, detections: Detections, observed: Tensor) -> Tracks:
        """Turn detections of clips (B, T, K, ...) into tracks (B, P, T, ...).

        Args:
            detections: of every frame; not valid where the detector was not run.
            observed: (B, T) bool, the frames in which it was run.
        """
        ...


class PoseEstimator(Protocol):
    """Finds the keypoints of people in boxes, e.g. :class:`tensorsim.vision.TopDownPose`."""

    def __call__(self, images: Tensor, boxes: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Estimate the keypoints in the valid boxes.

        Args:
            images: (B, 3, H, W) RGB, uint8 or float in [0, 1].
            boxes: (B, P, 4) ``xyxy`` in pixels.
            valid: (B, P) bool.

        Returns:
            COCO-17 keypoints (B, P, 17, 2), ``uv`` in pixels of the images, and scores (B, P, 17).
        """
        ...


class HeatmapNetwork(Protocol):
    """Turns crops into heat maps, e.g. :class:`tensorsim.vision.HRNet`; ``TopDownPose`` makes it a pose estimator."""

    def __call__(self, crops: Tensor) -> Tensor:
        """Turn crops (N, 3, H, W), RGB in [0, 1], into heat maps (N, 17, H / 4, W / 4) of the COCO-17 keypoints.

        A module with other sizes states them in its attributes ``input_size`` (H, W) and ``stride``.
        """
        ...


class Lifter(Protocol):
    """Finds 3D poses for 2D joints, e.g. :class:`tensorsim.vision.NearestPoseLifter`."""

    def __call__(self, keypoints: Tensor, weights: Tensor) -> Lifted:
        """Lift 14 body joints (..., T, 14, 2) in pixels with weights (..., T, 14), 0 for hidden ones, to poses."""
        ...


class Smoother(Protocol):
    """Smooths joints along time, e.g. :class:`tensorsim.vision.KalmanSmoother`."""

    def __call__(self, joints: Tensor, valid: Tensor, fps: float, noise_std_m: Tensor) -> Tensor:
        """Smooth joints (..., T, J, 3) in metres; the result has the same shape.

        Args:
            joints: arbitrary values where not valid.
            valid: (..., T, J) bool; the other joints are filled in.
            fps: frames per second.
            noise_std_m: (..., T, J, 3) or (..., T, J, 1) standard deviation of the joints in metres, from scores, pixel
                size and the spread of depths.
        """
        ...


class Scatterers(Protocol):
    """Places point scatterers on people, e.g. :class:`tensorsim.motion.JointScatterers`."""

    def __call__(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Turn joints at the pulse rate into the scatterers of one scene.

        Args:
            positions: (..., P, M, 14, 3) metres.
            fade: (..., P, M) amplitude of each person in [0, 1], 0 outside the scene.

        Returns:
            Positions (..., M, S, 3) in metres and radar cross sections (..., M, S) in m^2, of all people together.
        """
        ...


class Denoiser(Protocol):
    """Cleans maps, e.g. :class:`tensorsim.enhance.MapDenoiser`."""

    def __call__(self, maps: Tensor) -> Tensor:
        """Clean linear magnitudes (..., H, W), rows range or Doppler, to the same shape, not negative."""
        ...


class Recognizer(Protocol):
    """Names the activity that maps show, e.g. :class:`tensorsim.recognition.ActivityRecognizer`."""

    def __call__(self, maps: RadarMaps) -> Tensor:
        """Turn maps of B scenes into logits (B, classes)."""
        ...


#: The protocol that each pipeline argument must follow.
SLOTS: dict[str, type] = {
    "detector": Detector,
    "tracker": Tracker,
    "pose": PoseEstimator,
    "network": HeatmapNetwork,
    "lifter": Lifter,
    "smoother": Smoother,
    "scatterers": Scatterers,
    "denoiser": Denoiser,
    "recognizer": Recognizer,
}


def check_part(part: Any, slot: str) -> nn.Module:
    """Return the stage if it can be called as its slot requires.

    Checks the arguments of ``forward`` and its return annotation, if there is one. ``nn.Identity`` passes: it
    stands for an unused stage.

    Args:
        part: the stage.
        slot: a key of :data:`SLOTS`, for the message too.

    Raises:
        TensorsimError: not a module, a class instead of an instance, or the wrong arguments or result.
    """
    protocol = SLOTS[slot]
    call = inspect.signature(protocol.__call__)
    wanted = list(call.parameters)[1:]
    # The repr of a signature would spell out module names.
    result = typing.get_type_hints(protocol.__call__)["return"]
    expected = f"expected a module called as {slot}({', '.join(wanted)}) -> {_name(result)}"
    if inspect.isclass(part):
        raise TensorsimError(f"{slot}: got the class {part.__name__}, expected an instance of it")
    if not isinstance(part, nn.Module):
        raise TensorsimError(f"{slot}: got a {type(part).__name__}, {expected}")
    if isinstance(part, nn.Identity):
        return part
    if not _takes(part, len(wanted)):
        raise TensorsimError(
            f"{slot}: got {type(part).__name__}{inspect.signature(part.forward)}, {expected}"
        )
    found = _return_type(part)
    if found is not None and not _serves_as(found, result):
        raise TensorsimError(f"{slot}: got {type(part).__name__}, which returns {_name(found)}, {expected}")
    return part


def check_instance(part: Any, kind: type, name: str) -> None:
    """Refuse a ready-made part of the wrong class.

    Raises:
        TensorsimError: another class, or the class itself instead of an instance.
    """
    if not isinstance(part, kind):
        got = f"the class {part.__name__}" if inspect.isclass(part) else f"a {type(part).__name__}"
        raise TensorsimError(f"{name}: got {got}, expected an instance of {kind.__name__}")


def is_pose_estimator(part: nn.Module) -> bool:
    """Whether a module is called like a :class:`PoseEstimator` and not like a :class:`HeatmapNetwork`."""
    return _takes(part, 3) and not _takes(part, 1)


def check_detections(found: Any) -> None:
    """Refuse a detector's result that is not :class:`~tensorsim.types.Detections` or the like.

    Raises:
        TensorsimError: a list of dictionaries, as torchvision's detectors return, or anything else; boxes in half
            precision.
    """
    if not all(isinstance(getattr(found, name, None), Tensor) for name in Detections._fields):
        inside = f" of {type(found[0]).__name__}" if isinstance(found, list | tuple) and found else ""
        raise TensorsimError(
            f"detector: it returned a {type(found).__name__}{inside}, expected Detections"
            f"({', '.join(Detections._fields)}) with padded tensors; see tensorsim.protocols.Detector"
        )
    if found.boxes.dtype not in (torch.float32, torch.float64):
        raise TensorsimError(
            f"detector: it returned boxes in {found.boxes.dtype}, expected float32 or float64: half precision rounds "
            "to whole pixels"
        )


def _takes(part: nn.Module, arguments: int) -> bool:
    """Whether ``forward`` can be called with this many positional arguments; True if that is unknown."""
    try:
        inspect.signature(part.forward).bind(*[None] * arguments)
    except TypeError:
        return False
    except ValueError:  # compiled code without a signature
        return True
    return True


def _return_type(part: nn.Module) -> Any:
    """The return annotation of ``forward``, or None if there is none or it cannot be resolved."""
    try:
        found = typing.get_type_hints(type(part).forward).get("return")
    except (NameError, TypeError, AttributeError):
        return None
    return None if found is Any else found


def _serves_as(found: Any, wanted: Any) -> bool:
    """Whether a value annotated as ``found`` can be used where ``wanted`` is expected, as far as can be told."""
    found_class, wanted_class = typing.get_origin(found) or found, typing.get_origin(wanted) or wanted
    if not inspect.isclass(found_class) or found_class is object:
        return True
    fields = getattr(wanted_class, "_fields", None)
    if fields is not None:
        return set(fields) <= set(getattr(found_class, "_fields", ()))
    return issubclass(found_class, wanted_class)


def _name(hint: Any) -> str:
    """An annotation without module names."""
    arguments = ", ".join(_name(a) for a in typing.get_args(hint))
    plain = getattr(typing.get_origin(hint) or hint, "__name__", str(hint))
    return f"{plain}[{arguments}]" if arguments else plain
