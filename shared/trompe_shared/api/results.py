"""``result.json``."""

from typing import Annotated, Final

from pydantic import Field

from trompe_shared.api.jobs import Colour, JobSpec, Schema
from trompe_shared.engine import DEFAULT_ENGINE, EngineInfo

ADVERSARIAL: Final = "-adversarial"
"""In the name of each file of the repainted object, after the object's name: ``mug-adversarial.glb``."""

FEW_RECOGNISED: Final = 0.3
"""``a_before`` below which a warning is given and means leave the object out: ``a_drop`` then rests on few views."""

VISIBLE: Final = (
    (5.0, "different colours"),
    (3.5, "a clear difference"),
    (2.0, "a slight difference"),
    (1.0, "a difference for a trained eye"),
    (0.0, "no difference"),
)
"""Visibility of a CIEDE2000 difference, by its least value (Mokrzycki and Tatol, 2011, Colour difference Delta E)."""

NAMED: Final = 5
"""Classes of fooled views that are named in words."""


class Accuracy(Schema):
    """Share of views classified as the object's class, before and after; Wilson intervals at 95 %.

    Shares are of all ``views``; intervals count only the ``distinct`` ones (the paper's grid has azimuth 0 twice).
    ``a_after`` and its interval are null if there was no attack.
    """

    views: int
    distinct: int
    a_before: float
    a_after: float | None
    a_drop: float | None = Field(description="(a_before - a_after) / a_before; null (n.a.) when a_before is 0")
    a_drop_interval: tuple[float, float] | None = Field(
        None, description="95 % bootstrap interval over views; null where a_drop is"
    )
    a_before_interval: tuple[float, float]
    a_after_interval: tuple[float, float] | None
    a_drop_with_neighbours: float | None = Field(
        default=None, description="a_drop if neighbours count as the object too; null if class names are unknown"
    )
    a_drop_with_neighbours_interval: tuple[float, float] | None = None

    @property
    def counted(self) -> str:
        """The number of views as text."""
        return str(self.views) if self.distinct == self.views else f"{self.views} ({self.distinct} distinct)"


class ViewFidelity(Schema):
    """Agreement of surrogate and target in one view: the unpainted object, and the change by the attack."""

    error: float = Field(description="mean |difference| on the pixels of the unpainted object, sRGB in [0, 1] units")
    correlation: float = Field(description="of predicted and true change of the image")
    slope: float = Field(description="of true over predicted change; 1 is ideal")
    explained: float = Field(description="share of the variance of the true change explained by the prediction")
    change: float = Field(description="root of the mean squared true change, sRGB in [0, 1] units")


class ViewPrediction(Schema):
    """Classes and confidences of one view, before and after; probabilities in [0, 1]."""

    azimuth: float
    elevation: float
    distance: float
    light_azimuth: float
    light_elevation: float
    roll: float = 0.0
    light_intensity: float = 1.25
    light_ambient: float = 0.5
    light_colour: Colour = (255, 255, 255)
    background: str = Field("#ffffff", description="colour, or id of the picture behind the object")
    before: int
    before_confidence: float
    before_true_confidence: float
    after: int | None = None
    after_confidence: float | None = None
    after_true_confidence: float | None = None
    fidelity: Annotated[ViewFidelity | None, Field(description="of attacked views whose image changed")] = None


class Classification(Schema):
    """A classifier's answer to one image; probabilities in [0, 1]."""

    index: int = Field(description="the most probable class")
    name: str | None = Field(description="its name, if known")
    confidence: float = Field(description="its probability")
    true_confidence: float = Field(description="probability of the object's classes together")
    correct: bool = Field(description="whether the most probable class is one of the object's")


class Judgement(Schema):
    """Accuracies of another classifier on the same target images."""

    classifier: str
    target: Accuracy
    held_out: Accuracy | None = None


class PipelineJudgement(Schema):
    """Accuracy on every second held-out target image, through a fixed image pipeline before and after alike."""

    pipeline: str
    held_out: Accuracy


class RendererResult(Schema):
    """Figures in one of several renderers; ``surrogate`` and ``transfer_gap`` are null if it was not attacked."""

    renderer: EngineInfo
    attacked: bool = Field(description="whether the attack painted for it; others only judge")
    surrogate: Accuracy | None
    target: Accuracy
    held_out: Accuracy | None
    transfer_gap: float | None
    disagreement: float | None = None
    margin_error: float | None = None
    surrogate_model: str | None = None
    surrogate_reason: str | None = None
    fidelity: dict[str, float] = Field(default_factory=dict)
    views: list[ViewPrediction]
    held_out_views: list[ViewPrediction]


class FooledAs(Schema):
    """A class of fooled views: those recognised before the attack, and as this class after."""

    label: int
    name: str | None
    own: int = Field(description="number of the attack's own target views")
    held_out: int = Field(description="number of held-out views")
    neighbour: bool = Field(description="whether its name shares a noun with the object's: perhaps a near-synonym")

    @property
    def words(self) -> str:
        """First name and number of views, as ``table lamp 9 (neighbour)``."""
        name = self.name.split(",")[0] if self.name else f"class {self.label}"
        return f"{name} {self.own + self.held_out}" + (" (neighbour)" if self.neighbour else "")


class Visibility(Schema):
    """Visibility of a repaint, in the textures and in the target's images; null if there was no attack."""

    texels_altered: float | None = Field(
        default=None, description="share of texels altered (N%); null if the textures cannot be compared"
    )
    mean_texel_change: float | None = Field(
        default=None, description="mean |change| over altered texels and channels, [0, 1] units"
    )
    max_view_change: float | None = Field(
        default=None, description="largest |change| of a pixel of a target view, [0, 1] units"
    )
    pixels_beyond_epsilon: float | None = Field(
        default=None,
        description="share of the object's pixels in target views that changed by more than epsilon, or epsilon_view",
    )
    views_beyond_epsilon: float | None = Field(default=None, description="share of target views with such a pixel")
    ssim: float | None = Field(
        default=None,
        description="mean structural similarity of target views before and after, over the object; 1 is equal",
    )
    ssim_worst: float | None = Field(default=None, description="the same in the worst view")
    delta_e: float | None = Field(default=None, description="mean CIEDE2000 colour difference over the object's pixels")
    delta_e_95: float | None = Field(default=None, description="95th percentile of that difference")
    texture_variation: float | None = Field(
        default=None, description="mean |difference| of the change between neighbouring texels, [0, 1] units"
    )

    @property
    def noticed(self) -> str | None:
        """What a viewer notices of the change; ``None`` if no image shows the object before and after."""
        if self.delta_e is None or self.delta_e_95 is None:
            return None
        return (
            f"Side by side, a viewer sees {_visible(self.delta_e)} on average (CIEDE2000 {self.delta_e:.1f}) and "
            f"{_visible(self.delta_e_95)} in places ({self.delta_e_95:.1f})."
        )


class Result(Visibility):
    """Request, outcome, and agreement of surrogate and target.

    With several renderers all figures and views outside ``renderers`` are of ``renderer``: the attacked one with the
    smallest ``a_drop``, on held-out views if there are any.
    """

    spec: JobSpec
    object: str
    label: int
    label_name: str | None
    labels: list[int] = Field(min_length=1, description="all classes that count as the object; the first is label")
    label_names: list[str] | None
    classifier: str
    ensemble: list[str] = Field(default_factory=list, description="classifiers attacked together with it")
    epsilon: float
    alpha: float
    tau: float | None
    surrogate_model: str
    surrogate_reason: str
    seed: int
    steps: int = Field(description="steps the attack took")
    image_size: tuple[int, int]
    renderer: EngineInfo | None = Field(None, description="engine that drew the pictures of target and held-out views")
    renderers: list[RendererResult] = Field(
        default_factory=list, description="each of several renderers: the attacked ones, then those that only judge"
    )
    surrogate: Accuracy | None
    target: Accuracy
    held_out: Accuracy | None
    fooled_as: list[FooledAs] = Field(
        default_factory=list, description="what the object became: classes of the fooled views, the most frequent first"
    )
    transfer_gap: float | None = Field(description="surrogate a_drop minus target a_drop on the same views")
    disagreement: float | None = Field(
        None, description="share of own views after the attack that are recognised in surrogate or target alone"
    )
    margin_error: float | None = Field(
        None, description="mean |difference| of these views' margins in both, over the margin moved in the target"
    )
    judges: list[Judgement] = Field(default_factory=list)
    image_pipelines: list[PipelineJudgement] = Field(
        default_factory=list, description="the classifier on held-out images that were resized, compressed and so on"
    )
    goal_reached: float | None = Field(None, description="share of target views on which the goal is reached")
    evaluations: int | None = Field(
        None, description="images shown to each attacked classifier, those for tau, keep and further views included"
    )
    queries: int | None = Field(None, description="scores asked of a score-only classifier")
    fidelity: dict[str, float] = Field(
        default_factory=dict,
        description="surrogate against target for a random repaint on a few trial views; see docs/glossary.md",
    )
    warnings: list[str] = Field(default_factory=list)
    seconds: dict[str, float] = Field(
        description="wall time of the job by kind of work: the phases, ``open`` before and between them, ``report``"
    )
    probe_renders: int = Field(description="target images of the calibration")
    attacked_views: int = Field(
        description="views that the attack used: `views`, and those that it added from its pool because it lost them"
    )
    further_renders: int = Field(description="target images with which the attack looked for views to add")
    versions: dict[str, str]
    views: list[ViewPrediction]
    held_out_views: list[ViewPrediction]

    @property
    def drawn_by(self) -> str | None:
        """The renderers in words; ``None`` for our own one with its default settings."""
        if self.renderer is None or (
            not self.renderers and self.renderer.name == DEFAULT_ENGINE and not self.renderer.settings
        ):
            return None
        attacked = sum(each.attacked for each in self.renderers)
        among = f", of {attacked} attacked renderers the one with the smallest A_drop" if attacked > 1 else ""
        return f"Figures and pictures are of {self.renderer}{among}."

    @property
    def by_renderer(self) -> "list[tuple[str, RendererResult | Result]]":
        """The figures in each renderer after its name, ending in a colon and a space; without name in a single one."""
        engines = [each.renderer for each in self.renderers]
        judging = {True: ": ", False: ", not attacked: "}
        named = [(each.renderer.named(engines) + judging[each.attacked], each) for each in self.renderers]
        return [*named] or [("", self)]

    @property
    def accuracies(self) -> list[tuple[str, Accuracy]]:
        """All accuracies, each with its name in tables."""
        rows: list[tuple[str, Accuracy | None]] = []
        for name, each in self.by_renderer:
            rows += [
                (f"{name}surrogate (own views)", each.surrogate),
                (f"{name}target (own views)", each.target),
                (f"{name}target (held-out views)", each.held_out),
            ]
        for judge in self.judges:
            rows += [
                (f"judge {judge.classifier} (own views)", judge.target),
                (f"judge {judge.classifier} (held-out views)", judge.held_out),
            ]
        rows += [(f"held-out views, {each.pipeline}", each.held_out) for each in self.image_pipelines]
        return [(name, accuracy) for name, accuracy in rows if accuracy is not None]

    @property
    def became(self) -> str:
        """The most frequent classes of the fooled views in words, with the number of views of each."""
        few, rest = self.fooled_as[:NAMED], sum(each.own + each.held_out for each in self.fooled_as[NAMED:])
        return ", ".join([*(each.words for each in few), *([f"{rest} in other classes"] if rest else [])])

    @property
    def at_goal(self) -> str | None:
        """How often a target class, or the loss of the best k, was reached, in words; ``None`` for the plain goal."""
        goal = self.spec.goal
        if self.goal_reached is None or (goal.target is None and goal.top_k == 1):
            return None
        wanted = f"the true class is not among the {goal.top_k} best"
        if goal.target is not None:
            wanted = f"taken for {goal.target if isinstance(goal.target, str) else f'class {goal.target}'}"
        return f"{self.goal_reached:.1%} of the target views: {wanted}"


def _visible(delta_e: float) -> str:
    return next(words for least, words in VISIBLE if delta_e >= least)
