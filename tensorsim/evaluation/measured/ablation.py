"""What each effect of a simulation is worth: training without it on simulation alone, tests on measured clips."""

from functools import partial
from typing import Any

from tensorsim.evaluation.measured.report import accuracy, subset_accuracy
from tensorsim.evaluation.measured.run import Experiment
from tensorsim.experiments.work import Work

#: For each training, the accuracy over all classes and over the subset of classes.
Accuracies = list[list[float]]


def ablation(experiment: Experiment, repeats: int) -> dict[str, Accuracies]:
    """Accuracies with the full simulation ("") and without each effect in turn.

    Results of every training are kept in ``out/results``; a later run with the same settings and test clips does not
    repeat it.

    Args:
        experiment: one set, its folders and settings.
        repeats: trainings for each simulation, with consecutive seeds from that of the experiment.
    """
    measured, labels = experiment.measured, experiment.test_labels
    subset = [measured.classes.index(name) for name in measured.subset]
    work, tested = Work(experiment.out), experiment.tested

    def accuracies(effect: str, seed: int) -> dict[str, Any]:
        logits = experiment.simulation_alone(seed, effect or None)
        return {"accuracies": [accuracy(logits, labels), subset_accuracy(logits, labels, subset)]}

    rows: dict[str, Accuracies] = {}
    for effect in ("", *measured.effect_names):
        rows[effect] = []
        for seed in range(experiment.seed, experiment.seed + repeats):
            settings = [effect, seed, experiment.clips, experiment.steps, tested]
            make = partial(accuracies, effect, seed)
            kept = work.kept(f"{measured.name}-{effect or 'whole'}", settings, make)
            rows[effect].append(kept["accuracies"])
    return rows


def ablation_table(experiment: Experiment, rows: dict[str, Accuracies]) -> str:
    """Markdown: mean accuracy, lowest and highest in brackets, and the loss of the mean without each effect."""
    measured = experiment.measured
    head = (
        f"{measured.name}: simulation without",
        "all classes",
        "lost, points",
        ", ".join(measured.subset),
        "lost",
    )
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    whole = [sum(values) / len(values) for values in zip(*rows[""], strict=True)]
    for effect, pairs in rows.items():
        cells = [effect or "(nothing left out)"]
        for values, reference in zip(zip(*pairs, strict=True), whole, strict=True):
            mean = sum(values) / len(values)
            spread = f" ({100 * min(values):.1f} to {100 * max(values):.1f})" if len(values) > 1 else ""
            cells += [f"{100 * mean:.1f} %{spread}", f"{100 * (reference - mean):+.1f}" if effect else ""]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
