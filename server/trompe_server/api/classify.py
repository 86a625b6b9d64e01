"""Route that classifies images, for pages that show a network's answer while the user turns an object."""

import math
from typing import Annotated, Final

from fastapi import APIRouter, File, Form, HTTPException, Request, UploadFile

from trompe_server.api import examples
from trompe_server.api.problems import PROBLEMS
from trompe_server.api.services import Services, ServicesDep
from trompe_server.spec.labels import resolve_labels
from trompe_shared.api import Classification

MOST_BYTES: Final = 4 * 2**20
"""Size of an image."""

router = APIRouter(prefix="/v1", responses=PROBLEMS, tags=["classifiers"])

Images = Annotated[
    list[UploadFile], File(description="PNG or JPEG, up to 1024 pixels a side", min_length=1, max_length=8)
]
Label = Annotated[
    list[str],
    Form(description="class of the object, a name or an index; repeat it for several", min_length=1, max_length=100),
]
Jpeg = Annotated[int | None, Form(description="quality of a JPEG on the way to the network", ge=1, le=95)]
Resize = Annotated[
    float | None, Form(description="factor by which the image is reduced and enlarged again", gt=0, le=1)
]
Blur = Annotated[float | None, Form(description="standard deviation of a blur, pixels", gt=0, le=20)]
Gain = Annotated[float | None, Form(description="factor of the levels", gt=0, le=4)]


@router.post("/classify", responses=examples.found(examples.CLASSIFICATIONS))
def classify(
    request: Request,
    services: ServicesDep,
    images: Images,
    label: Label,
    classifier: Annotated[str, Form(max_length=200)] = "tiny",
    jpeg: Jpeg = None,
    resize: Resize = None,
    blur: Blur = None,
    gain: Gain = None,
) -> list[Classification]:
    """Classify images of one size, optionally resized, blurred, brightened and compressed in this order.

    Stores nothing; a token that may only read is enough.
    """
    _check_rate(services, request)
    info = services.library.classifier(classifier)
    labels = resolve_labels(label, info.classes, info.n_classes, info.name)
    given = {"resize": resize, "blur": blur, "gain": gain, "jpeg": jpeg}
    found = services.networks.classify(
        services.library.classifier_path(classifier),
        [_read(each) for each in images],
        labels=labels,
        strengths={name: value for name, value in given.items() if value is not None},
    )
    return [
        Classification(
            index=index,
            name=info.classes[index] if info.classes else None,
            confidence=confidence,
            true_confidence=true_confidence,
            correct=index in labels,
        )
        for index, confidence, true_confidence in found
    ]


def _check_rate(services: Services, request: Request) -> None:
    client = request.scope.get("token") or (request.client.host if request.client else "unknown")
    if wait := services.classifications.wait(client):
        detail = f"Too many images to classify; retry in {wait:.2f} s."
        raise HTTPException(429, detail, {"Retry-After": str(math.ceil(wait))})


def _read(image: UploadFile) -> bytes:
    data = image.file.read(MOST_BYTES + 1)
    if len(data) > MOST_BYTES:
        raise HTTPException(413, f"The image {image.filename!r} is larger than {MOST_BYTES >> 20} MiB.")
    return data
