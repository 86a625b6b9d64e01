"""Which of the engines that answer draw the pictures of a job."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

from pydantic import TypeAdapter

from trompe_shared.api import JobSpec
from trompe_shared.engine import EngineInfo
from trompe_shared.errors import RendererError, SpecError


@dataclass(frozen=True)
class JobEngines:
    """The engines of a job's renderers: the attacked ones, and others that only judge."""

    attacked: tuple[EngineInfo, ...]
    judging: tuple[EngineInfo, ...] = ()

    @classmethod
    def of(cls, spec: JobSpec, there: Sequence[EngineInfo]) -> Self:
        """The engines that ``spec`` names among those ``there``; by default the first one, the service's own.

        Raises ``RendererError`` for a name that none has, ``SpecError`` for a name that several have and for a renderer
        that is attacked and judges.
        """
        attacked = [named(name, "renderers", there) for name in spec.views.renderers] or [there[0]]
        judging = [named(name, "judge_renderers", there) for name in spec.judges.renderers]
        for both in set(attacked) & set(judging):
            raise SpecError(
                f"`judge_renderers: {both}` is attacked and judges anyway. Name a renderer that is not attacked: "
                f"{listed(set(there) - set(attacked))}."
            )
        return cls(tuple(dict.fromkeys(attacked)), tuple(dict.fromkeys(judging)))

    @property
    def all(self) -> tuple[EngineInfo, ...]:
        """The attacked ones, then the others."""
        return (*self.attacked, *self.judging)


JOB_ENGINES: Final = TypeAdapter(JobEngines)
"""Their form as JSON."""


def named(name: str, option: str, there: Sequence[EngineInfo]) -> EngineInfo:
    """The engine called ``name``, by its name alone or in full. Raises ``RendererError``, or ``SpecError`` if several
    have the name."""
    found = [engine for engine in there if str(engine) == name] or [engine for engine in there if engine.name == name]
    if not found:
        raise RendererError(f"No renderer answers to `{option}: {name}`. There are: {listed(there)}.")
    if len(found) > 1:
        raise SpecError(f"`{option}: {name}` names several renderers; give one in full: {listed(found)}.")
    return found[0]


def listed(engines: Sequence[EngineInfo] | set[EngineInfo]) -> str:
    """Engines in words."""
    return "; ".join(sorted(map(str, engines))) or "none"
