"""Suites: what a judgement looks at, fixed by name, so that figures of different groups can be compared.

A suite never changes. Other views, networks, renderers or image pipelines make a new one (``standard-2``).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from trompe_shared.api import JudgementSpec
from trompe_shared.errors import SpecError

VIEWS: Final = 60
"""Default number of views, as many as a job's held-out ones."""

NETWORK: Final = "tiny"
"""Default network."""


@dataclass(frozen=True)
class Suite:
    """views: random ones, drawn from ``seed``. networks: by name. image_size: (H, W) of the rendered images; ``None``:
    as the first network takes them.

    The image pipelines are those that judge every result (``image_pipelines.SUITE``).
    """

    views: int
    seed: int
    image_size: tuple[int, int] | None
    renderers: tuple[str, ...]
    networks: tuple[str, ...]


SUITES: Final[Mapping[str, Suite]] = {
    "standard-1": Suite(
        views=100,
        seed=20261123,
        image_size=(224, 224),
        renderers=("pyrender", "three"),
        networks=(
            "tiny",
            "torchvision:mobilenet_v2",
            "torchvision:inception_v3",
            "torchvision:resnet50",
            "torchvision:vit_b_16",
        ),
    )
}


def suite_of(spec: JudgementSpec, *, renderer: str) -> Suite:
    """What a judgement looks at: a suite with the networks and renderers of ``spec`` on top, or these alone.

    renderer: the default one. Raises ``SpecError`` for an unknown suite.
    """
    if spec.suite is None:
        views = VIEWS if spec.views is None else spec.views
        asked, networks = (tuple(dict.fromkeys(names)) for names in (spec.renderers, spec.networks))
        return Suite(views, spec.seed or 0, None, asked or (renderer,), networks or (NETWORK,))
    if spec.suite not in SUITES:
        raise SpecError(f"There is no suite {spec.suite!r}; choose {', '.join(SUITES)}.")
    suite = SUITES[spec.suite]
    return replace(
        suite,
        networks=tuple(dict.fromkeys((*suite.networks, *spec.networks))),
        renderers=tuple(dict.fromkeys((*suite.renderers, *spec.renderers))),
    )
