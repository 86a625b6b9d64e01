"""``judgement.json``: the manifest of a judgement of two model files."""

from typing import Final, Literal

from pydantic import Field

from trompe_shared.api.jobs import Colour, Schema
from trompe_shared.api.results import Accuracy, Visibility
from trompe_shared.engine import EngineInfo

AS_RENDERED: Final = "as rendered"
"""Name of the images themselves among the image pipelines."""

MANIFEST: Final = "judgement.json"
MANIFEST_PAGE: Final = "judgement.html"
"""Names of the files of a judgement."""

FindingKind = Literal[
    "object", "geometry", "uv", "material", "size", "epsilon", "label", "network", "renderer", "views"
]


class Finding(Schema):
    """Something that a reader of the figures must know, in one sentence."""

    kind: FindingKind
    text: str


class HashedFile(Schema):
    """A file that was looked at."""

    source: str = Field(description="path relative to the manifest's folder, or name of a shipped object")
    sha256: str
    bytes: int


class TextureChange(Schema):
    """Change of one texture; levels are of 255, of the channel that changed most."""

    texture: str
    size: tuple[int, int] = Field(description="(height, width)")
    texels_altered: float = Field(description="share of its texels")
    mean_levels: float = Field(description="over the channels of the altered texels")
    max_levels: int
    texels_beyond_epsilon: int | None = Field(description="null if no epsilon is stated")


class JudgedNetwork(Schema):
    """A network; ``missing`` says why it gave no figures."""

    name: str
    reference: str = Field(description="name, or path relative to the manifest's folder")
    sha256: str | None = Field(default=None, description="of its file or files, or of the weights of a network by name")
    image_size: tuple[int, int] | None = None
    labels: list[int] = Field(default_factory=list)
    label_names: list[str] | None = None
    missing: str | None = None


class JudgedRenderer(Schema):
    """A renderer by the name that was asked for; ``missing`` says why it gave no figures."""

    name: str
    engine: EngineInfo | None = None
    visibility: Visibility = Field(default_factory=Visibility)
    missing: str | None = None


class ViewRecord(Schema):
    """A camera with its light and background; metres, degrees, sRGB."""

    distance: float
    azimuth: float
    elevation: float
    roll: float
    centre: tuple[float, float, float]
    light_azimuth: float
    light_elevation: float
    light_intensity: float
    light_ambient: float
    light_colour: Colour
    background: Colour


class Cell(Schema):
    """Figures of one renderer, network and image pipeline; null if the renderer or the network is missing."""

    renderer: str
    network: str
    pipeline: str
    accuracy: Accuracy | None


class Predictions(Schema):
    """Classes of the images as rendered, one for each view, and their margins: best logit of the object's classes minus
    the best of all others."""

    renderer: str
    network: str
    before: list[int]
    after: list[int]
    before_margins: list[float]
    after_margins: list[float]


class Manifest(Schema):
    """Everything that was looked at, and what was found."""

    suite: str | None = Field(description="name of the suite; null for options of one's own")
    label: list[str | int]
    epsilon: float | None = Field(description="the stated budget, [0, 1] units")
    before: HashedFile
    after: HashedFile
    networks: list[JudgedNetwork]
    renderers: list[JudgedRenderer]
    image_size: tuple[int, int] = Field(description="of the rendered images, (height, width)")
    seed: int = Field(description="of the views")
    views: list[ViewRecord]
    findings: list[Finding]
    textures: list[TextureChange]
    cells: list[Cell]
    predictions: list[Predictions]
    seconds: float = Field(description="wall time; of the last run if it was stopped")
    versions: dict[str, str]

    def cell(self, renderer: str, network: str, pipeline: str = AS_RENDERED) -> Accuracy | None:
        """The figures of one cell."""
        wanted = renderer, network, pipeline
        return next(each.accuracy for each in self.cells if (each.renderer, each.network, each.pipeline) == wanted)
