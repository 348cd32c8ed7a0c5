"""Networks of this package in ONNX Runtime or OpenVINO, which fuse convolutions with what follows them.

A network is exported once and kept in the user's cache, by its class, its weights, and the versions of torch and of
this package. The pose network also runs in 8-bit integers (:mod:`tensorsim.vision.quantise`), with ranges taken from
crops of rendered people, or, in OpenVINO, in bfloat16.
"""

import hashlib
import io
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from threading import Lock, local
from typing import Any, Literal, NoReturn

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tensorsim.device import multiplies_bfloat16
from tensorsim.errors import TensorsimError
from tensorsim.files import NotWrittenError, write_bytes
from tensorsim.geometry.boxes import LETTERBOX_GREY, letterbox_size
from tensorsim.types import Detections
from tensorsim.vision.detection.rtmdet import RTMDet

# OpenVINO would report every import to Google Analytics, in a thread that the process waits for at its end. This is set
# here because a process that loads a pickled engine imports this module only.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]  # None: no such module

#: Held while a network is opened: parts of a film are processed in several threads, and the exporter allows only one.
_OPENING = Lock()

#: What runs a network: in float32, except ``"int8"`` (ONNX Runtime, 8-bit integers) and ``"openvino-bfloat16"``.
Runtime = Literal["onnxruntime", "int8", "openvino", "openvino-bfloat16"]
Images = npt.NDArray[np.float32]
#: Images (N, 3, H, W) to outputs (N, ...).
Run = Callable[[Images], list[Images]]


def import_failure(package: str) -> str | None:
    """Why a package cannot be imported, in one line; None if it can."""
    try:
        import_module(package)
    except Exception as error:  # a broken installation may raise anything
        return " ".join(str(error).split()) or type(error).__name__
    return None


class OnnxEngine(nn.Module):
    """Runs a network (N, 3, H, W) -> one or several tensors (N, ...) in another runtime on the CPU.

    Images on other devices, of another dtype or size, or with gradients are passed to the network itself. The runtime
    keeps the weights of its first call: if they change later, build a new engine. In float32 outputs agree to
    rounding (1e-5 of the largest), in bfloat16 and in 8-bit integers, for crops of people in [0, 1], to about 5 % of
    the largest. Bfloat16 is for processors with instructions for it; on others OpenVINO computes in float32.

    Args:
        network: with static shapes except for N; it is put into evaluation mode.
        size: (H, W).
        runtime: what runs it.

    Raises:
        TensorsimError: the runtime is not installed.
    """

    def __init__(self, network: nn.Module, size: tuple[int, int], runtime: Runtime = "onnxruntime") -> None:
        super().__init__()
        package = "openvino" if runtime.startswith("openvino") else "onnxruntime"
        reason = import_failure(package)
        if reason is not None:
            raise TensorsimError(f"--engine {package}: {reason}; install it with `pip install {package}`")
        # The exporter leaves a network in the mode that it says it is in, parts included.
        self.network, self.size, self.runtime = network.eval(), size, runtime
        self.threads = torch.get_num_threads()
        self._run: Run | None = None

    def forward(self, images: Tensor) -> list[Tensor]:
        """The outputs of the network, flat."""
        as_exported = images.dtype == torch.float32 and images.shape[2:] == self.size and images.shape[0] > 0
        if images.device.type != "cpu" or images.requires_grad or not as_exported:
            return _flat(self.network(images))
        with _OPENING:
            if self._run is None:
                self._run = _opened(self.network, self.size, self.runtime, self.threads)
        return [torch.from_numpy(output) for output in self._run(images.contiguous().numpy())]

    def extra_repr(self) -> str:
        """What runs it: results are cached by the ``repr`` of a network, so each runtime has its own."""
        return f"runtime={self.runtime!r}"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_run": None}

    def __prepare_scriptable__(self) -> NoReturn:
        raise TensorsimError(
            f"{type(self).__name__}: cannot be scripted: another runtime runs it, expected the network itself "
            "(--engine torch)"
        )


class OnnxPose(nn.Module):
    """A heat-map network of this package behind its own interface, run by an :class:`OnnxEngine`."""

    def __init__(self, network: nn.Module, runtime: Runtime = "onnxruntime") -> None:
        super().__init__()
        self.input_size: tuple[int, int] = getattr(network, "input_size", (256, 192))
        self.stride = getattr(network, "stride", 4)
        self.engine = OnnxEngine(network, self.input_size, runtime)

    def forward(self, crops: Tensor) -> Tensor:
        """Crops (N, 3, H, W) to heat maps (N, 17, h, w)."""
        return self.engine(crops)[0]


class OnnxDetector(nn.Module):
    """An :class:`~tensorsim.vision.RTMDet` whose dense part is run by an :class:`OnnxEngine`."""

    def __init__(self, detector: RTMDet, runtime: Runtime = "onnxruntime") -> None:
        super().__init__()
        self.detector = detector
        self.engine = OnnxEngine(_Dense(detector), (detector.input_size, detector.input_size), runtime)

    def forward(self, images: Tensor) -> Detections:
        """Images (B, 3, H, W) to detections, see :class:`~tensorsim.vision.RTMDet`."""
        dense = self.engine(self.preprocess(images))
        levels = len(dense) // 2
        return self.detector.select(dense[:levels], dense[levels:], images.shape[-2], images.shape[-1])

    def preprocess(self, images: Tensor) -> Tensor:
        """As the detector does, to the bit; 8-bit images on the CPU by OpenCV, in less than half the time."""
        if (
            images.dtype != torch.uint8
            or images.device.type != "cpu"
            or images.shape[1:2] != (3,)
            or not images.numel()
        ):
            return self.detector.preprocess(images)
        side = self.detector.input_size
        height, width = letterbox_size(images.shape[-2], images.shape[-1], side)
        squares = np.full((len(images), 3, side, side), LETTERBOX_GREY, np.uint8)
        for square, image in zip(squares, images.permute(0, 2, 3, 1).numpy(), strict=True):
            square[:, :height, :width] = cv2.split(cv2.resize(image, (width, height)))
        return self.detector.normalise(torch.from_numpy(squares))


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


def _opened(network: nn.Module, size: tuple[int, int], runtime: Runtime, threads: int) -> Run:
    """A network in its runtime, from the user's cache or exported now."""

    path = _cached(network, size, runtime == "int8")

    def run(model: bytes) -> Run:
        if runtime.startswith("openvino"):
            cache = path.parent if path.is_file() else None
            return _in_openvino(model, threads, runtime == "openvino-bfloat16", cache)
        return _in_onnxruntime(model)

    if path.is_file():
        try:
            return run(path.read_bytes())
        except Exception:  # damaged; the runtimes' own exceptions share no base class
            path.unlink(missing_ok=True)
    model = _exported(network, size)
    if runtime == "int8":
        from tensorsim.render.crops import rendered_crops
        from tensorsim.vision.quantise import quantised

        model = quantised(model, rendered_crops(size))
    # A cache that cannot be written costs an export in every run.
    with suppress(NotWrittenError):
        write_bytes(path, model)
    return run(model)


def _cached(network: nn.Module, size: tuple[int, int], int8: bool) -> Path:
    from tensorsim.registry import cache_dir

    versions = f"{torch.__version__} {version('tensorsim')}"
    digest = hashlib.sha256(f"{network!r} {size} {int8} {versions}".encode())
    for name, value in network.state_dict().items():
        digest.update(name.encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return cache_dir() / "engines" / f"{digest.hexdigest()[:32]}.onnx"


def _exported(network: nn.Module, size: tuple[int, int]) -> bytes:
    """The network as an ONNX file with any number of images."""
    example, file = torch.zeros(2, 3, *size), io.BytesIO()
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracing exporter, which torch is replacing with a slower one
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


def _in_onnxruntime(model: bytes) -> Run:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    # Spinning threads slow down those that work.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    return lambda images: session.run(None, {"images": images})


def _in_openvino(model: bytes, threads: int, bfloat16: bool, cache: Path | None) -> Run:
    import openvino

    bfloat16 = bfloat16 and multiplies_bfloat16(torch.device("cpu"))
    core = openvino.Core()
    settings: dict[str, Any] = {
        "INFERENCE_PRECISION_HINT": "bf16" if bfloat16 else "f32",
        # One stream and thread for each calling thread.
        "NUM_STREAMS": threads,
        "INFERENCE_NUM_THREADS": threads,
    }
    if cache is not None:  # compiled networks, which take a third of the time to open
        settings["CACHE_DIR"] = str(cache)
    compiled = core.compile_model(core.read_model(model), "CPU", settings)
    # The first such call in a process builds the table of NumPy types; two at a time would deadlock.
    openvino.Type.f32.to_dtype()
    of_thread = local()

    def run(images: Images) -> list[Images]:
        if not hasattr(of_thread, "request"):
            of_thread.request = compiled.create_infer_request()
        return list(of_thread.request.infer({0: images}, share_inputs=True).values())

    return run
