"""The report of a job: ``result.json``, pictures, models."""

from collections.abc import Callable, Mapping, Sequence

from trompe_server.job.protocol import VIEWS_AFTER, VIEWS_BEFORE, Artifacts, numbered
from trompe_server.job.report.data import ReportData
from trompe_server.job.report.models import model_files
from trompe_server.job.report.pictures import picture_files, saliency_views
from trompe_server.job.report.result import result_of, worst

__all__ = ["ReportData", "saliency_views", "worst", "write_report"]


def write_report(
    seen: Sequence[ReportData],
    artifacts: Artifacts,
    *,
    seconds: Callable[[], Mapping[str, float]],
    warnings: Sequence[str] = (),
) -> tuple[str, ...]:
    """Write all files for the user; returns their names, with those of the target's images.

    ``seen``: one for each renderer; pictures are of the ``worst`` one. ``seconds`` by kind of phase, up to now: the
    result accounts for the files too, as ``report``.
    """
    data = worst(seen)
    result, judged = result_of(seen, warnings), seconds()
    files, refused = picture_files(data), list[str]()
    if data.painted is not None:
        models, refused = model_files(data.painted, data.setup.object_name, data.setup.original)
        files |= models
    for name, content in files.items():
        artifacts.write(name, content)
    spent = {**judged, "report": sum(seconds().values()) - sum(judged.values())}
    told = {name: round(each, 3) for name, each in spent.items()}
    result = result.model_copy(update={"seconds": told, "warnings": [*result.warnings, *refused]})
    artifacts.write("result.json", result.model_dump_json(indent=1).encode())
    kinds = [VIEWS_BEFORE, VIEWS_AFTER] if data.after is not None else [VIEWS_BEFORE]
    images = [f"{numbered(kind, each.number)}.npz" for kind in kinds for each in seen]
    return tuple(sorted([*files, "result.json", *images]))
