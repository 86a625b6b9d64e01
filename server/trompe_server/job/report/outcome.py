"""What the object became: the classes of the fooled views."""

from collections.abc import Sequence
from typing import Final

from trompe_server.job.report.data import ReportData
from trompe_server.judging.metrics import fooled_as
from trompe_shared.api import Accuracy, FooledAs

NAMED: Final = 5
"""Neighbours named in the warning."""


def classes_of_fooled(data: ReportData) -> list[FooledAs]:
    """The classes of the views recognised before the attack and not after, the most frequent first."""
    setup, after = data.setup, data.logits_after
    if after is None:
        return []
    own, held_out = (
        fooled_as(data.logits_before[views], after[views], setup.labels) if len(after[views]) else {}
        for views in ("own", "held_out")
    )
    found = [
        FooledAs(
            label=label,
            name=setup.judge.class_name(label) if setup.classifier.classes else None,
            own=own.get(label, 0),
            held_out=held_out.get(label, 0),
            neighbour=label in (setup.judge.near or ()),
        )
        for label in {**own, **held_out}
    ]
    return sorted(found, key=lambda each: (-each.own - each.held_out, each.label))


def neighbour_warning(found: Sequence[FooledAs], target: Accuracy, held_out: Accuracy | None) -> str | None:
    """Warning that held-out views, or else own ones, became neighbours of the object's class; ``None`` if none did."""
    for views, judged in (("held_out", held_out), ("own", target)):
        near = [each for each in found if each.neighbour and getattr(each, views)]
        if not near or judged is None or judged.a_drop is None or judged.a_drop_with_neighbours is None:
            continue
        everything, part = (sum(getattr(each, views) for each in some) for some in (found, near))
        names = [(each.name or "").split(",")[0] for each in near]
        named = ", ".join(names[:NAMED] + (["..."] if len(names) > NAMED else []))
        return (
            f"Of {everything} fooled {views.replace('_', '-')} views, {part} became a neighbour of the object's class "
            f"({named}): A_drop is {judged.a_drop:.2f}, or {judged.a_drop_with_neighbours:.2f} if all neighbours count "
            "as the object. If such a class is right too, give it as one more label."
        )
    return None
