"""Judgements of the painted objects of an experiment, beside the unpainted object and noise.

All objects of an experiment are judged on views that no attack has seen; ``judgements.csv`` has a row for each.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from trompe_client._plan import Upload
from trompe_experiments.plan import Plan, Row
from trompe_experiments.service import Service
from trompe_experiments.table import RowId, job_key, read_table, write_table
from trompe_server.formats import import_file
from trompe_shared.api import ADVERSARIAL, AS_RENDERED, JobRequest, Manifest, levels_within
from trompe_shared.comparison import grouped
from trompe_shared.errors import SpecError
from trompe_shared.object3d import Object3D, load_object
from trompe_shared.shipped import shipped_objects

JUDGEMENTS: Final = "judgements.csv"
NOTHING, NOISE = "no change", "noise"
"""What is judged beside the painted objects: the object itself, and random noise within the first job's epsilon."""

HALF_SIZE, JPEG = "half size", "JPEG 30"


class JudgedRow(RowId):
    """One judgement. Shares, intervals and colour differences as in ``Accuracy`` and ``Visibility``.

    seconds: of the attack. max_levels: largest change of a texel, in levels of 255.
    """

    object: str
    views: int
    a_before: float
    a_after: float | None = None
    a_drop: float | None = None
    a_drop_low: float | None = None
    a_drop_high: float | None = None
    half_size_drop: float | None = None
    jpeg_drop: float | None = None
    delta_e: float | None = None
    max_levels: int | None = None
    seconds: float | None = None

    @classmethod
    def of(cls, place: RowId, name: str, manifest: Manifest, seconds: float | None) -> Self:
        """A judgement with one network and one renderer. Raises ``SpecError`` for one without figures."""
        through = {cell.pipeline: cell.accuracy for cell in manifest.cells}
        drops = {pipeline: each.a_drop for pipeline, each in through.items() if each is not None}
        found, seen = through.get(AS_RENDERED), manifest.renderers[0].visibility
        if found is None:
            why = [each.text for each in manifest.findings if each.kind in {"network", "renderer"}] or ["no figures"]
            raise SpecError(f"{name}, {place.configuration}: {why[0]}")
        low, high = found.a_drop_interval or (None, None)
        return cls(
            **place.model_dump(),
            object=name,
            views=found.views,
            a_before=found.a_before,
            a_after=found.a_after,
            a_drop=found.a_drop,
            a_drop_low=low,
            a_drop_high=high,
            half_size_drop=drops.get(HALF_SIZE),
            jpeg_drop=drops.get(JPEG),
            delta_e=seen.delta_e,
            max_levels=max((each.max_levels for each in manifest.textures), default=None),
            seconds=seconds,
        )


def judge_all(
    plan: Plan, service: Service, folder: Path, *, seconds: Mapping[str, float | None], show: Callable[[str], None]
) -> list[JudgedRow]:
    """Judge all painted objects in ``folder``, and write the table. Rows of equal judgements are kept.

    seconds: of each job, by key. show: gets a line before each judgement, for each painting that is missing, and for
    each judgement without figures. Raises ``ClientError``.
    """
    path, options = folder / JUDGEMENTS, json.dumps(plan.experiment.judgement, sort_keys=True)
    known = {row.key: row for row in read_table(path, JudgedRow, optional=True)}
    rows: list[JudgedRow] = []
    for name, own in grouped(plan.rows, lambda row: row.object).items():
        for place, after in _judged(own, folder):
            key = job_key(place.experiment, own[0].request.spec(), place.key, options)
            if key not in known:
                if after is None:
                    show(f"no painting of {name}, {place.configuration} in {str(folder)!r}")
                    continue
                show(f"judging {name}, {place.configuration}")
                manifest = _judgement(plan, own[0], after, service, key=key)
                try:
                    known[key] = JudgedRow.of(place, name, manifest, seconds.get(place.key))
                except SpecError as error:
                    show(str(error))
                    continue
            rows.append(known[key].model_copy(update=place.model_dump() | {"key": key, "object": name}))
            write_table(path, rows, JudgedRow)
    return rows


def noised(obj: Object3D, epsilon: float, *, seed: int) -> Object3D:
    """``obj`` with uniform random noise within ``epsilon`` on each channel of each texel."""
    generator, most = np.random.default_rng(seed), levels_within(epsilon)

    def noisy(image: Any) -> Any:
        noise = generator.integers(-most, most, size=image.shape, endpoint=True)
        return np.clip(image.astype(np.int16) + noise, 0, 255).astype(np.uint8)

    return obj.with_textures({name: noisy(image) for name, image in obj.textures.items()})


def _judged(rows: Sequence[Row], folder: Path) -> Iterator[tuple[RowId, Upload | str | None]]:
    """What to judge of one object: the object itself, with noise, and painted by each job; ``None`` without a file."""
    first = rows[0]
    given, request = first.attack.options["object"], first.request
    for case in (NOTHING, NOISE):
        place = first.place.model_copy(update={"case": case, "configuration": case, "key": f"{first.key} {case}"})
        yield place, given if case == NOTHING else _noise(given, request)
    for row in rows:
        file = min((folder / "jobs" / row.key).glob(f"*{ADVERSARIAL}.zip"), default=None)
        yield row.place, None if file is None else Upload(file.name, file)


def _noise(given: Upload | str, request: JobRequest) -> Upload:
    if isinstance(given, Upload):
        obj = load_object(import_file(given.content, name=given.filename).archive)
    else:
        obj = load_object(shipped_objects()[given].read())
    return Upload("noise.zip", noised(obj, request.paint.epsilon, seed=request.search.seed).to_zip())


def _judgement(plan: Plan, row: Row, after: Upload | str, service: Service, *, key: str) -> Manifest:
    """Judge ``after`` as the jobs of its object were asked to; see ``Row.judgement``."""

    def stored(given: Upload | str) -> str:
        return service.store(given) if isinstance(given, Upload) else given

    before, network = stored(row.attack.options["object"]), stored(row.network)
    options = plan.experiment.judgement or {}
    return service.judge(row.judgement(options, before=before, after=stored(after), network=network), key=key)
