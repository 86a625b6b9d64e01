"""Verification of a manifest against its files, its own figures, and random views rendered again.

From the manifest and its files follow: the views of a seed (except distance, elevation, centre and background), hashes,
labels and image sizes of networks, the contents of a suite, the change of each texture, all figures of the images as
rendered, the findings; and of the image pipelines' figures those that follow from ``a_before`` and ``a_after``.

The views rendered again must have the classes of the manifest. Through the image pipelines they must allow ``a_before``
and ``a_after``, and no change of theirs may be larger than ``max_view_change``.

Not checked: margins; of image pipelines the intervals of ``a_drop`` and the figures with neighbours; of the visibility
the averages over views; seconds and versions.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from trompe_server.judgement.judge_files import noisy, sampled
from trompe_server.judgement.manifest import PIPELINES, findings_of, of_pair, view_of, view_record, visibility_in
from trompe_server.judgement.sources import LocalSources, Sources, known_labels, network_file
from trompe_server.judgement.suites import SUITES
from trompe_server.judging.judge import Judge
from trompe_server.judging.metrics import accuracy, margins, recognised
from trompe_server.judging.objects import ObjectPair, texture_changes
from trompe_server.spec.framing import Framing
from trompe_shared.api import (
    AS_RENDERED,
    Accuracy,
    Cell,
    JudgedNetwork,
    JudgedRenderer,
    JudgementSpec,
    Manifest,
    Predictions,
    TextureChange,
    Visibility,
)
from trompe_shared.errors import ObjectError, RendererError, SpecError, TrompeError
from trompe_shared.object3d import Object3D
from trompe_shared.sailenv import MAX_SIDE
from trompe_shared.shipped import shipped_objects

VIEWS_AGAIN: Final = 20
"""Views that are rendered again."""

OF_SHARES: Final = ("views", "distinct", "a_before", "a_after", "a_drop", "a_before_interval", "a_after_interval")
"""Figures that follow from ``a_before`` and ``a_after``."""

OF_TEXTURES: Final = ("texels_altered", "mean_texel_change", "texture_variation")
"""Figures of the visibility that follow from the textures."""

TOLERANCE: Final = 0.02
"""By which other hardware may move the largest change of a view."""


def verify(
    manifest: Manifest, folder: Path, *, trusted: Collection[str] = (), generator: np.random.Generator
) -> Iterator[str]:
    """The faults of a manifest that lies in ``folder``, each in a sentence; of a malformed one those of its form alone.

    trusted: renderers ``module:Class`` or HOST:PORT that may be asked; a manifest of others could name code of theirs,
    or a host that gets the files. generator: draws the views that are rendered again, at most ``VIEWS_AGAIN``.
    """
    if malformed := list(_form(manifest)):
        yield from malformed
        return
    yield from _views(manifest)
    sources, objects, judges = LocalSources(folder), list[Object3D](), dict[str, Judge]()
    for kind, file in (("before", manifest.before), ("after", manifest.after)):
        try:
            found = sources.object(_source(file.source, folder), kind)
        except (ObjectError, OSError, ValueError) as error:
            yield f"The file {kind} cannot be read again: {error}"
        else:
            objects.append(found.obj)
            yield from _same_hash(file.source, file.sha256, found.file.sha256)
    for network in manifest.networks:
        if network.missing is None:
            yield from _network(manifest, network, sources, judges)
    if len(objects) == 2:
        pair = ObjectPair(*objects)
        yield from _textures_and_findings(manifest, pair)
        yield from _figures(manifest, pair, judges)
        index = np.sort(generator.permutation(len(manifest.views))[:VIEWS_AGAIN]).tolist()
        for renderer in manifest.renderers:
            if renderer.engine is None:
                continue
            if ":" in renderer.name and renderer.name not in trusted:
                yield (
                    f"The renderer {renderer.name!r} was not asked again: it is code or a host that the manifest "
                    "names. If you trust it, name it by --renderer."
                )
            else:
                yield from _again(manifest, renderer, sources, pair, judges, index)


def _form(manifest: Manifest) -> Iterator[str]:
    """What no judgement writes, and no other check could read."""
    count, seen = len(manifest.views), [each.name for each in manifest.renderers if each.engine is not None]
    loaded = [each.name for each in manifest.networks if each.missing is None]
    try:
        options = {"seed": manifest.seed, "epsilon": manifest.epsilon, "views": count}
        JudgementSpec.of("before", "after", label=manifest.label, **options)
    except SpecError as error:
        yield f"The manifest is malformed. {error}"
    if not all(np.isfinite(np.hstack([*view.model_dump().values()])).all() for view in manifest.views):
        yield "The manifest is malformed: a view has numbers that are not finite."
    if not all(0 < side <= MAX_SIDE for side in manifest.image_size):
        yield f"The manifest is malformed: image_size {manifest.image_size}; expected sides of 1 to {MAX_SIDE}."
    if not all(network.labels for network in manifest.networks if network.missing is None):
        yield "The manifest is malformed: a network has no labels."
    names = [[each.name for each in parts] for parts in (manifest.renderers, manifest.networks)]
    if any(len(set(each)) < len(each) for each in names):
        yield "The manifest is malformed: two of its renderers or networks have one name."
    if [(each.renderer, each.network, each.pipeline) for each in manifest.cells] != [*product(*names, PIPELINES)]:
        yield "The manifest is malformed: expected one cell for each renderer, network and image pipeline, in order."
    for cell in manifest.cells:
        shares = [] if cell.accuracy is None else [cell.accuracy.a_before, cell.accuracy.a_after]
        missing = cell.renderer not in seen or cell.network not in loaded
        if missing == bool(shares) or not all(share is not None and 0 <= share <= 1 for share in shares):
            yield f"{_name(cell)}: expected shares in 0..1, and none if the renderer or the network is missing."
    if [(each.renderer, each.network) for each in manifest.predictions] != [*product(seen, loaded)]:
        yield "The manifest is malformed: expected predictions for each renderer and network with figures, in order."
    for each in manifest.predictions:
        if {len(each.before), len(each.after), len(each.before_margins), len(each.after_margins)} != {count}:
            yield f"{each.renderer}, {each.network}: expected {count} classes and margins, before and after."


def _name(cell: Cell) -> str:
    return f"{cell.renderer}, {cell.network}, {cell.pipeline}"


def _source(source: str, folder: Path) -> str:
    """A path of the manifest from here; a name as it is."""
    is_name = source in shipped_objects() or (network_file(source) is None and not (folder / source).exists())
    return source if is_name else str(folder / source)


def _same_hash(name: str, recorded: str | None, found: str | None) -> Iterator[str]:
    if recorded != found:
        yield f"{name} has changed: its sha256 is {str(found)[:16]}..., the manifest says {str(recorded)[:16]}..."


def _differences(what: str, recorded: BaseModel, found: BaseModel, names: Iterable[str]) -> Iterator[str]:
    for name in names:
        said, true = (_rounded(getattr(each, name)) for each in (recorded, found))
        if said != true:
            yield f"{what}: {name} is {true}, the manifest says {said}."


def _rounded(value: Any) -> Any:
    """Floats to six digits: another processor may move the last ones."""
    if isinstance(value, tuple):
        return tuple(map(_rounded, value))
    return round(value, 6) if isinstance(value, float) else value


def _views(manifest: Manifest) -> Iterator[str]:
    """Views that are not the random ones of the seed, and what is not that of the suite."""
    anywhere, count = Framing((0.0, 0.0, 0.0), 1.0, (0.0, 0.0)), len(manifest.views)
    drawn = [view_record(view) for view in sampled(count, manifest.seed, anywhere, background="white")]
    free = {"distance", "elevation", "centre", "background"}
    if [view.model_dump(exclude=free) for view in drawn] != [view.model_dump(exclude=free) for view in manifest.views]:
        yield f"The views are not the random ones of seed {manifest.seed}."
    if manifest.suite is None:
        return
    wanted = SUITES.get(manifest.suite)
    if wanted is None or (wanted.views, wanted.seed, wanted.image_size) != (count, manifest.seed, manifest.image_size):
        yield f"The number of views, their seed or the size of the images is not that of {manifest.suite}."
        return
    looked_at = {each.reference for each in manifest.networks} | {each.name for each in manifest.renderers}
    for name in (*wanted.networks, *wanted.renderers):
        if name not in looked_at:
            yield f"The manifest lacks {name!r} of {manifest.suite}."


def _network(
    manifest: Manifest, network: JudgedNetwork, sources: LocalSources, judges: dict[str, Judge]
) -> Iterator[str]:
    """Load a network into ``judges``, unless the manifest has classes that it does not have."""
    try:
        judge, found = sources.network(_source(network.reference, sources.folder), network.labels)
        wanted = network.labels if judge.network.classes is None else known_labels(manifest.label, judge.network)
    except (TrompeError, OSError, ValueError) as error:
        yield f"The network {network.name!r} cannot be loaded again: {error}"
        return
    yield from _same_hash(network.name, network.sha256, found.sha256)
    found = found.model_copy(update={"labels": list(wanted)})
    yield from _differences(f"The network {network.name!r}", network, found, ("name", "image_size", "labels"))
    classes = {k for each in manifest.predictions if each.network == network.name for k in each.before + each.after}
    if classes <= {*range(judge.network.n_classes)}:
        judges[network.name] = judge
    else:
        yield f"{network.name!r} has {judge.network.n_classes} classes, the predictions have others."


def _textures_and_findings(manifest: Manifest, pair: ObjectPair) -> Iterator[str]:
    changes = {each.texture: each for each in texture_changes(*pair.textures, epsilon=manifest.epsilon)}
    if [*changes] != [each.texture for each in manifest.textures]:
        yield f"The textures that can be compared are {[*changes]}, the manifest has others."
    for each in manifest.textures:
        if each.texture in changes:
            what = f"The texture {each.texture!r}"
            yield from _differences(what, each, changes[each.texture], TextureChange.model_fields)
    found = [*findings_of(manifest, pair)]
    for finding in found:
        if finding not in manifest.findings:
            yield f"The manifest lacks a finding: {finding.text}"
    for finding in manifest.findings:
        if finding not in found:
            yield f"The manifest has a finding that does not hold: {finding.text}"


def _figures(manifest: Manifest, pair: ObjectPair, judges: Mapping[str, Judge]) -> Iterator[str]:
    """Figures that do not follow from the classes of the views, or from each other."""
    predictions, count = {(each.renderer, each.network): each for each in manifest.predictions}, len(manifest.views)
    for cell in manifest.cells:
        said, judge = cell.accuracy, judges.get(cell.network)
        if said is None or judge is None:
            continue
        if cell.pipeline == AS_RENDERED:
            seen, names = predictions[cell.renderer, cell.network], [*Accuracy.model_fields]
            one_hot = np.eye(judge.network.n_classes, dtype=np.float32)
            found = judge.accuracy(one_hot[seen.before], one_hot[seen.after])
        else:
            hits = [np.arange(count) < round((share or 0.0) * count) for share in (said.a_before, said.a_after)]
            before, after = (np.eye(2, dtype=np.float32)[each.astype(int)] for each in hits)
            found, names = accuracy(before, after, 1), [*OF_SHARES]
        yield from _differences(_name(cell), said, of_pair(found, pair), names)


def _again(
    manifest: Manifest,
    renderer: JudgedRenderer,
    sources: Sources,
    pair: ObjectPair,
    judges: Mapping[str, Judge],
    index: Sequence[int],
) -> Iterator[str]:
    """What the views ``index``, rendered again, do not confirm."""
    try:
        with sources.running(renderer.name) as target:
            engine = target.engine
            views = noisy([view_of(manifest.views[k]) for k in index], engine, manifest.seed)
            objects = {"before": pair.before, "after": pair.after}
            images = {kind: target.render(obj, views, size=manifest.image_size) for kind, obj in objects.items()}
    except RendererError as error:
        yield f"The renderer {renderer.name!r} cannot be asked again: {error}"
        return
    if engine != renderer.engine:
        yield f"The renderer here is {engine}, the manifest's {renderer.engine}."
    found, said = visibility_in(pair, views, images, epsilon=manifest.epsilon), renderer.visibility
    yield from _differences(renderer.name, said, found, OF_TEXTURES if pair.is_one else Visibility.model_fields)
    if pair.is_one and not (said.max_view_change or 0.0) >= (found.max_view_change or 0.0) - TOLERANCE:
        yield f"{renderer.name}: a view changes by {found.max_view_change}, the manifest says {said.max_view_change}."
    for pipeline, kind in product(PIPELINES, images):
        through = PIPELINES[pipeline]
        shown = images[kind] if through is None else through.shown(images[kind], index)
        for each in manifest.predictions:
            if each.renderer == renderer.name and (judge := judges.get(each.network)) is not None:
                logits = judge.network.predict(shown)
                if through is None:
                    yield from _classes(each, kind, judge, logits, index)
                else:
                    yield from _share(manifest, each, pipeline, kind, recognised(logits, judge.labels))


def _classes(
    recorded: Predictions, kind: str, judge: Judge, logits: NDArray[np.float32], index: Sequence[int]
) -> Iterator[str]:
    classes, known = getattr(recorded, kind), getattr(recorded, f"{kind}_margins")
    now = zip(logits.argmax(axis=1).tolist(), margins(logits, judge.labels).tolist(), strict=True)
    for k, (found, margin) in zip(index, now, strict=True):
        if found != classes[k]:
            yield (
                f"View {k} {kind}, {recorded.network} in {recorded.renderer}: {judge.class_name(found)!r} with "
                f"margin {margin:+.2f}, the manifest says {judge.class_name(classes[k])!r} with {known[k]:+.2f}."
            )


def _share(
    manifest: Manifest, recorded: Predictions, pipeline: str, kind: str, right: NDArray[np.bool_]
) -> Iterator[str]:
    """A share that the views rendered again rule out."""
    count = len(manifest.views)
    share = getattr(manifest.cell(recorded.renderer, recorded.network, pipeline), f"a_{kind}")
    if not right.sum() <= round(share * count) <= right.sum() + count - len(right):
        yield (
            f"{recorded.renderer}, {recorded.network}, {pipeline}: a_{kind} is {share:.3f} of {count} views in the "
            f"manifest, but {right.sum()} of {len(right)} rendered again are recognised."
        )
