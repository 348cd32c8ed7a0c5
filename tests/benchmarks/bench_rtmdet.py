"""RTMDet-nano from a frame to boxes against ONNX Runtime with OpenCV's letterbox, both on the same file.

Usage: python -m tests.benchmarks.bench_rtmdet NETWORK.onnx [VIDEO] [--threads 2] [--rounds 30]
Without a video the frames are noise. Candidates take turns; medians are per frame.
"""

import argparse
import warnings
from collections.abc import Callable

import cv2
import numpy as np
import onnxruntime
import torch

from tensorsim.geometry.boxes import letterbox_size, non_maximum_suppression
from tensorsim.vision.detection.rtmdet import RTMDet
from tests.benchmarks.timing import medians


def read_frames(path: str | None, count: int) -> np.ndarray:
    """(count, H, W, 3) BGR uint8."""
    if path is None:
        return np.random.default_rng(0).integers(0, 256, (count, 720, 1280, 3), dtype=np.uint8)
    video = cv2.VideoCapture(path)
    frames: list[np.ndarray] = []
    while len(frames) < count:
        frames.append(video.read()[1])
    return np.stack(frames)


def runtime_detector(path: str, side: int, threads: int) -> Callable[[np.ndarray], np.ndarray]:
    """The peer: OpenCV, NumPy and ONNX Runtime, a frame at a time."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    mean = np.array([103.53, 116.28, 123.675], np.float32)
    std = np.array([57.375, 57.12, 58.395], np.float32)

    def detect(frame: np.ndarray) -> np.ndarray:
        height, width = letterbox_size(frame.shape[0], frame.shape[1], side)
        canvas = np.full((side, side, 3), 114, np.uint8)
        canvas[:height, :width] = cv2.resize(frame, (width, height))
        x = (canvas.astype(np.float32) - mean) / std
        return session.run(None, {"input": np.ascontiguousarray(x.transpose(2, 0, 1)[None])})[0]

    return detect


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network")
    parser.add_argument("video", nargs="?")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=30)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    batch = 8
    frames = read_frames(options.video, batch)
    images = torch.from_numpy(frames[..., ::-1].copy()).permute(0, 3, 1, 2).contiguous()
    detector = RTMDet.from_pretrained(options.network)
    peer = runtime_detector(options.network, detector.input_size, options.threads)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frozen = torch.jit.freeze(torch.jit.script(detector))
    boxes = torch.rand(1, 1500, 2) * 200
    boxes = torch.cat([boxes, boxes + 20 + torch.rand(1, 1500, 2) * 60], -1)
    scores, labels = torch.rand(1, 1500), torch.zeros(1, 1500, dtype=torch.int64)
    valid = torch.ones(1, 1500, dtype=torch.bool)

    candidates: dict[str, tuple[int, Callable[[], object]]] = {
        "ONNX Runtime, 1 frame": (1, lambda: peer(frames[0])),
        "eager, 1 frame": (1, lambda: detector(images[:1])),
        f"eager, {batch} frames": (batch, lambda: detector(images)),
        "scripted and frozen, 1 frame": (1, lambda: frozen(images[:1])),
        f"scripted and frozen, {batch} frames": (batch, lambda: frozen(images)),
        "letterbox alone": (1, lambda: detector.preprocess(images[:1])),
        "suppression alone, 1500 boxes, 100 kept": (
            1,
            lambda: non_maximum_suppression(boxes, scores, labels, valid, 0.6, 100),
        ),
    }
    with torch.no_grad():
        took = medians([run for _, run in candidates.values()], options.rounds)
    reference = took[0]
    for (name, (count, _)), time_s in zip(candidates.items(), took, strict=True):
        print(f"{name:42s} {time_s / count * 1e3:8.2f} ms  {reference * count / time_s:5.2f} x ONNX Runtime")


if __name__ == "__main__":
    main()
