"""What ``summary.json`` says about a simulation: people, camera, configuration, activity."""

import math
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from tensorsim.config import RadarConfig, SimulationConfig
from tensorsim.files import write_json
from tensorsim.recognition import ActivityRecognizer, label_windows
from tensorsim.recognition.timeline import NOT_SURE, scene_probabilities
from tensorsim.streaming import Found
from tensorsim.types import Pose, RadarMaps
from tensorsim.vision.calibration.calibrator import camera_row

if TYPE_CHECKING:
    from tensorsim.sources import Source


def people_of(pose: Pose, fps: float, radar: RadarConfig) -> list[dict[str, Any]]:
    """One row per person: first and last frame, mean range of the torso from the radar, and mean approach speed."""
    rows = []
    antennas = torch.tensor(radar.middle_m, dtype=torch.float64)
    for person in range(pose.joints.shape[1]):
        frames = torch.nonzero(pose.valid[0, person]).flatten()
        if frames.numel() == 0:
            continue  # a track on which no joint was seen
        torso = pose.joints[0, person, frames][:, [1, 8, 11]].double().mean(dim=1)
        range_m = (torso - antennas).norm(dim=-1)
        duration_s = max(float(frames[-1] - frames[0]) / fps, 1 / fps)
        rows.append(
            {
                "id": person + 1,
                "first_frame": int(frames[0]),
                "last_frame": int(frames[-1]),
                "mean_range_m": round(float(range_m.mean()), 3),
                "mean_approach_m_s": round(float(range_m[0] - range_m[-1]) / duration_s, 3),
            }
        )
    return rows


def summary_of(source: "Source", config: SimulationConfig, found: Found, maps: RadarMaps) -> dict[str, Any]:
    """What ``summary.json`` says of every simulation; :meth:`SimulationConfig.from_yaml` can read its ``config``."""
    snr_db = float(maps.snr_db)
    document = config.to_document()
    return {
        "source": {"kind": source.kind, **source.about},
        "people": people_of(found.pose, source.fps, config.scene.radar),
        "camera": camera_row(found.camera),
        "radar_ahead_of_camera_m": round(found.radar_ahead_m, 3),
        "background_px_s": None if found.background_px_s is None else round(found.background_px_s, 1),
        "frames": found.pose.valid.shape[2],
        "fps": source.fps,
        "seed": config.seed,
        "realised_snr_db": round(snr_db, 3) if math.isfinite(snr_db) else None,
        **{part: document["scene"][part] for part in ("radar", "wall", "floor")},
        "config": document,
    }


def label_of(
    recognizer: ActivityRecognizer | None, maps: RadarMaps, duration_s: float, least_probability: float = 0.0
) -> dict[str, Any]:
    """What ``summary.json`` says about the activity.

    ``timeline`` has the label of each window of four seconds; ``label`` and ``probabilities`` are for the whole scene,
    see :func:`~tensorsim.recognition.timeline.scene_probabilities`. All are None without a recognizer.

    Args:
        recognizer: made for the radar of the maps.
        maps: without batch dimensions.
        duration_s: duration of the scene.
        least_probability: below this the label is "not sure".
    """
    if recognizer is None:
        return {"label": None, "probabilities": None, "timeline": None}
    windows = label_windows(recognizer, maps, duration_s, least_probability=least_probability)
    means = scene_probabilities(windows)
    best = int(means.argmax())
    sure = float(means[best]) >= least_probability
    return {
        "label": recognizer.class_names[best] if sure else NOT_SURE,
        "probabilities": {
            name: round(p, 4) for name, p in zip(recognizer.class_names, means.tolist(), strict=True)
        },
        "timeline": [
            {
                "start_s": round(window.start_s, 3),
                "end_s": round(window.end_s, 3),
                "label": window.label,
                "probability": round(max(window.probabilities), 4),
            }
            for window in windows
        ],
    }


def write_summary(folder: Path, summary: dict[str, Any]) -> None:
    """Write ``summary.json``: strict JSON, with a run id and the names of the files of this run."""
    files = sorted({file.name for file in folder.iterdir()} | {"summary.json"})
    write_json(folder / "summary.json", summary | {"run": uuid.uuid4().hex, "files": files})
