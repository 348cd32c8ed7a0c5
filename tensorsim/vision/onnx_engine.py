"""Networks of this package in ONNX Runtime, which joins convolutions with what follows them: twice as fast on a CPU.

A network is exported once and kept in the user's cache, by its class, its weights and torch's version. The pose network
also runs in 8-bit integers (:mod:`tensorsim.vision.quantise`), in ranges that crops of rendered people have.
"""

import hashlib
import io
import warnings
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file
from tensorsim.geometry.boxes import LETTERBOX_GREY, letterbox_size
from tensorsim.types import Detections
from tensorsim.vision.detection.rtmdet import RTMDet

#: Held while a session is opened: parts of a film come in several threads, and the exporter stands only one.
_OPENING = Lock()


class OnnxEngine(nn.Module):
    """Runs a network (N, 3, H, W) -> one or several tensors (N, ...) in ONNX Runtime on the CPU, elsewhere as it is.

    Float32, without gradients; answers agree to rounding (1e-5 of the largest).

    Args:
        network: with static shapes but for N; it is put into evaluation mode.
        size: (H, W).
        int8: in 8-bit integers: pictures are crops of people in [0, 1], and answers are those of the network to about
            5 % of the largest.

    Raises:
        TensorsimError: no ONNX Runtime.
    """

    def __init__(self, network: nn.Module, size: tuple[int, int], int8: bool = False) -> None:
        super().__init__()
        # The exporter leaves a network in the mode that it says it is in, parts included.
        self.network, self.size, self.int8 = network.eval(), size, int8
        self._session: Any = None

    def forward(self, images: Tensor) -> list[Tensor]:
        """The outputs of the network, flat."""
        if images.device.type != "cpu" or images.dtype != torch.float32 or images.shape[0] == 0:
            return _flat(self.network(images))
        with _OPENING:
            if self._session is None:
                self._session = _session(self.network, self.size, self.int8)
        found = self._session.run(None, {"images": images.contiguous().numpy()})
        return [torch.from_numpy(output) for output in found]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_session": None}


class OnnxPose(nn.Module):
    """A heat-map network of this package behind its own interface, run by an :class:`OnnxEngine`."""

    def __init__(self, network: nn.Module, int8: bool = False) -> None:
        super().__init__()
        self.input_size: tuple[int, int] = getattr(network, "input_size", (256, 192))
        self.stride = getattr(network, "stride", 4)
        self.engine = OnnxEngine(network, self.input_size, int8)

    def forward(self, crops: Tensor) -> Tensor:
        """Crops (N, 3, H, W) to heat maps (N, 17, h, w)."""
        return self.engine(crops)[0]


class OnnxDetector(nn.Module):
    """An :class:`~tensorsim.vision.RTMDet` whose dense part is run by an :class:`OnnxEngine`."""

    def __init__(self, detector: RTMDet) -> None:
        super().__init__()
        self.detector = detector
        self.engine = OnnxEngine(_Dense(detector), (detector.input_size, detector.input_size))

    def forward(self, images: Tensor) -> Detections:
        """Images (B, 3, H, W) to detections, see :class:`~tensorsim.vision.RTMDet`."""
        dense = self.engine(self.preprocess(images))
        levels = len(dense) // 2
        return self.detector.select(dense[:levels], dense[levels:], images.shape[-2], images.shape[-1])

    def preprocess(self, images: Tensor) -> Tensor:
        """As the detector does, to the bit; 8-bit images on the CPU by OpenCV, in less than half the time."""
        if images.dtype != torch.uint8 or images.device.type != "cpu" or images.shape[1:2] != (3,):
            return self.detector.preprocess(images)
        side = self.detector.input_size
        height, width = letterbox_size(images.shape[-2], images.shape[-1], side)
        squares = np.full((len(images), side, side, 3), LETTERBOX_GREY, np.uint8)
        for square, image in zip(squares, images.permute(0, 2, 3, 1).numpy(), strict=True):
            square[:height, :width] = cv2.resize(image, (width, height))
        return self.detector.normalise(torch.from_numpy(squares).permute(0, 3, 1, 2))


class _Dense(nn.Module):
    """The dense part of a detector as a network of its own."""

    def __init__(self, detector: RTMDet) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, images: Tensor) -> list[Tensor]:
        logits, distances = self.detector.dense(images)
        return logits + distances


def _flat(outputs: Any) -> list[Tensor]:
    return [outputs] if isinstance(outputs, Tensor) else list(outputs)


def _session(network: nn.Module, size: tuple[int, int], int8: bool) -> Any:
    """The session of a network, from the user's cache or exported now."""
    path = _cached(network, size, int8)
    if path.is_file():
        try:
            return _opened(path.read_bytes())
        except Exception:  # damaged; the runtime's own exceptions share no base class
            path.unlink(missing_ok=True)
    data = _exported(network, size)
    if int8:
        from tensorsim.render.crops import rendered_crops
        from tensorsim.vision.quantise import quantised

        data = quantised(data, rendered_crops(size))
    # A cache that cannot be written costs an export in every run.
    with suppress(OSError), complete_file(path) as scratch:
        scratch.write_bytes(data)
    return _opened(data)


def _cached(network: nn.Module, size: tuple[int, int], int8: bool) -> Path:
    from tensorsim.registry import cache_dir

    digest = hashlib.sha256(f"{network!r} {size} {int8} {torch.__version__}".encode())
    for name, value in network.state_dict().items():
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return cache_dir() / "engines" / f"{digest.hexdigest()[:32]}.onnx"


def _exported(network: nn.Module, size: tuple[int, int]) -> bytes:
    """The network as an ONNX file with any number of images."""
    example, file = torch.zeros(2, 3, *size), io.BytesIO()
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter by tracing, which torch replaces with a slower one
        count = len(_flat(network(example)))
        names = [f"output_{index}" for index in range(count)]
        torch.onnx.export(
            network,
            (example,),
            file,  # type: ignore[arg-type]  # it takes files as well
            input_names=["images"],
            output_names=names,
            dynamic_axes={name: {0: "n"} for name in ("images", *names)},
            dynamo=False,
        )
    return file.getvalue()


def _opened(data: bytes) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise TensorsimError(
            f"--engine onnxruntime: it cannot be imported ({error}), expected it installed: pip install onnxruntime"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    # Threads that spin while others work slow those down.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
