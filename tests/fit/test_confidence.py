"""The confidence of poses: what it depends on, and that it falls where a pose is in doubt."""

from __future__ import annotations

import json
import math

import pytest
import torch
from brackets import START, bracket, camera, picture
from quiet_fits import quiet

from edgegrad.fit import fit_pose
from edgegrad.fit.pose.confidence import FEATURES, confidence_of, features_of
from edgegrad.fit.pose.likelihood.support import Evidence
from edgegrad.fit.pose.result import PoseFit
from edgegrad.fit.pose.uncertainty import Uncertainty

SURE = Evidence(edges=0.95, visible=1.0, nats=0.8, across=120.0)


def known(deviation: float) -> Uncertainty:
    return Uncertainty(deviation**2 * torch.eye(6, dtype=torch.float64), 1.0, torch.empty(0, 3), 0.0, 5.0)


def confidence(evidence: Evidence, deviation: float = 0.003, best: float = 1.0) -> float:
    return confidence_of(features_of(evidence, best, known(deviation)))


def test_doubt_lowers_confidence() -> None:
    sure = confidence(SURE)
    assert sure > 0.9
    for less in (
        confidence(SURE._replace(edges=0.4)), confidence(SURE, deviation=0.05), confidence(SURE, best=0.6)
    ):  # fmt: skip
        assert less < sure - 0.05


def test_a_fit_says_how_sure_it_is() -> None:
    """It does of a picture that shows the object, of one that shows something else, and once it is read from JSON."""
    said: list[float] = []
    view = camera(32)
    image = picture(view)
    options = quiet(max_size=32, callback=lambda fit: said.append(fit.confidence))
    fit = fit_pose(bracket(), image, view, init=START, search=False, options=options)
    assert said and all(map(math.isnan, said)) and fit.converged  # before the answer
    assert set(fit.features) == set(FEATURES)
    assert PoseFit.from_json(fit.to_json()).confidence == fit.confidence
    data = json.loads(fit.to_json())
    for wrong in ([1.0], {"support": 1.0}):
        with pytest.raises(ValueError, match=r"PoseFit\.to_json"):
            PoseFit.from_json(json.dumps({**data, "features": wrong}))
    mirrored = fit_pose(bracket(), image.flip(1), view, init=START, search=False, options=quiet(max_size=32))
    assert mirrored.confidence < fit.confidence
