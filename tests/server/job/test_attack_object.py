"""One attack without a service: random renderers, views of one's own, and none."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.job_runs import CHAIR, Recorder
from trompe_server import attack_object
from trompe_server.attack import ViewDistribution
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import SpecError

VIEWS = ViewDistribution(1.5, (0, 40)).sample(7, generator=np.random.default_rng(0))
OPTIONS: dict[str, Any] = {"label": "chair", "views": VIEWS[:5], "held_out": VIEWS[5:], "steps": 1}


def test_views_of_a_random_renderer_have_noise_numbers_and_the_noise_is_measured() -> None:
    target = Recorder()
    object.__setattr__(target, "engine", EngineInfo("random", "1", deterministic=False))
    attack_object(CHAIR, "tiny", target=target, **OPTIONS)
    asked = [[view.noise for view in views] for obj, views in target.asked if obj is CHAIR]
    (number,), (again,), (other,) = map(set, asked)
    assert again == number + 1
    assert len({0, number, other}) == 3


def test_held_out_views_are_not_needed() -> None:
    target = Recorder()
    attacked = attack_object(CHAIR, "tiny", target=target, **OPTIONS | {"held_out": []})
    assert attacked.held_out is None
    assert attacked.target.views == 5
    assert all(views for _, views in target.asked)
    assert {view.noise for _, views in target.asked for view in views} == {0}


def test_a_picture_behind_the_object_is_refused_at_once() -> None:
    target = Recorder()
    with pytest.raises(SpecError, match="picture behind the object"):
        attack_object(CHAIR, "tiny", target=target, **OPTIONS | {"held_out": [replace(VIEWS[0], backdrop="sea")]})
    assert target.asked == []


def test_an_attack_on_no_views_is_refused_at_once() -> None:
    target = Recorder()
    with pytest.raises(SpecError, match="no `views` to attack: give at least one"):
        attack_object(CHAIR, "tiny", target=target, **OPTIONS | {"views": []})
    assert target.asked == []
