"""The views that an attack adds to its first ones: those of its pool that its paint does not win yet.

An attack starts with a part of its pool, because many objects need no more. At some of its steps the target shows the
repainted object in the next views of the pool. If too many of these are lost, the attack probes those that are not
safely won, and goes on with them. Where few views show the object recognised at all, few can be lost: it then looks at
more of them, and fewer losses are too many. It never looks at held-out views.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from trompe_server.attack import AttackState
from trompe_server.attack.goal import SAFE_MARGIN
from trompe_server.attack.search import finished, went_on
from trompe_server.job.files import JobFiles
from trompe_server.job.setup import JobSetup
from trompe_server.surrogate import Geometry, Image8, Surrogate, prepare_geometry
from trompe_server.surrogate.calibration import Calibration, build_surrogate, painted_grey
from trompe_server.surrogate.tone import Ask
from trompe_shared.geometry import View
from trompe_shared.object3d import Object3D

LOOKS: Final = (10, 20, 30)
"""Steps after which an attack looks at further views. It also does so whenever all its views are safely won."""

FEW_LOST: Final = 0.02
"""Share of the recognised views that may be lost without more probes."""

LEAST_KNOWN: Final = 0.25
"""Share of recognised views below which no more views are looked at."""


@dataclass(frozen=True)
class _Look:
    """The views that one look added, with their surrogate if there are any; it saw ``further`` views up to ``end``."""

    views: tuple[View, ...]
    surrogate: Surrogate | None
    end: int


class GrowingPool:
    """The pool of a job. Its looks are in the job's ``files``, each by the chunk of steps before which it was taken.

    ``known``: share of the first views in which the unpainted object is recognised.
    """

    def __init__(self, setup: JobSetup, files: JobFiles, calibration: Calibration, known: float) -> None:
        self._setup, self._files, self._calibration, self._known = setup, files, calibration, known
        self._looks: dict[int, _Look] = {}
        self._loaded = False

    @property
    def views(self) -> tuple[View, ...]:
        """The added views."""
        return tuple(view for look in self._looks.values() for view in look.views)

    @property
    def surrogates(self) -> tuple[Surrogate, ...]:
        """The surrogates of the added views."""
        return tuple(look.surrogate for look in self._looks.values() if look.surrogate is not None)

    def load(self, chunk: int) -> None:
        """Take up the looks before ``chunk``. Raises ``DamagedFileError``."""
        if not self._loaded:
            self._looks = {earlier: self._opened(found) for earlier, found in self._files.load_looks(chunk).items()}
            self._loaded = True
        self._looks = {earlier: look for earlier, look in self._looks.items() if earlier < chunk}

    def due(self, state: AttackState) -> bool:
        """Whether to look at further views before the next step."""
        last = next(reversed(self._looks.values()), None)
        if self._seen == len(self._setup.further) or (last is not None and not last.views):
            return False
        return state.step in LOOKS or finished(state.memory, self._setup.goal)

    def look(self, chunk: int, state: AttackState, painted: Object3D, ask: Ask) -> AttackState:
        """Look at further views before the steps of ``chunk``; the state to go on with."""
        setup, first = self._setup, self._seen
        further = setup.further[first : first + round(len(setup.views) / max(self._known, LEAST_KNOWN))]
        lost, unsafe = self._verdicts(ask(painted, self._shown(further)))
        chosen = np.flatnonzero(unsafe) if lost.mean() > FEW_LOST * self._known else np.zeros(0, np.int64)
        views = [further[k] for k in chosen]
        arrays, geometry = {"index": first + chosen, "end": np.array(first + len(further))}, None
        if views:
            with ThreadPoolExecutor(1, thread_name_prefix="rasterise") as executor:
                prepared = executor.submit(self._geometry, views)
                arrays |= self._probed(views, ask)
            geometry = prepared.result()
        renders = len(further) + len(views) * (1 + len(self._calibration.greys))
        self._files.save_look(chunk, arrays, views=len(views), renders=renders)
        self._looks[chunk] = self._opened(arrays, geometry)
        return replace(state, memory=went_on(state.memory, setup.goal, shown=len(further), added=len(views)))

    @property
    def _seen(self) -> int:
        return max((look.end for look in self._looks.values()), default=0)

    def _shown(self, views: Sequence[View]) -> list[View]:
        return self._setup.renderers[0].shown(views)

    def _verdicts(self, images: Image8) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(Lost, not safely won) views by their images, for any of the classifiers. The margin is that of plain images:
        those of a pipeline would have nearly all views probed."""
        goal = replace(self._setup.goal, safe=min(self._setup.goal.safe, SAFE_MARGIN))
        logits = [torch.from_numpy(member.predict(images)) for member in self._setup.members]
        lost, unsafe = (~torch.stack([won(each) for each in logits]).all(0) for won in (goal.reached, goal.settled))
        return lost.numpy(), unsafe.numpy()

    def _probed(self, views: Sequence[View], ask: Ask) -> dict[str, Image8]:
        obj, shown, greys = self._setup.obj, self._shown(views), self._calibration.greys
        clean = ask(obj, shown)
        probes = np.array([ask(painted_grey(obj, grey), shown) for grey in greys], np.uint8)
        return {"clean": clean, "probes": probes.reshape(len(greys), *clean.shape)}

    def _geometry(self, views: Sequence[View]) -> Geometry:
        setup, sampling = self._setup, self._calibration.sampling
        return prepare_geometry(setup.obj, views, size=setup.size, sampling=sampling, device=setup.device)

    def _opened(self, found: Mapping[str, NDArray[Any]], geometry: Geometry | None = None) -> _Look:
        views, end = tuple(self._setup.further[k] for k in found["index"]), int(found["end"])
        if not views:
            return _Look(views, None, end)
        setup = self._setup
        surrogate = build_surrogate(
            replace(self._calibration, probes=found["probes"]),
            setup.obj,
            self._shown(views),
            found["clean"],
            geometry=geometry,
            backdrops=setup.backdrops,
            device=setup.device,
        )
        return _Look(views, surrogate, end)
