"""Detection scores against scikit-learn and against what is plain."""

import math

import pytest
import torch
from sklearn.metrics import average_precision_score, precision_score, recall_score

from wearcap.metrics.detection import average_precision, calibration_error, detection_scores, mean_detection_scores


@pytest.mark.parametrize("levels", [None, 5], ids=["distinct", "ties"])
def test_scores_are_scikit_learns(levels):
    random = torch.Generator().manual_seed(0)
    prob = torch.rand(500, generator=random)
    prob = prob if levels is None else (prob * levels).round() / levels
    truth = torch.rand(500, generator=random) < prob
    found = detection_scores(prob, truth)
    assert found.average_precision == pytest.approx(average_precision_score(truth, prob), abs=1e-9)
    assert found.precision == pytest.approx(precision_score(truth, prob > 0.5))
    assert found.recall == pytest.approx(recall_score(truth, prob > 0.5))
    assert found.accuracy == pytest.approx(((prob > 0.5) == truth).float().mean().item())
    # With an error of bins alone, and a planted one.
    assert found.calibration_error < 0.12
    assert calibration_error(torch.full((100,), 0.9), torch.arange(100) < 60) == pytest.approx(0.3, abs=1e-6)


def test_what_is_not_defined_is_nan_and_left_out_of_the_hands_mean():
    prob, none = torch.tensor([0.2, 0.4]), torch.zeros(2, dtype=torch.bool)
    assert math.isnan(average_precision(prob, none))
    assert math.isnan(detection_scores(prob, none).recall)
    assert math.isnan(average_precision(prob[:0], none[:0]))
    both = torch.stack([none, torch.tensor([False, True])], -1)
    assert mean_detection_scores(prob[:, None].expand(-1, 2), both).average_precision == 1.0
