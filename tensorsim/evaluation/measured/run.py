"""The experiments: simulation alone, with a few measured clips, with all of them, and baselines."""

import copy
from pathlib import Path

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.sets import MeasuredSet
from tensorsim.evaluation.measured.training import Augment, fit_pictures, predict, square
from tensorsim.files import sha256_of_arrays
from tensorsim.recognition.diat_radharnet import DIATRadHARNet
from tensorsim.weights import save_weights

#: Training settings in the order of the tables.
SETTINGS = ("simulation_only", "ten_shot", "ten_shot_alone", "all", "lda")
#: Measured clips of each class in ``ten_shot``.
SHOTS = 10
#: Height and width of the pictures that the network sees.
SIZE = 32
#: Share of each class used for training if no separate test folder is given.
LEARNED = 0.7


def few(labels: Tensor, shots: int) -> Tensor:
    """Indices of ``shots`` clips of each class, evenly spread over the order of the files."""
    chosen = []
    for label in labels.unique():
        places = torch.nonzero(labels == label)[:, 0]
        steps = torch.linspace(0, len(places) - 1, min(shots, len(places)))
        chosen.append(places[steps.round().long()])
    return torch.cat(chosen)


def split(labels: Tensor) -> tuple[Tensor, Tensor]:
    """Indices of the first 70 % of each class, in the order of the files, and of the others.

    Raises:
        TensorsimError: a class with fewer than two clips.
    """
    early, late = [], []
    for label in labels.unique():
        places = torch.nonzero(labels == label)[:, 0]
        if len(places) < 2:
            raise TensorsimError(
                f"class {int(label)}: got one clip, expected at least two to keep some for the test"
            )
        count = min(max(round(LEARNED * len(places)), 1), len(places) - 1)
        early.append(places[:count])
        late.append(places[count:])
    return torch.cat(early), torch.cat(late)


def lda_logits(train: Tensor, labels: Tensor, test: Tensor, classes: int) -> Tensor:
    """Log-probabilities (N, classes) of scikit-learn's LDA with shrinkage on pictures of half the height and width."""
    try:
        from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    except ImportError as error:
        raise TensorsimError(
            f'LDA: scikit-learn cannot be imported ({error}); install it with: pip install "tensorsim[train]"'
        ) from error
    features = [torch.nn.functional.avg_pool2d(x, 2).flatten(1).double().numpy() for x in (train, test)]
    model = LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto").fit(features[0], labels.numpy())
    logits = torch.full((len(test), classes), -100.0)
    logits[:, torch.as_tensor(model.classes_)] = torch.from_numpy(
        model.predict_log_proba(features[1]).clip(min=-100.0)
    ).float()
    return logits


class Experiment:
    """All settings of one measured set.

    Args:
        measured: the set.
        train: folder of measured sets.
        test: another folder; None keeps the last 30 % of each class of ``train``, in file order, for the test.
        out: folder for the weights trained on simulation alone.
        clips: simulated clips of each class.
        steps: batches of 64 for training on simulation; half as many for a few measured clips, twice as many for all.
        seed: seed of simulation and training.
        quiet: no progress bar.
    """

    def __init__(
        self,
        measured: MeasuredSet,
        train: Path,
        test: Path | None,
        out: Path,
        clips: int = 300,
        steps: int = 600,
        seed: int = 0,
        quiet: bool = False,
    ) -> None:
        self.measured, self.out = measured, out
        self.clips, self.steps, self.seed, self.quiet = clips, steps, seed, quiet
        self.train, self.train_labels = measured.load(train)
        if test is None:
            early, late = split(self.train_labels)
            self.test, self.test_labels = self.train[late], self.train_labels[late]
            self.train, self.train_labels = self.train[early], self.train_labels[early]
        else:
            self.test, self.test_labels = measured.load(test)

    @property
    def tested(self) -> str:
        """Digest of the test clips and their labels."""
        return sha256_of_arrays(self.test.numpy(), self.test_labels.numpy())

    def quick(self) -> dict[str, Tensor]:
        """Logits (N, classes) of the test clips by the shipped weights."""
        net = DIATRadHARNet.from_pretrained(self.measured.weights)
        return {"simulation_only": self._tested(net)}

    def check_full(self) -> None:
        """Refuse sets that :meth:`full` cannot be trained or tested on.

        Raises:
            TensorsimError: training clips of a single class, or the same clips for training and test.
        """
        if len(self.train_labels.unique()) < 2:
            raise TensorsimError(
                f"{self.measured.name}: got clips of one class to train on, expected at least two classes"
            )
        if torch.equal(self.train, self.test) and torch.equal(self.train_labels, self.test_labels):
            raise TensorsimError(
                f"{self.measured.name}: got the same clips to train on and to test on, expected different ones; "
                "without a test folder, the last 30 % of each class are kept for the test"
            )

    def full(self) -> dict[str, Tensor]:
        """Logits (N, classes) of the test clips in each of ``SETTINGS``.

        Raises:
            TensorsimError: see :meth:`check_full`.
        """
        self.check_full()
        simulated, labels = self.measured.simulate(self.clips, self.seed, self.quiet)
        net = self._simulation_trained(simulated, labels, self.seed)
        path = self.out / f"{self.measured.weights.replace('-', '_')}.safetensors"
        save_weights(
            net, path, {"trained_on": "simulation alone", "classes": ",".join(self.measured.classes)}
        )
        chosen = few(self.train_labels, SHOTS)
        everything = torch.arange(len(self.train_labels))
        logits = {"simulation_only": self._tested(net)}
        logits["ten_shot"] = self._measured_logits(net, chosen, self.steps // 2, 1e-3)
        logits["ten_shot_alone"] = self._measured_logits(
            self._new(self.train[chosen], self.seed), chosen, self.steps // 2, 3e-3
        )
        logits["all"] = self._measured_logits(net, everything, 2 * self.steps, 5e-3)
        logits["lda"] = lda_logits(self.train, self.train_labels, self.test, len(self.measured.classes))
        return logits

    def simulation_alone(self, seed: int, without: str | None = None) -> Tensor:
        """Logits (N, classes) of the test clips after training on simulation alone, optionally without one effect."""
        simulated, labels = self.measured.simulate(self.clips, seed, self.quiet, without)
        return self._tested(self._simulation_trained(simulated, labels, seed))

    def _new(self, pictures: Tensor, seed: int) -> DIATRadHARNet:
        """A network with random weights that subtracts the mean of these pictures."""
        torch.manual_seed(seed)
        net = DIATRadHARNet(len(self.measured.classes))
        net.mean.fill_(float(pictures.float().mean()))
        return net

    def _simulation_trained(self, simulated: Tensor, labels: Tensor, seed: int) -> DIATRadHARNet:
        net = self._new(simulated, seed)
        fit_pictures(
            net,
            simulated,
            labels,
            steps=self.steps,
            augment=_seen(self.measured.augment),
            seed=seed,
            quiet=self.quiet,
        )
        return net

    def _measured_logits(
        self, net: DIATRadHARNet, chosen: Tensor, steps: int, learning_rate: float
    ) -> Tensor:
        """Logits (N, classes) of the test clips by a copy of ``net`` trained further on the chosen training clips."""
        learner = copy.deepcopy(net)
        fit_pictures(
            learner, self.train[chosen], self.train_labels[chosen], steps=steps,
            augment=_seen(self.measured.augment_measured), learning_rate=learning_rate, seed=self.seed,
            quiet=self.quiet,
        )  # fmt: skip
        return self._tested(learner)

    def _tested(self, net: DIATRadHARNet) -> Tensor:
        """Logits (N, classes) of the test clips."""
        return predict(net, square(self.test, SIZE))


def _seen(augment: Augment) -> Augment:
    """The same augmentation, followed by resizing to the network's input size."""
    return lambda pictures, generator: square(augment(pictures, generator), SIZE)
