"""Images classified by the server's own networks."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.special import softmax

from tests.server.api.conftest import Api
from trompe_server.classifiers import load_classifier
from trompe_server.image_pipelines import ImagePipeline
from trompe_server.library import classification
from trompe_shared.object3d import encode_png

SIDE = 48
PIXELS = encode_png(np.zeros((2, 2, 3), np.uint8))


@pytest.fixture
def pictures() -> Any:
    """Two images (2, H, W, 3) uint8."""
    return np.random.default_rng(0).integers(0, 256, (2, SIDE, SIDE, 3), np.uint8)


def classify(api: Api, files: list[bytes], **form: Any) -> Any:
    images = [("images", (f"{number}.png", data)) for number, data in enumerate(files)]
    return api.post("/v1/classify", files=images, data={"label": "mug"} | form)


@pytest.mark.parametrize(
    "strengths",
    [
        pytest.param({}, id="as sent"),
        pytest.param({"resize": 0.5, "blur": 1.5, "gain": 0.7, "jpeg": 40}, id="changed on the way"),
    ],
)
def test_images_are_classified_through_the_pipeline(api: Api, pictures: Any, strengths: Mapping[str, float]) -> None:
    ranges: dict[str, Any] = {name: (value, value) for name, value in strengths.items()}
    shown = ImagePipeline(**ranges).shown(pictures)
    tiny = load_classifier("tiny")
    assert tiny.classes is not None
    mug = tiny.classes.index("mug")

    answer = classify(api, [encode_png(each) for each in pictures], **strengths)

    assert answer.status_code == 200, answer.text
    for found, row in zip(answer.json(), softmax(tiny.predict(shown), axis=-1), strict=True):
        assert (found["index"], found["name"]) == (row.argmax(), tiny.classes[row.argmax()])
        assert found["confidence"] == pytest.approx(row.max(), abs=1e-4)
        assert found["true_confidence"] == pytest.approx(row[mug], abs=1e-4)
        assert found["correct"] == (row.argmax() == mug)


REFUSED: list[tuple[list[bytes], dict[str, Any], int, str]] = [
    ([b"no picture"], {}, 422, "Image 1 cannot be read"),
    ([encode_png(np.zeros((2, 1025, 3), np.uint8))], {}, 422, "at most 1024"),
    ([PIXELS, encode_png(np.zeros((2, 3, 3), np.uint8))], {}, 422, "one size"),
    ([PIXELS], {"label": "elephant"}, 422, "no class"),
    ([PIXELS], {"classifier": "x"}, 404, "classifier"),
    ([PIXELS], {"jpeg": 0}, 422, "jpeg"),
    ([b"x"] * 9, {}, 422, "at most 8"),
]


def test_what_cannot_be_classified_is_refused(api: Api) -> None:
    for files, form, status, said in REFUSED:
        assert said in api.problem(classify(api, files, **form), status, said)["detail"]


def test_a_reader_classifies_until_its_rate_is_spent(api: Api, pictures: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    api.headers = api.token("reader", "read")
    assert classify(api, [encode_png(pictures[0])]).status_code == 200
    monkeypatch.setattr(api.services.classifications, "wait", lambda client: 1.5 if client == "reader" else 0.0)
    refused = classify(api, [encode_png(pictures[0])])
    assert "retry in 1.50 s" in api.problem(refused, 429)["detail"]
    assert refused.headers["retry-after"] == "2"


def test_a_process_that_died_is_told_and_replaced(api: Api, pictures: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [encode_png(pictures[0])]
    with monkeypatch.context() as patched:
        patched.setattr(classification, "MODULE", "this")
        assert "try again" in api.problem(classify(api, files), 422)["detail"]
    assert classify(api, files).status_code == 200
