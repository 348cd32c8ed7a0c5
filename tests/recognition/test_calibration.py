"""Calibration: the temperature that labels were drawn with is found, and the error is that of a plain NumPy count."""

import itertools

import numpy as np
import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.recognition.calibration import expected_calibration_error, fit_temperature, reliability


@pytest.mark.parametrize("true", [0.5, 1.0, 2.5])
def test_the_temperature_of_drawn_labels_is_found(true):
    generator = torch.Generator().manual_seed(0)
    logits = 3 * torch.randn(8000, 5, generator=generator)
    labels = torch.multinomial((logits / true).softmax(-1), 1, generator=generator)[:, 0]
    assert fit_temperature(logits, labels) == pytest.approx(true, rel=0.05)


def test_the_error_equals_a_count_in_numpy():
    generator = torch.Generator().manual_seed(1)
    probabilities = torch.randn(500, 4, generator=generator, dtype=torch.float64).softmax(-1)
    labels = torch.randint(4, (500,), generator=generator)
    confidence, right = probabilities.max(-1).values.numpy(), (probabilities.argmax(-1) == labels).numpy()
    expected = 0.0
    edges = np.linspace(0, 1, 11)
    for low, high in itertools.pairwise(edges):
        inside = (confidence >= low) & (confidence < high)
        if inside.any():
            expected += abs(confidence[inside].mean() - right[inside].mean()) * inside.mean()
    assert expected_calibration_error(probabilities, labels) == pytest.approx(expected, abs=1e-9)


def test_sure_and_right_has_no_error_and_sure_and_wrong_has_all():
    sure = torch.eye(3, dtype=torch.float64)
    assert expected_calibration_error(sure, torch.arange(3)) == 0.0
    assert expected_calibration_error(sure, (torch.arange(3) + 1) % 3) == 1.0


@pytest.mark.parametrize(
    ("logits", "labels", "message"),
    [
        (torch.zeros(0, 3), torch.zeros(0, dtype=torch.int64), "N at least 1"),
        (torch.zeros(4, 3), torch.zeros(3, dtype=torch.int64), r"got shapes \[4, 3\] and \[3\]"),
        (torch.full((2, 3), torch.nan), torch.zeros(2, dtype=torch.int64), "logits: "),
        (
            torch.zeros(2, 3),
            torch.tensor([0, 3]),
            "labels: got torch.int64 from 0 to 3, expected int64 from 0 to 2",
        ),
        (torch.zeros(2, 3), torch.tensor([-1, 0]), "labels: got torch.int64 from -1 to 0"),
        (torch.zeros(2, 3), torch.tensor([0.0, 1.0]), "labels: got torch.float32"),
    ],
)
def test_refuses_what_cannot_be_calibrated(logits, labels, message):
    with pytest.raises(TensorsimError, match=message):
        fit_temperature(logits, labels)


@pytest.mark.parametrize("wrong", [-0.1, 1.5])
def test_refuses_what_is_no_probability(wrong):
    with pytest.raises(TensorsimError, match=r"probabilities: got .* expected 0 to 1"):
        expected_calibration_error(torch.tensor([[0.5, wrong]]), torch.tensor([0]))


def test_bins_by_hand():
    probabilities = torch.tensor([[0.95, 0.05], [0.05, 0.95], [0.35, 0.65]], dtype=torch.float64)
    found = reliability(probabilities, torch.tensor([0, 0, 1]))
    assert found.samples.tolist() == [0, 0, 0, 0, 0, 0, 1, 0, 0, 2]
    assert found.confidence[6:].tolist() == pytest.approx([0.65, 0, 0, 0.95])
    assert found.accuracy[6:].tolist() == [1.0, 0.0, 0.0, 0.5]


def test_refuses_no_bins():
    with pytest.raises(TensorsimError, match="bins: got 0"):
        expected_calibration_error(torch.ones(1, 2) / 2, torch.zeros(1, dtype=torch.int64), bins=0)
