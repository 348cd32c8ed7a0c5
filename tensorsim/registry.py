"""Weights by name: those shipped with tensorsim, and those published by others.

Shipped files are inside the package; others are downloaded once into the user's cache and checked against their
SHA-256. A path can be given instead of a name.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from tensorsim.config.documents import suggestion
from tensorsim.errors import TensorsimError, first_line
from tensorsim.files import sha256_of, write_text
from tensorsim.model_files import manifest, models_dir


@dataclass(frozen=True)
class ModelEntry:
    """One file of weights, or of poses.

    Attributes:
        name: what ``from_pretrained`` takes.
        network: class that loads it; "" for poses.
        file: its file name.
        licence: licence of the weights.
        source: authors and training data.
        metrics: accuracy as stated by its authors, or a reference to the model card.
        preprocessing: of the input, done by the class.
        sha256: full digest, or its first eight digits where only those are published.
        url: address of the file; None for a shipped one.
        default: whether ``from_pretrained()`` without a name loads it.
    """

    name: str
    network: str
    file: str
    licence: str
    source: str
    metrics: str
    preprocessing: str
    sha256: str
    url: str | None = None
    default: bool = False

    @property
    def shipped(self) -> bool:
        """Whether the file comes with the package."""
        return self.url is None

    @property
    def assurance(self) -> str:
        """How thoroughly a download is verified, in words."""
        if len(self.sha256) == 64:
            return "whole SHA-256"
        return f"{len(self.sha256)} digits of SHA-256, which is weak"

    @property
    def path(self) -> Path:
        """Where the file is, or will be once downloaded."""
        return (models_dir() if self.shipped else cache_dir()) / self.file


_OPENMMLAB = "https://download.openmmlab.com"
_COCO_CROP = "RGB crop of 1.25 times the box, ImageNet mean and deviation"


def _rtmdet(name: str, folder: str, file: str, sha256: str, metrics: str, size: int) -> ModelEntry:
    return ModelEntry(
        name,
        "RTMDet",
        file,
        "Apache-2.0",
        "OpenMMLab (MMDetection, MMPose)",
        metrics,
        f"letterbox to {size}x{size}, BGR, mean 103.53/116.28/123.675, deviation 57.375/57.12/58.395",
        sha256,
        f"{_OPENMMLAB}/{folder}/{file}",
    )


def _pose(name: str, network: str, file: str, sha256: str, ap: str, size: str) -> ModelEntry:
    return ModelEntry(
        name,
        network,
        file,
        "Apache-2.0",
        "OpenMMLab (MMPose), trained on COCO",
        f"COCO val2017 AP {ap} with person boxes of 56.4 AP and flip test",
        f"{_COCO_CROP}, {size} (height x width)",
        sha256,
        f"{_OPENMMLAB}/mmpose/v1/body_2d_keypoint/topdown_heatmap/coco/{file}",
    )


def _coco_rtmdet(size: str, stamp: str, sha256: str, ap: str) -> ModelEntry:
    stem = f"rtmdet_{size}_8xb32-300e_coco"
    folder = f"mmdetection/v3.0/rtmdet/{stem}"
    return _rtmdet(
        f"rtmdet-{size}-coco",
        folder,
        f"{stem}_{stamp}-{sha256}.pth",
        sha256,
        f"COCO val2017 box AP {ap}",
        640,
    )


def _person_rtmdet(size: str, sha256: str, ap: str, side: int) -> ModelEntry:
    file = f"rtmdet_{size}_8xb32-100e_coco-obj365-person-{sha256}.pth"
    return _rtmdet(
        f"rtmdet-{size}-person", "mmpose/v1/projects/rtmpose", file, sha256, f"person box AP {ap}", side
    )


def _hrnet(width: int, size: str, batch: int, sha256: str, date: str, ap: str) -> ModelEntry:
    name = f"hrnet-w{width}-coco" + ("" if size == "256x192" else f"-{size}")
    file = f"td-hm_hrnet-w{width}_8xb{batch}-210e_coco-{size}-{sha256}_{date}.pth"
    return _pose(name, "HRNet", file, sha256, ap, size)


def _cpm(size: str, batch: int, sha256: str, date: str, ap: str) -> ModelEntry:
    name = "cpm-coco" + ("" if size == "256x192" else f"-{size}")
    return _pose(name, "CPM", f"td-hm_cpm_8xb{batch}-210e_coco-{size}-{sha256}_{date}.pth", sha256, ap, size)


def _videopose(frames: int, kind: str, sha256: str, error_mm: str, joints: str) -> ModelEntry:
    file = f"videopose_h36m_{frames}frames_fullconv_supervised{kind}-{sha256}_20210527.pth"
    return ModelEntry(
        f"videopose3d-h36m-{frames}" + kind.replace("_", "-"),
        "VideoPose3D",
        file,
        "Apache-2.0",
        "OpenMMLab (MMPose), trained on Human3.6M",
        f"Human3.6M MPJPE {error_mm} mm on {joints} 2D joints",
        "17 joints of Human3.6M, pixels from the middle of the image over half its width",
        sha256,
        f"{_OPENMMLAB}/mmpose/body3d/videopose/{file}",
    )


#: Published by others. Eight digits of SHA-256 are part of their file names; a full digest comes from a copy
#: that reproduces the published accuracy.
PUBLISHED: tuple[ModelEntry, ...] = (
    _coco_rtmdet("tiny", "20220902_112414", "78e30dcc", "41.1"),
    _coco_rtmdet("s", "20220905_161602", "387a891e", "44.6"),
    _coco_rtmdet("m", "20220719_112220", "229f527c", "49.4"),
    _coco_rtmdet("l", "20220719_112030", "5a0be7c4", "51.5"),
    _coco_rtmdet("x", "20220715_230555", "cc79b9ae", "52.8"),
    _person_rtmdet("nano", "05d8511e", "40.3", 320),
    _person_rtmdet("m", "235e8209", "62.5", 640),
    _hrnet(32, "256x192", 64, "81c58e40", "20220909", "0.749"),
    _hrnet(32, "384x288", 64, "ca5956af", "20220909", "0.761"),
    _hrnet(48, "256x192", 32, "0e67c616", "20220913", "0.756"),
    _hrnet(48, "384x288", 32, "c161b7de", "20220915", "0.767"),
    _cpm("256x192", 64, "0e978875", "20220920", "0.627"),
    _cpm("384x288", 32, "165487b8", "20221011", "0.652"),
    _videopose(27, "", "fe8fbba9", "40.1", "true"),
    _videopose(81, "", "1f2d1104", "39.1", "true"),
    _videopose(243, "", "880bea25", "37.6", "true"),
    _videopose(243, "_cpn_ft", "88f5abbb", "47.9", "detected"),
    ModelEntry(
        "dncnn-gray-blind",
        "DnCNN",
        "dncnn_gray_blind.pth",
        "MIT",
        "K. Zhang (KAIR), trained on photographs",
        "blind grey denoising, noise of 0 to 55 grey levels",
        "grey in [0, 1]",
        "e8172769f3cdc6c5298ddd63655b900673a9bd8fb8e6e26e883277ff4baa4cbd",
        "https://github.com/cszn/KAIR/releases/download/v1.0/dncnn_gray_blind.pth",
    ),
)


def shipped() -> tuple[ModelEntry, ...]:
    """Files that come with the package, as ``manifest.json`` lists them."""
    return tuple(
        ModelEntry(
            name=entry["name"],
            network=entry.get("network", ""),
            file=entry["file"],
            licence=entry["licence"],
            source=entry["source"],
            metrics=entry.get("metrics", ""),
            preprocessing=entry.get("preprocessing", ""),
            sha256=entry["sha256"],
            default=entry.get("default", False),
        )
        for entry in manifest()
    )


def shipped_weights(*networks: str) -> dict[str, str]:
    """Digests of the shipped files of these networks by name, to tell their results from those of other weights."""
    return {entry.name: entry.sha256 for entry in shipped() if entry.network in networks}


def entries() -> tuple[ModelEntry, ...]:
    """All entries: shipped files, then published ones."""
    return (*shipped(), *PUBLISHED)


def cache_dir() -> Path:
    """Folder of downloaded weights: ``hub/tensorsim`` in torch's cache (``$TORCH_HOME``, else ``~/.cache/torch``)."""
    import torch

    return Path(torch.hub.get_dir()) / "tensorsim"


def find(name: str, *networks: str) -> ModelEntry:
    """The entry with this name, limited to ``networks`` if any are given.

    Raises:
        TensorsimError: no such name; the message lists the known names and the most similar one.
    """
    known = {entry.name: entry for entry in entries() if not networks or entry.network in networks}
    if name in known:
        return known[name]
    what = f"weights of {' or '.join(networks)}" if networks else "weights"
    raise TensorsimError(
        f"{what}: got {name!r}, expected a path or one of: {', '.join(sorted(known)) or 'none'}"
        f"{suggestion(name, list(known))}"
    )


def locate(source: str | os.PathLike[str] | None, *networks: str) -> Path:
    """Path of the weights passed to ``from_pretrained``, downloaded if necessary.

    Args:
        source: a path (with a suffix or a folder, or an existing file), the name of an entry, or None for the shipped
            weights.
        networks: names of the classes that can load them; None takes the weights of the first class with shipped ones.

    Raises:
        TensorsimError: no such name, no shipped weights, or a failed download. A path is returned unchanged, even if
            the file does not exist.
    """
    if source is None:
        defaults = {entry.network: entry for entry in shipped() if entry.default}
        for network in networks:
            if network in defaults:
                return defaults[network].path
        raise TensorsimError(f"{' or '.join(networks)}: no weights are shipped, expected a path or a name")
    path = Path(source)
    if path.suffix or len(path.parts) > 1 or path.exists():
        return path
    return fetch(find(str(source), *networks))


def name_of(path: Path) -> str:
    """The name of shipped weights, which is the same on every machine; for others, their path."""
    return next((entry.name for entry in shipped() if entry.path == path), str(path))


def fetch(entry: ModelEntry, quiet: bool = False) -> Path:
    """The file of an entry, downloaded if missing. An interrupted download is resumed.

    The full SHA-256 of the download is stored beside it, so that later changes are noticed even if only eight digits
    are published.

    Args:
        entry: which file.
        quiet: no progress bar.

    Raises:
        TensorsimError: no connection, or a file with the wrong SHA-256 (it is removed).
    """
    path = entry.path
    if entry.url is None:
        return path
    if path.is_file():
        verify(entry)
        return path
    import gdown
    import requests

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        gdown.download(entry.url, str(path), quiet=quiet, use_cookies=False, resume=True, timeout=30)
    except (OSError, requests.exceptions.RequestException, gdown.exceptions.DownloadError) as error:
        raise TensorsimError(
            f"{entry.name}: could not fetch {entry.url} ({type(error).__name__}: {first_line(error)}); "
            f"with a connection elsewhere, save it as {path}, or give the path of a copy"
        ) from error
    digest = verify(entry)
    write_text(_kept_digest(entry), digest + "\n")
    return path


def _kept_digest(entry: ModelEntry) -> Path:
    return entry.path.with_name(f"{entry.file}.sha256")


def verify(entry: ModelEntry) -> str:
    """Check the file of an entry against its digest, and return the digest.

    Raises:
        TensorsimError: the file is missing, or its digest is wrong; a downloaded file is then removed.
    """
    if not entry.path.is_file():
        raise TensorsimError(
            f"{entry.name}: {entry.path} is not there; fetch it: tensorsim models fetch {entry.name}"
        )
    digest = sha256_of(entry.path)
    kept = _kept_digest(entry)
    expected = entry.sha256
    if not entry.shipped and digest.startswith(expected) and kept.is_file():
        expected = kept.read_text(encoding="ascii", errors="replace").strip()
    if not digest.startswith(expected):
        if not entry.shipped:
            entry.path.unlink()
            kept.unlink(missing_ok=True)
        raise TensorsimError(
            f"{entry.name}: {entry.path} has SHA-256 {digest}, expected {expected}"
            + ("; reinstall tensorsim" if entry.shipped else "...; it was removed, fetch it again")
        )
    return digest
