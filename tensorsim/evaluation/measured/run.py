"""The experiments: simulation alone, with a few measured clips, with all of them, and their rivals."""

import copy
from pathlib import Path

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.sets import MeasuredSet
from tensorsim.evaluation.measured.training import fit_pictures, predict
from tensorsim.recognition.picture_net import PictureNet
from tensorsim.weights import save_weights

#: What is trained on what, in the order of the tables.
SETTINGS = ("simulation_only", "ten_shot", "ten_shot_alone", "all", "lda")
#: Measured clips of each class in ``ten_shot``.
SHOTS = 10


def few(labels: Tensor, shots: int) -> Tensor:
    """Indices of ``shots`` clips of each class, evenly spread over the order of the files."""
    chosen = []
    for label in labels.unique():
        places = torch.nonzero(labels == label)[:, 0]
        steps = torch.linspace(0, len(places) - 1, min(shots, len(places)))
        chosen.append(places[steps.round().long()])
    return torch.cat(chosen)


def lda_logits(train: list[Tensor], labels: Tensor, test: list[Tensor], classes: int) -> Tensor:
    """Log-probabilities (N, classes) of scikit-learn's LDA with shrinkage on pictures of half the height and width.

    The pictures of all maps of a clip together are its features.
    """
    try:
        from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    except ImportError as error:
        raise TensorsimError(
            f"LDA: scikit-learn does not import ({error}); install tensorsim[train]"
        ) from error
    halved = [
        [torch.nn.functional.avg_pool2d(x, 2).flatten(1) for x in pictures] for pictures in (train, test)
    ]
    features = [torch.cat(parts, 1).double().numpy() for parts in halved]
    model = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(features[0], labels.numpy())
    logits = torch.full((len(test[0]), classes), -100.0)
    logits[:, torch.as_tensor(model.classes_)] = torch.from_numpy(
        model.predict_log_proba(features[1]).clip(min=-100.0)
    ).float()
    return logits


class Experiment:
    """All settings of one measured set.

    Args:
        measured: the set.
        train, test: folders of measured sets.
        out: where the weights trained on simulation alone go.
        clips: simulated clips of each class.
        steps: batches of 64 of the training on simulation; the others are shorter or as long.
        seed: of simulation and training.
        quiet: no progress bar.
    """

    def __init__(
        self,
        measured: MeasuredSet,
        train: Path,
        test: Path,
        out: Path,
        clips: int = 300,
        steps: int = 600,
        seed: int = 0,
        quiet: bool = False,
    ) -> None:
        self.measured, self.out = measured, out
        self.clips, self.steps, self.seed, self.quiet = clips, steps, seed, quiet
        self.train, self.train_labels = measured.load(train)
        self.test, self.test_labels = measured.load(test)
        self.train_beside, self.test_beside = measured.load_beside(train), measured.load_beside(test)

    def quick(self) -> dict[str, Tensor]:
        """Logits (N, classes) of the test clips by the shipped weights."""
        net = PictureNet.from_pretrained(self.measured.weights)
        return {"simulation_only": predict(net, self.test)}

    def full(self) -> dict[str, Tensor]:
        """Logits (N, classes) of the test clips in each of ``SETTINGS``."""
        simulated, labels = self.measured.simulate(self.clips, self.seed, self.quiet)
        net = self._fit(self._new(), simulated, labels, self.steps)
        path = self.out / f"{self.measured.weights.replace('-', '_')}.safetensors"
        save_weights(
            net, path, {"trained_on": "simulation alone", "classes": ",".join(self.measured.classes)}
        )
        chosen = few(self.train_labels, SHOTS)
        everything = torch.arange(len(self.train_labels))
        logits = {"simulation_only": predict(net, self.test)}
        logits["ten_shot"] = self._measured_logits(net, chosen, self.steps // 2)
        logits["ten_shot_alone"] = self._measured_logits(None, chosen, self.steps // 2)
        logits["all"] = self._measured_logits(net, everything, 3 * self.steps // 2)
        maps = [[x for x in pair if x is not None] for pair in self._maps()]
        logits["lda"] = lda_logits(maps[0], self.train_labels, maps[1], len(self.measured.classes))
        return logits

    def ablation(self) -> dict[str, Tensor]:
        """Logits (N, classes) of the test clips by simulation alone, whole and without each effect in turn."""
        logits = {}
        for effect in ("", *self.measured.effect_names):
            simulated, labels = self.measured.simulate(self.clips, self.seed, self.quiet, effect or None)
            logits[effect] = predict(self._fit(self._new(), simulated, labels, self.steps), self.test)
        return logits

    def _new(self) -> PictureNet:
        torch.manual_seed(self.seed)
        return PictureNet(len(self.measured.classes), self.train.shape[-2])

    def _fit(self, net: PictureNet, shown: Tensor, labels: Tensor, steps: int) -> PictureNet:
        fit_pictures(net, shown, labels, steps=steps, augment=self.measured.augment, seed=self.seed)
        return net

    def _maps(self) -> tuple[tuple[Tensor, Tensor | None], tuple[Tensor, Tensor | None]]:
        """Pictures of both maps, of train and of test."""
        return (self.train, self.train_beside), (self.test, self.test_beside)

    def _measured_logits(self, net: PictureNet | None, chosen: Tensor, steps: int) -> Tensor:
        """Log-probabilities (N, classes) of the test clips by networks that learned from chosen clips of train.

        A copy of ``net`` goes on at a third of the learning rate; None begins anew. Where the clips have another map,
        a second network learns that alone, and the log-probabilities of both are added.
        """
        labels = self.train_labels[chosen]
        learner = self._new() if net is None else copy.deepcopy(net)
        fit_pictures(
            learner, self.train[chosen], labels, steps=steps, augment=self.measured.augment_measured,
            learning_rate=3e-3 if net is None else 1e-3, seed=self.seed,
        )  # fmt: skip
        logits = predict(learner, self.test).log_softmax(-1)
        beside = self.measured.beside
        if beside is not None and self.train_beside is not None and self.test_beside is not None:
            torch.manual_seed(self.seed)
            second = PictureNet(len(self.measured.classes), self.train_beside.shape[-2])
            fit_pictures(
                second, self.train_beside[chosen], labels, steps=steps, augment=beside.augment, seed=self.seed
            )
            logits = logits + predict(second, self.test_beside).log_softmax(-1)
        return logits
