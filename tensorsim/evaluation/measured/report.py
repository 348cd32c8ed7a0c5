"""Figures, tables and files of the experiments on measured sets."""

import csv
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tensorsim.evaluation.measured.run import SETTINGS
from tensorsim.evaluation.measured.sets import MeasuredSet
from tensorsim.files import complete_file
from tensorsim.recognition.calibration import expected_calibration_error, reliability
from tensorsim.recognition.confusion import confusion


def accuracy(logits: Tensor, labels: Tensor) -> float:
    """Share of clips whose largest logit is that of their class."""
    return float((logits.argmax(-1) == labels).float().mean())


def subset_accuracy(logits: Tensor, labels: Tensor, subset: list[int]) -> float:
    """Accuracy on the clips of some classes, decided among these classes only; NaN without such clips."""
    of = torch.isin(labels, torch.tensor(subset))
    among = torch.full_like(logits, float("-inf"))
    among[:, subset] = logits[:, subset]
    return accuracy(among[of], labels[of])


def figures(measured: MeasuredSet, logits: dict[str, Tensor], labels: Tensor) -> dict[str, Any]:
    """The entry of a set in ``measured.json``; settings that were not run are null."""
    subset = [measured.classes.index(name) for name in measured.subset]
    part = subset_accuracy(logits["simulation_only"], labels, subset)
    scores = {name: accuracy(logits[name], labels) if name in logits else None for name in SETTINGS}
    return {
        "classes": len(measured.classes),
        "simulation_only": scores.pop("simulation_only"),
        "simulation_only_subset": {"classes": list(measured.subset), "accuracy": part},
        **scores,
    }


def table(results: dict[str, dict[str, Any]], errors: dict[str, float]) -> str:
    """Markdown: a row per set."""
    head = ("set", "classes", "simulation only", "of a part", "10 clips", "those alone", "all", "LDA", "ECE")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, row in results.items():
        cells = [row["simulation_only"], row["simulation_only_subset"]["accuracy"]]
        cells += [row[key] for key in SETTINGS[1:]]
        shown = ["-" if cell is None else f"{100 * cell:.1f} %" for cell in cells]
        lines.append("| " + " | ".join([name, str(row["classes"]), *shown, f"{errors[name]:.3f}"]) + " |")
    parts = [
        f"{name}: {', '.join(row['simulation_only_subset']['classes'])}" for name, row in results.items()
    ]
    lines += ["", "A part: decided among " + "; ".join(parts) + ".", "ECE: of simulation only."]
    return "\n".join(lines)


def write(out: Path, name: str, measured: MeasuredSet, logits: dict[str, Tensor], labels: Tensor) -> float:
    """Confusion matrices and calibration of a set as CSV; returns the calibration error of simulation alone.

    Matrices of settings that were not run are removed: they belong to an earlier run.
    """
    for setting in SETTINGS:
        if setting not in logits:
            (out / f"confusion_{name}_{setting}.csv").unlink(missing_ok=True)
    rows: list[list[Any]] = [["setting", "confidence_from", "clips", "confidence", "accuracy"]]
    first_error = 0.0
    for setting, values in logits.items():
        with (
            complete_file(out / f"confusion_{name}_{setting}.csv") as path,
            path.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(["true \\ found", *measured.classes])
            for cls, counts in zip(measured.classes, confusion(values, labels).tolist(), strict=True):
                writer.writerow([cls, *counts])
        probabilities = values.softmax(-1)
        error = expected_calibration_error(probabilities, labels)
        bins = torch.stack(reliability(probabilities, labels), dim=-1).tolist()
        if setting == "simulation_only":
            first_error = error
        rows += [[setting, k / len(bins), int(n), f"{c:.4f}", f"{a:.4f}"] for k, (n, c, a) in enumerate(bins)]
        rows.append([setting, "expected calibration error", len(labels), f"{error:.4f}", ""])
    with (
        complete_file(out / f"calibration_{name}.csv") as path,
        path.open("w", newline="", encoding="utf-8") as file,
    ):
        csv.writer(file).writerows(rows)
    return first_error
