"""Verification of a manifest: its views are those of its seed, its files those it names, its figures follow from its
predictions, and random views, rendered again, get the same classes.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trompe_server.judgement.judge_files import noisy, sampled
from trompe_server.judgement.manifest import view_of, view_record
from trompe_server.judgement.sources import JudgedObject, LocalSources, Sources, network_file
from trompe_server.judgement.suites import SUITES
from trompe_server.judging.judge import Judge
from trompe_server.judging.metrics import margins
from trompe_server.spec.framing import Framing
from trompe_shared.api import JudgedRenderer, Manifest, Predictions
from trompe_shared.errors import ClassifierError, LabelError, ObjectError, RendererError
from trompe_shared.shipped import shipped_objects

VIEWS_AGAIN: Final = 20
"""Views that are rendered again."""


def verify(manifest: Manifest, folder: Path, *, generator: np.random.Generator) -> Iterator[str]:
    """The faults of a manifest that lies in ``folder``, each in a sentence.

    generator: draws the views that are rendered again, at most ``VIEWS_AGAIN``.
    """
    yield from _views(manifest)
    yield from _figures(manifest)
    sources = LocalSources(folder)
    objects, judges = dict[str, JudgedObject](), dict[str, Judge]()
    for kind, file in (("before", manifest.before), ("after", manifest.after)):
        try:
            objects[kind] = sources.object(_source(file.source, folder), kind)
        except ObjectError as error:
            yield f"The file {kind} cannot be read again: {error}"
        else:
            yield from _same_hash(file.source, file.sha256, objects[kind].file.sha256)
    for network in manifest.networks:
        if network.missing is not None:
            continue
        try:
            judges[network.name], found = sources.network(_source(network.reference, folder), network.labels)
        except (ClassifierError, LabelError) as error:
            yield f"The network {network.name!r} cannot be loaded again: {error}"
        else:
            yield from _same_hash(network.name, network.sha256, found.sha256)
    if len(objects) == 2:
        count = len(manifest.views)
        index = np.sort(generator.permutation(count)[:VIEWS_AGAIN])
        for renderer in manifest.renderers:
            if renderer.engine is not None:
                yield from _again(manifest, renderer, sources, objects, judges, index.tolist())


def _source(source: str, folder: Path) -> str:
    """A path of the manifest from here; a name as it is."""
    is_name = source in shipped_objects() or (network_file(source) is None and not (folder / source).exists())
    return source if is_name else str(folder / source)


def _same_hash(name: str, recorded: str | None, found: str | None) -> Iterator[str]:
    if recorded != found:
        yield f"{name} has changed: its sha256 is {str(found)[:16]}..., the manifest says {str(recorded)[:16]}..."


def _views(manifest: Manifest) -> Iterator[str]:
    """Views that are not the random ones of the seed, or not those of the suite."""
    anywhere, count = Framing((0.0, 0.0, 0.0), 1.0, (0.0, 0.0)), len(manifest.views)
    drawn = [view_record(view) for view in sampled(count, manifest.seed, anywhere, background="white")]
    free = {"distance", "elevation", "centre", "background"}
    if [view.model_dump(exclude=free) for view in drawn] != [view.model_dump(exclude=free) for view in manifest.views]:
        yield f"The views are not the random ones of seed {manifest.seed}."
    if manifest.suite is not None:
        wanted = SUITES.get(manifest.suite)
        if wanted is None or (wanted.views, wanted.seed, wanted.image_size) != (
            count,
            manifest.seed,
            manifest.image_size,
        ):
            yield f"The number of views, their seed or the size of the images is not that of {manifest.suite}."


def _figures(manifest: Manifest) -> Iterator[str]:
    """Cells of the images as rendered that do not follow from the classes of their views."""
    labels = {network.name: network.labels for network in manifest.networks}
    for each in manifest.predictions:
        accuracy = manifest.cell(each.renderer, each.network)
        if accuracy is None:
            yield f"{each.renderer}, {each.network}: the manifest has classes of views but no figures."
            continue
        shares = [float(np.isin(classes, labels[each.network]).mean()) for classes in (each.before, each.after)]
        if not np.allclose(shares, [accuracy.a_before, accuracy.a_after or 0.0], atol=1e-9):
            yield (
                f"{each.renderer}, {each.network}: by the classes of its views the object is recognised in "
                f"{shares[0]:.3f} before and {shares[1]:.3f} after, by the figures in {accuracy.a_before:.3f} and "
                f"{accuracy.a_after or 0.0:.3f}."
            )


def _again(
    manifest: Manifest,
    renderer: JudgedRenderer,
    sources: Sources,
    objects: Mapping[str, JudgedObject],
    judges: Mapping[str, Judge],
    index: Sequence[int],
) -> Iterator[str]:
    """Another engine, and views with another class, once the views ``index`` are rendered again."""
    try:
        with sources.running(renderer.name) as target:
            if target.engine != renderer.engine:
                yield f"The renderer here is {target.engine}, the manifest's {renderer.engine}."
            views = noisy([view_of(manifest.views[k]) for k in index], target.engine, manifest.seed)
            for kind, each in objects.items():
                images = target.render(each.obj, views, size=manifest.image_size)
                for recorded in manifest.predictions:
                    if recorded.renderer == renderer.name and recorded.network in judges:
                        yield from _classes(recorded, kind, judges[recorded.network], images, index)
    except RendererError as error:
        yield f"The renderer {renderer.name!r} cannot be asked again: {error}"


def _classes(
    recorded: Predictions, kind: str, judge: Judge, images: NDArray[np.uint8], index: Sequence[int]
) -> Iterator[str]:
    logits = judge.network.predict(images)
    classes, known = getattr(recorded, kind), getattr(recorded, f"{kind}_margins")
    now = zip(logits.argmax(axis=1).tolist(), margins(logits, judge.labels).tolist(), strict=True)
    for k, (found, margin) in zip(index, now, strict=True):
        if found != classes[k]:
            yield (
                f"View {k} {kind}, {recorded.network} in {recorded.renderer}: {judge.class_name(found)!r} with "
                f"margin {margin:+.2f}, the manifest says {judge.class_name(classes[k])!r} with {known[k]:+.2f}."
            )
