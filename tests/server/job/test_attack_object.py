"""One attack without a service: random renderers, views of one's own, and none."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.job_runs import CHAIR, Recorder
from trompe_server import attack_object
from trompe_server.attack import ViewDistribution
from trompe_server.classifiers import NetworkClassifier
from trompe_server.renderers import SailenvTarget
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import ClassifierError, RendererError, SpecError

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


class Changed(Recorder):
    """A target whose images come as ``change`` makes them."""

    def __init__(self, change: Callable[[Any], Any]) -> None:
        super().__init__()
        object.__setattr__(self, "change", change)

    def render(self, *args: Any, **options: Any) -> Any:
        return self.change(super().render(*args, **options))  # type: ignore[attr-defined]


def test_it_says_whether_the_surrogate_knew_the_target(target: SailenvTarget) -> None:
    views = ViewDistribution(0.3, (10, 40)).sample(3, generator=np.random.default_rng(0))
    known = attack_object("mug", "tiny", label="mug", target=target, views=views, held_out=[], steps=1)
    assert known.fidelity.good_enough
    assert not attack_object(CHAIR, "tiny", target=Recorder(), **OPTIONS).fidelity.good_enough  # no renderer at all


def test_a_targets_images_may_lie_in_memory_as_they_like() -> None:
    plain, mirrored = (
        attack_object(CHAIR, "tiny", target=target, **OPTIONS)
        for target in (Recorder(), Changed(lambda images: np.ascontiguousarray(images[..., ::-1])[..., ::-1]))
    )
    assert plain.painted.to_zip() == mirrored.painted.to_zip()


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda images: images / 255, id="floats"),
        pytest.param(lambda images: images[..., 0], id="grey"),
        pytest.param(lambda images: images[..., [0, 1, 2, 0]], id="alpha"),
        pytest.param(lambda images: images[:-1], id="one less"),
    ],
)
def test_images_of_another_kind_are_refused_in_words(change: Callable[[Any], Any]) -> None:
    with pytest.raises(RendererError, match=r"The target gave images of shape .* expected \(5, "):
        attack_object(CHAIR, "tiny", target=Changed(change), **OPTIONS)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        pytest.param({"held_out": [replace(VIEWS[0], backdrop="sea")]}, "picture behind the object", id="backdrop"),
        pytest.param({"views": []}, "no `views` to attack: give at least one", id="views"),
        pytest.param({"views": 6}, "`views` must be a list of views, got 6", id="number of views"),
        pytest.param({"held_out": 6}, "`held_out` must be a list of views, got 6", id="number of held-out views"),
        pytest.param({"steps": 0}, "`steps` must be 1 or more, got 0", id="steps"),
        pytest.param({"image_pipeline": "strong"}, "'strong'; choose one of none, robust, transfer", id="pipeline"),
        pytest.param({"seed": -1}, "`seed` must be 0 or more, got -1", id="seed"),
    ],
)
def test_options_that_do_not_fit_are_refused_at_once(options: dict[str, Any], error: str) -> None:
    target = Recorder()
    with pytest.raises(SpecError, match=error):
        attack_object(CHAIR, "tiny", target=target, **OPTIONS | options)
    assert target.asked == []


def test_what_is_no_classifier_is_refused_at_once() -> None:
    target = Recorder()
    with pytest.raises(ClassifierError, match="A Conv2d is no classifier; wrap a torch module in NetworkClassifier"):
        attack_object(CHAIR, torch.nn.Conv2d(3, 8, 3), target=target, **OPTIONS)  # type: ignore[arg-type]
    assert target.asked == []


class Apart(torch.nn.Module):
    """Logits with a gradient, but in something else than the images, as of quantized layers."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(images), 8, requires_grad=True) + images.detach().mean()


def test_a_network_without_a_gradient_in_its_images_is_told() -> None:
    classifier = NetworkClassifier("int8", Apart().eval(), (64, 64), 8)
    with pytest.raises(ClassifierError, match="'int8' has no gradient: its logits do not depend on its images"):
        attack_object(CHAIR, classifier, target=Recorder(), **OPTIONS | {"label": 0})
