"""``tensorsim check``: tests of the installation."""

import importlib
import os
from collections.abc import Callable

import torch

from tensorsim.config import RadarConfig
from tensorsim.process import cpu_quota

_LIBRARIES = (
    "torch",
    "torchaudio",
    "kornia",
    "cv2",
    "onnx",
    "onnxruntime",
    "scipy",
    "safetensors",
    "matplotlib",
)


def _libraries() -> str:
    versions = []
    for name in _LIBRARIES:
        module = importlib.import_module(name)
        versions.append(f"{name} {getattr(module, '__version__', '?')}")
    return ", ".join(versions)


def _shipped_files() -> str:
    from tensorsim.files import sha256_of
    from tensorsim.model_files import manifest, model_path

    entries = manifest()
    for entry in entries:
        digest = sha256_of(model_path(entry["file"]))
        if digest != entry["sha256"]:
            raise ValueError(f"{entry['file']} has SHA-256 {digest}, the manifest says {entry['sha256']}")
    return ", ".join(entry["file"] for entry in entries)


def _radar_chain() -> str:
    """A target that approaches at 2 m/s must appear at +2 m/s."""
    from tensorsim.radar.simulator import RadarSimulator

    radar = RadarConfig.free_space()
    time_s = torch.arange(2048, dtype=torch.float64) / radar.prf_hz
    position = torch.stack((0 * time_s, 3.0 - 2.0 * time_s, torch.full_like(time_s, 1.5)), dim=-1).unsqueeze(
        1
    )
    simulator = RadarSimulator(radar)
    maps = simulator(position, torch.ones(1, dtype=torch.float64))
    spectrum = maps.doppler_time.mean(dim=-1)
    speed = float(simulator.doppler.doppler_hz[spectrum.argmax()]) * radar.doppler_wavelength_m / 2
    if abs(speed - 2.0) > 0.05:
        raise ValueError(f"a target approaching at 2 m/s shows at {speed:.2f} m/s")
    return f"a target approaching at 2.00 m/s shows at {speed:.2f} m/s"


def _device() -> str:
    if not torch.cuda.is_available():
        return "CPU (no CUDA device)"
    return f"{torch.cuda.get_device_name()} and CPU"


def _threads() -> str:
    """How threads wait for each other; long spinning slows them all down on a busy machine."""
    waits = ", ".join(
        f"{name}={os.environ[name]}" for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT") if name in os.environ
    )
    return (
        f"{torch.get_num_threads()} of torch, {cpu_quota()} of {os.cpu_count()} processors usable, "
        f"waiting: {waits or 'the default of OpenMP, slow on a busy machine; set OMP_WAIT_POLICY=PASSIVE'}"
    )


def run_checks() -> bool:
    """Run every check and print a line for each; True if all pass."""
    checks: dict[str, Callable[[], str]] = {
        "libraries": _libraries,
        "device": _device,
        "threads": _threads,
        "shipped files": _shipped_files,
        "radar chain": _radar_chain,
    }
    good = True
    for name, check in checks.items():
        try:
            print(f"ok    {name}: {check()}")
        except Exception as error:  # a self-check reports whatever is wrong and continues
            good = False
            print(f"WRONG {name}: {type(error).__name__}: {error}")
    return good
