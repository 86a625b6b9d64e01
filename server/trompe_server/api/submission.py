"""Checks of a submitted job: its objects and networks must exist and fit together."""

from trompe_server.api.services import Services
from trompe_server.errors import ConflictError
from trompe_server.judgement.suites import suite_of
from trompe_server.library import Library
from trompe_server.spec.checks import (
    check_gradients,
    check_indices,
    check_keep,
    check_mask_size,
    check_members,
    check_same_classes,
    check_target,
    check_top_k,
)
from trompe_server.spec.labels import resolve_label, resolve_labels
from trompe_shared.api import (
    ADVERSARIAL,
    JOB_RESULT,
    BackgroundInfo,
    ClassifierInfo,
    JobRequest,
    JobSpec,
    JudgementRequest,
    ObjectInfo,
)
from trompe_shared.colours import colour_of
from trompe_shared.errors import SpecError
from trompe_shared.object3d import decode_rgb


def checked_spec(spec: JobRequest, library: Library) -> tuple[JobRequest, dict[str, str]]:
    """``spec`` with ids in place of names, and the names of uploads by id.

    Raises ``NotFoundError``, ``AmbiguousError``, ``LabelError``, ``ClassifierError`` or ``SpecError``.
    """
    obj = library.objects.find(spec.object)
    classifier = library.classifier(spec.victim.classifier)
    _check_goal(spec, classifier)
    check_gradients(spec, classifier.name, white_box=classifier.white_box)
    _check_paint(spec, obj)
    members = [library.classifier(name) for name in spec.victim.ensemble]
    check_members([(member.name, member.white_box) for member in members])
    check_same_classes([classifier, *members])
    judges = [library.classifier(judge) for judge in spec.judges.networks]
    check_indices(spec.goal.label, classifier, judges)
    for other in (*members, *judges):
        resolve_labels(spec.goal.label, other.classes or classifier.classes, other.n_classes, other.name)
    victim = {"classifier": classifier.reference, "ensemble": [member.reference for member in members]}
    masks = {texture: _mask(texture, picture, obj, library) for texture, picture in spec.paint.masks.items()}
    pictures = {name: library.backgrounds.find(name) for name in spec.views.background if colour_of(name) is None}
    background = [pictures[name].id if name in pictures else name for name in spec.views.background]
    stored: list[ObjectInfo | ClassifierInfo] = [obj, classifier, *members, *judges]
    names = {one.id: one.name for one in stored if not one.shipped}
    names |= {picture.id: picture.name for picture in (*masks.values(), *pictures.values())}
    checked = spec.model_copy(
        update={
            "object": obj.reference,
            "victim": spec.victim.model_copy(update=victim),
            "judges": spec.judges.model_copy(update={"networks": [judge.reference for judge in judges]}),
            "paint": spec.paint.model_copy(update={"masks": {name: mask.id for name, mask in masks.items()}}),
            "views": spec.views.model_copy(update={"background": background}),
        }
    )
    return checked, names


def checked_judgement(spec: JudgementRequest, services: Services) -> tuple[JudgementRequest, dict[str, str]]:
    """``spec`` with ids in place of names, and the names of uploads by id.

    The result of a job is stored as an object: deleting the job changes no judgement. Raises ``NotFoundError``,
    ``AmbiguousError``, ``ConflictError``, ``ClassifierError``, or ``SpecError`` for an unknown suite.
    """
    suite_of(spec, renderer="")
    before, after = (_judged(reference, services) for reference in (spec.before, spec.after))
    networks = [services.library.classifier(name) for name in spec.networks]
    stored: list[ObjectInfo | ClassifierInfo] = [before, after, *networks]
    update = {
        "before": before.reference,
        "after": after.reference,
        "networks": [network.reference for network in networks],
    }
    return spec.model_copy(update=update), {one.id: one.name for one in stored if not one.shipped}


def _judged(reference: str, services: Services) -> ObjectInfo:
    """A stored object, or the painted object of a job, which is stored. Raises ``ConflictError`` without one."""
    if not reference.startswith(JOB_RESULT):
        return services.library.objects.find(reference)
    job = services.store.get(reference.removeprefix(JOB_RESULT))
    name = next((each for each in job.artifacts if each.endswith(f"{ADVERSARIAL}.zip")), None)
    if name is None:
        raise ConflictError(f"Job {job.id} is {job.state} and has no painted object to judge.")
    with services.artifacts(job.id).open(name) as painted:
        return services.library.add_object(painted, name)


def _check_goal(spec: JobSpec, classifier: ClassifierInfo) -> None:
    """Raise ``LabelError`` for unknown classes, ``SpecError`` for a contradictory goal."""
    goal, known = spec.goal, (classifier.classes, classifier.n_classes, classifier.name)
    labels = resolve_labels(goal.label, *known)
    check_target(labels, None if goal.target is None else resolve_label(goal.target, *known))
    check_top_k(goal.top_k, classifier.n_classes - len(labels))


def _check_paint(spec: JobSpec, obj: ObjectInfo) -> None:
    unknown = sorted(set(spec.paint.materials) - set(obj.materials))
    if unknown:
        raise SpecError(f"{obj.name!r} has no material {unknown}; it has {obj.materials}.")
    check_keep(spec.paint.keep, n_texels=sum(height * width for height, width in obj.textures.values()))
    unknown = sorted(set(spec.paint.masks) - set(obj.textures))
    if unknown:
        raise SpecError(f"{obj.name!r} has no texture {unknown} to mask; it has {sorted(obj.textures)}.")


def _mask(texture: str, picture: str, obj: ObjectInfo, library: Library) -> BackgroundInfo:
    """A mask picture. Raises ``SpecError`` unless it has the texture's size."""
    info = library.backgrounds.find(picture)
    pixels = decode_rgb(library.backgrounds.read(info), picture)
    check_mask_size(texture, size=obj.textures[texture], mask=pixels.shape[:2])
    return info
