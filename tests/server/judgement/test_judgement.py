"""Judgements of the mug over a fake renderer: figures, findings, page, and how one goes on where it stopped."""

import io
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from tests.job_runs import Recorder
from tests.server.classifiers.test_contract import write_onnx
from trompe_server.image_pipelines import SUITE
from trompe_server.job.protocol import OnProgress
from trompe_server.judgement.judge_files import judge_files
from trompe_server.judgement.manifest import Judged, manifest_of
from trompe_server.judgement.pictures import judgement_pictures
from trompe_server.judgement.sources import LocalSources, StoredSources
from trompe_server.judgement.suites import SUITES, Suite, suite_of
from trompe_server.judgement.verify import verify
from trompe_server.judgement.work import Timed
from trompe_server.library import Library
from trompe_server.pages.judgement import judgement_page
from trompe_server.renderers import TargetRenderer
from trompe_server.storage.folders import LocalArtifacts
from trompe_shared.api import AS_RENDERED, Finding, JudgementSpec, Manifest, Progress, Visibility
from trompe_shared.errors import RendererError, RendererLostError, SpecError
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

TEXTURE = "mug_ceramic_AlbedoTransparency.png"


@pytest.fixture
def fake_renderer(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """The renderer of the name ``fake``; there is no other."""
    target = Recorder()

    @contextmanager
    def running(_sources: LocalSources, name: str) -> Iterator[TargetRenderer]:
        if name != "fake":
            error = SpecError if name == "two-of-it" else RendererError
            raise error(f"The renderer worker did not start. There is no engine {name!r}.")
        yield target

    monkeypatch.setattr(LocalSources, "running", running)
    return target


@pytest.fixture
def dark(tmp_path: Path, mug: Object3D) -> Path:
    """The mug, painted all black but for its handle's side of the texture."""
    painted = {name: np.where(np.arange(512)[:, None, None] < 400, 0, image) for name, image in mug.textures.items()}
    file = tmp_path / "dark.zip"
    file.write_bytes(mug.with_textures({name: image.astype(np.uint8) for name, image in painted.items()}).to_zip())
    return file


Judge = Callable[..., Judged]


@pytest.fixture
def judge(fake_renderer: Recorder, tmp_path: Path) -> Judge:
    """Judges the mug against another file."""
    assert fake_renderer.asked == []

    def run(after: Path, *, on_progress: OnProgress = lambda _: None, **options: Any) -> Judged:
        kept = LocalArtifacts(tmp_path / "kept")
        return judge_files(spec_of(after, **options), LocalSources(tmp_path), kept=kept, on_progress=on_progress)

    return run


def spec_of(after: Path, **options: Any) -> JudgementSpec:
    asked: dict[str, Any] = {"label": "mug", "renderers": ["fake"], "views": 6, **options}
    return JudgementSpec.of("mug", str(after), **asked)


def test_every_cell_has_figures_and_every_view_its_classes(judge: Judge, dark: Path) -> None:
    manifest = manifest_of(judge(dark), seconds=1.0)
    assert [cell.pipeline for cell in manifest.cells] == [AS_RENDERED, *SUITE]
    assert all(cell.accuracy is not None and cell.accuracy.views == 6 for cell in manifest.cells)
    (predictions,) = manifest.predictions
    found = manifest.cell("fake", "tiny")
    assert found is not None
    label = manifest.networks[0].labels
    assert found.a_before == np.isin(predictions.before, label).mean()
    assert [margin > 0 for margin in predictions.after_margins] == [each in label for each in predictions.after]
    assert Manifest.model_validate_json(manifest.model_dump_json()) == manifest


# Whatever does not fit is said in a sentence, and the rest is judged


def test_each_thing_that_does_not_fit_is_a_sentence_and_the_rest_is_judged(
    judge: Judge, dark: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = dark.with_name("nowhere.pt2")
    options = {
        "networks": ["tiny", str(missing)],
        "renderers": ["fake", "none-such", "two-of-it"],
        "views": None,
        "suite": "small",
        "epsilon": 0.1,
    }
    monkeypatch.setitem(SUITES, "small", Suite(6, 0, (64, 96), (), ()))
    manifest = manifest_of(judge(dark, **options), seconds=1.0)
    texts = {(found.kind, found.text.split(":")[0]) for found in manifest.findings}
    assert texts == {
        ("epsilon", f"The texture {TEXTURE!r} exceeds the stated epsilon of 0.1 (25 levels of 255)"),
        ("network", "The network 'tiny' takes images of 128 x 128; those of 64 x 96 are resized."),
        ("network", f"No figures of {str(missing)!r}"),
        ("renderer", "No figures in 'none-such'"),
        ("renderer", "No figures in 'two-of-it'"),
    }
    empty = Counter(cell.accuracy is None for cell in manifest.cells)
    assert empty == {False: 1 + len(SUITE), True: 5 * (1 + len(SUITE))}


def test_what_is_named_twice_is_looked_at_once(judge: Judge, dark: Path) -> None:
    manifest = manifest_of(judge(dark, networks=["tiny", "tiny"], renderers=["fake", "fake"]), seconds=1.0)
    assert (len(manifest.renderers), len(manifest.networks)) == (1, 1)


def test_a_stored_object_is_judged_as_it_was_attacked(mug: Object3D, tmp_path: Path) -> None:
    library, kept = Library(tmp_path / "library"), LocalArtifacts(tmp_path / "kept")
    library.add_object(io.BytesIO(mug.to_zip()), "Mug ver. 2", max_texture=128)
    found = StoredSources(library, kept, "fake", LocalSources(tmp_path).running).object("Mug ver", "before")
    assert {texture.shape for texture in found.obj.textures.values()} == {(128, 128, 3)}
    assert kept.exists(found.file.source)


def test_an_object_that_is_not_recognised_before_is_said(judge: Judge, dark: Path) -> None:
    manifest = manifest_of(judge(dark, label=("ball",)), seconds=1.0)
    told = [found.text for found in manifest.findings if found.kind == "views"]
    assert told == ["fake, tiny: None of the 6 views was recognised before the attack: A_drop is n.a."]


def test_a_label_counts_for_the_networks_that_know_it(judge: Judge, dark: Path) -> None:
    known = manifest_of(judge(dark, label=("coffee mug", "mug")), seconds=1.0)
    assert known.networks[0].label_names == ["mug"]
    unknown = manifest_of(judge(dark, label=("coffee mug",)), seconds=1.0)
    (found,) = unknown.findings
    assert re.match("No figures of 'tiny': 'tiny' has no class 'coffee mug'; an example of a class", found.text)
    assert unknown.textures


def test_an_index_counts_only_for_networks_with_the_same_class_there(judge: Judge, dark: Path, tmp_path: Path) -> None:
    other = write_onnx(tmp_path / "other.onnx", n_classes=8)
    (tmp_path / "classes.json").write_text(json.dumps([*"abcdefgh"]))
    manifest = manifest_of(judge(dark, label=("5",), networks=["tiny", str(other)]), seconds=1.0)
    assert manifest.networks[0].label_names == ["mug"]
    told = "The index 5 is another class for the judge 'other': 'f', not 'mug'"
    assert (manifest.networks[1].missing or "").startswith(told)


def test_the_hash_of_a_network_covers_weights_in_another_file(tmp_path: Path) -> None:
    file, sources = write_onnx(tmp_path / "net.onnx"), LocalSources(tmp_path)
    onnx.save(onnx.load(file), file, save_as_external_data=True, location="weights.bin", size_threshold=0)
    _, before = sources.network(str(file), [0])
    weights = tmp_path / "weights.bin"
    weights.write_bytes(bytes(weights.stat().st_size))
    _, after = sources.network(str(file), [0])
    assert before.sha256 != after.sha256


def test_another_object_is_judged_by_itself_and_has_no_drop(judge: Judge, tmp_path: Path) -> None:
    ball = tmp_path / "ball.zip"
    ball.write_bytes(shipped_objects()["ball"].read())
    judged = judge(ball)
    manifest = manifest_of(judged, seconds=1.0)
    assert manifest.findings[0].kind == "object"
    assert "Each is judged by itself; there is no A_drop" in manifest.findings[0].text
    assert (manifest.textures, manifest.renderers[0].visibility) == ([], Visibility())
    for cell in manifest.cells:
        assert cell.accuracy is not None
        assert cell.accuracy.a_after is not None
        assert (cell.accuracy.a_drop, cell.accuracy.a_drop_interval) == (None, None)
    page = judgement_page(manifest, judgement_pictures(judged))
    assert page.index("These are not one object") < page.index("Images as rendered")
    assert "Image pipeline" in page


# Resume, and the time left


class StoppedError(Exception):
    """Stands for Ctrl-C."""


def test_a_stopped_judgement_goes_on_to_the_same_figures(
    judge: Judge, dark: Path, fake_renderer: Recorder, tmp_path: Path
) -> None:
    def stop(progress: Progress) -> None:
        if progress.fraction > 0.5:
            raise StoppedError

    with pytest.raises(StoppedError):
        judge(dark, on_progress=stop)
    rendered = len(fake_renderer.asked)
    assert rendered == 2
    resumed = manifest_of(judge(dark), seconds=1.0)
    assert len(fake_renderer.asked) == rendered
    assert any((tmp_path / "kept").iterdir())
    for file in (tmp_path / "kept").iterdir():
        file.write_bytes(b"damaged")
    assert manifest_of(judge(dark), seconds=1.0) == resumed


def test_a_renderer_that_is_lost_once_is_asked_again_and_the_time_left_stays_right(
    judge: Judge, dark: Path, fake_renderer: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, lost = list[Progress](), iter([False, True])
    render = fake_renderer.render

    def render_or_fail(*given: Any, **options: Any) -> Any:
        if next(lost, False):
            raise RendererLostError("The renderer is gone.")
        return render(*given, **options)

    monkeypatch.setattr(fake_renderer, "render", render_or_fail)
    manifest = manifest_of(judge(dark, on_progress=told.append), seconds=1.0)
    assert all(cell.accuracy is not None for cell in manifest.cells)
    assert max(each.fraction for each in told) == told[-1].fraction == 1
    assert min(each.eta_seconds or 0 for each in told) >= 0


def test_the_time_left_is_that_of_the_images_to_come() -> None:
    now, told = [0.0], list[Progress]()
    timed = Timed(Counter({"rendering": 20, "showing": 40, "never": 5}), told.append, clock=lambda: now[0])
    timed.skip("never")
    for _ in range(2):
        with timed.step("rendering", 10):
            now[0] += 5
    with timed.step("showing", 10, kept=True):
        now[0] += 0.001
    with timed.step("showing", 10):
        now[0] += 20
    assert told[-1].fraction == pytest.approx(40 / 60)
    assert told[-1].eta_seconds == 40


# The page


class References(HTMLParser):
    """Collects what a page loads or leads to."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: Counter[str] = Counter()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.found += [value or "" for name, value in attrs if name in {"src", "href", "srcset", "action", "data"}]


def test_the_page_needs_no_network_and_escapes_names(judge: Judge, dark: Path) -> None:
    named = dark.with_name("<script>x.zip")
    named.write_bytes(dark.read_bytes())
    judged = judge(named, renderers=("fake", "none-such"))
    manifest = manifest_of(judged, seconds=1.0)
    page = judgement_page(manifest, judgement_pictures(judged))
    references = References()
    references.feed(page)
    assert references.found
    assert all(each.startswith("data:image/jpeg;base64,") for each in references.found)
    assert not re.search(r"url\((?!data:)|@import|https?://", page)
    assert not references.tags["script"]
    drops = [cell.accuracy.a_drop for cell in manifest.cells if cell.accuracy is not None]
    assert references.tags["circle"] == len(drops) - drops.count(None) > 0


# Verification


Change = Callable[[Manifest, Path], Manifest]


def lied(manifest: Manifest, _dark: Path) -> Manifest:
    """Another class in one view, and figures that fit it."""
    (predictions,) = manifest.predictions
    other = (predictions.after[2] + 1) % 8
    after = [*predictions.after[:2], other, *predictions.after[3:]]
    return manifest.model_copy(update={"predictions": [predictions.model_copy(update={"after": after})]})


def repainted(manifest: Manifest, dark: Path) -> Manifest:
    obj = load_object(dark)
    dark.write_bytes(obj.with_textures({name: image[::-1] for name, image in obj.textures.items()}).to_zip())
    return manifest


def gone(manifest: Manifest, dark: Path) -> Manifest:
    dark.unlink()
    return manifest


def whole(**update: Any) -> Change:
    return lambda manifest, _dark: manifest.model_copy(update=update)


def first(part: str, **update: Any) -> Change:
    """The first of a list changed."""

    def change(manifest: Manifest, _dark: Path) -> Manifest:
        head, *tail = getattr(manifest, part)
        return manifest.model_copy(update={part: [head.model_copy(update=update), *tail]})

    return change


def better(*, pipelines: bool = False, **update: Any) -> Change:
    """Other figures of the images as rendered, or of all image pipelines."""

    def change(manifest: Manifest, _dark: Path) -> Manifest:
        cells = manifest.model_copy(deep=True).cells
        for cell in cells[1:] if pipelines else cells[:1]:
            assert cell.accuracy is not None
            cell.accuracy = cell.accuracy.model_copy(update=update)
        return manifest.model_copy(update={"cells": cells})

    return change


def easier(manifest: Manifest, _dark: Path) -> Manifest:
    """One view twice."""
    return manifest.model_copy(update={"views": [manifest.views[0], manifest.views[0], *manifest.views[2:]]})


def foreign(manifest: Manifest, _dark: Path) -> Manifest:
    """A renderer whose name would import a module."""
    return Manifest.model_validate_json(manifest.model_dump_json().replace('"fake"', '"foreign:Engine"'))


def labelled(manifest: Manifest, _dark: Path) -> Manifest:
    return manifest.model_copy(update={"suite": "standard-1"})


CHANGES: list[list[tuple[Change, str]]] = [
    [(easier, "The views are not the random ones of seed 0")],
    [(labelled, "is not that of standard-1")],
    [(lied, r"View 2 after, tiny in fake: '\w+' with margin [+-]\d+\.\d\d, the manifest says '\w+'")],
    [(repainted, r"dark\.zip has changed: its sha256 is ")],
    [(gone, "The file after cannot be read again")],
    [(foreign, "'foreign:Engine' was not asked again: it is code or a host")],
    [
        (
            whole(findings=[Finding(kind="material", text="The maps differ.")]),
            "has a finding that does not hold: The maps differ",
        ),
    ],
    [
        (better(a_after=0.123), r"as rendered: a_after is 0\.\d+, the manifest says 0\.123"),
        (better(a_drop_interval=(0.1, 0.2)), r"a_drop_interval is .*, the manifest says \(0\.1, 0\.2\)"),
        (better(a_drop_with_neighbours=0.5), r"a_drop_with_neighbours is .*, the manifest says 0\.5"),
        (better(pipelines=True, a_after=1.0), r"JPEG 30: a_after is 1\.000 of 6 views in the manifest, but \d of 6"),
        (better(pipelines=True, a_drop=-0.5), r"grain: a_drop is .*, the manifest says -0\.5"),
        (first("renderers", visibility=Visibility(max_view_change=0.0)), r"fake: a view changes by [\d.]+, .* 0\.0"),
        (first("textures", max_levels=0), r"mug_ceramic.*: max_levels is \d+, the manifest says 0"),
        (whole(findings=[]), "The manifest lacks a finding: The texture .* exceeds"),
    ],
    [
        (whole(textures=[]), "The textures that can be compared are .* the manifest has others"),
        (whole(suite="other"), "The manifest lacks 'torchvision:resnet50' of other"),
        (first("networks", labels=[*range(7)]), r"labels is \[5\], the manifest says \[0, 1"),
        (first("predictions", before=[99] * 6), "'tiny' has 8 classes, the predictions have others"),
    ],
    [
        (first("predictions", before=[5]), "fake, another: expected 6 classes and margins"),
        (first("predictions", network="another"), "malformed: expected predictions for each"),
        (first("views", distance=float("nan")), "malformed: a view has numbers that are not finite"),
        (first("networks", labels=[]), "malformed: a network has no labels"),
        (better(a_after=None), "expected shares in 0..1"),
        (whole(image_size=(0, 9)), "malformed: image_size"),
    ],
    [
        (whole(predictions=[]), "malformed: expected predictions for each"),
        (whole(cells=[]), "malformed: expected one cell for each"),
        (whole(views=[]), "malformed.* views: .* greater than or equal to 1"),
    ],
]
"""Changes made together, and the fault of each."""


def test_verification_names_what_is_not_as_the_manifest_says(
    judge: Judge, dark: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SUITES, "other", Suite(6, 0, (128, 128), ("fake",), ("torchvision:resnet50",)))
    manifest, painted = manifest_of(judge(dark, epsilon=0.1), seconds=1.0), dark.read_bytes()
    assert list(verify(manifest, tmp_path, generator=np.random.default_rng(0))) == []
    for changes in CHANGES:
        changed = reduce(lambda done, change: change[0](done, dark), changes, manifest)
        faults = list(verify(changed, tmp_path, generator=np.random.default_rng(0)))
        for _, fault in changes:
            assert any(re.search(fault, each) for each in faults), (fault, faults)
        dark.write_bytes(painted)


# The suite


def test_a_suite_never_changes() -> None:
    named = ("tiny", *(f"torchvision:{name}" for name in ("mobilenet_v2", "inception_v3", "resnet50", "vit_b_16")))
    assert SUITES["standard-1"] == Suite(100, 20261123, (224, 224), ("pyrender", "three"), named)
    assert re.sub(r"\w+=(None|1\.0|0\.0)(, )?", "", str([*SUITE.items()])) == (
        "[('half size', ImagePipeline(resize=(0.5, 0.5), )), ('three quarters', ImagePipeline(resize=(0.75, 0.75), )), "
        "('JPEG 75', ImagePipeline(jpeg=(75, 75))), ('JPEG 30', ImagePipeline(jpeg=(30, 30))), "
        "('gamma 0.8', ImagePipeline(gamma=(0.8, 0.8), )), ('gamma 1.25', ImagePipeline(gamma=(1.25, 1.25), )), "
        "('filmic', ImagePipeline(filmic=(1, 1), )), ('blur 1', ImagePipeline(blur=(1, 1), )), "
        "('crop', ImagePipeline(zoom=(1.15, 1.15), )), ('grain', ImagePipeline(noise=(0.05, 0.05), ))]"
    )


def test_a_suite_keeps_its_own_and_takes_more_on_top(dark: Path) -> None:
    spec = spec_of(dark, views=None, suite="standard-1", networks=["mine.pt2"], renderers=["mitsuba"])
    suite = suite_of(spec, renderer="other")
    assert suite.networks == (*SUITES["standard-1"].networks, "mine.pt2")
    assert suite.renderers == ("pyrender", "three", "mitsuba")
    assert (suite.views, suite.image_size) == (100, (224, 224))
    assert suite_of(spec_of(dark, renderers=[]), renderer="other") == Suite(6, 0, None, ("other",), ("tiny",))


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"label": []}, "label: .* at least 1"),
    ({"views": 0}, "views: .* greater than or equal to 1"),
    ({"epsilon": 12.75}, "epsilon: .* less than or equal to 1"),
    ({"background": "room.png"}, "is not a colour"),
    ({"seed": -1}, "seed: .* greater than or equal to 0"),
    ({"distance": -1.0}, "distance: .* greater than 0"),
    ({"elevation": (50.0, 0.0)}, "low end first; got 50.0 0.0"),
    ({"suite": "standard-1"}, "the suite standard-1 fixes views and seed"),
    ({"surprise": 1}, "surprise: .* not permitted"),
]


@pytest.mark.parametrize(("options", "text"), WRONG)
def test_a_wrong_option_is_an_error(dark: Path, options: dict[str, Any], text: str) -> None:
    with pytest.raises(SpecError, match=text):
        spec_of(dark, **options)
