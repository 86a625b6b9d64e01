"""The surrogates of a job: each attacked renderer has its calibration; equal sampling models share their geometry."""

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from trompe_server.job.files import JobFiles
from trompe_server.job.setup import PROBE_STREAM, JobSetup
from trompe_server.storage.folders import Folder
from trompe_server.surrogate import Geometry, Image8, SamplingModel, Surrogate, prepare_geometry
from trompe_server.surrogate.calibration import Calibration, build_surrogate, calibrate
from trompe_server.surrogate.calibration_file import calibration_key, pack_calibration, unpack_calibration
from trompe_server.surrogate.tone import Ask
from trompe_shared.api import SearchOptions

logger = logging.getLogger(__name__)


class JobCalibrations:
    """Calibrations of a job's attacked renderers in its ``files``; ``shared`` ones serve later jobs too."""

    def __init__(self, setup: JobSetup, search: SearchOptions, files: JobFiles, shared: Folder) -> None:
        self._setup, self._search, self._files, self._shared = setup, search, files, shared
        self._geometries: dict[SamplingModel, Future[Geometry]] = {}

    def make(self, number: int, clean: Image8, ask: Ask) -> None:
        """Calibrate the attacked renderer ``number`` by its images of the unpainted object, unless that is done."""
        if self._files.has_calibration(number):
            return
        setup, search, renderer = self._setup, self._search, self._setup.attacked[number]
        shown, engine = renderer.shown(setup.views), renderer.engine
        key = calibration_key(setup.obj, shown, clean, engine=engine, wanted=search.surrogate, seed=search.seed)
        known = self._stored(name := f"{key}.npz")
        if known is None:
            found = self._probe(number, clean, ask)
        else:
            found = replace(known, renders=0, reason=f"{known.reason} (known from an earlier job)")
        packed = pack_calibration(found)
        self._files.save_calibration(number, packed)
        if found.renders:
            self._shared.write(name, packed)

    def all(self) -> list[Calibration]:
        """The calibrations of all attacked renderers. Raises ``DamagedFileError``."""
        return [self._files.load_calibration(number) for number in range(len(self._setup.attacked))]

    def surrogate(self, number: int, calibration: Calibration, clean: Image8) -> Surrogate:
        setup = self._setup
        self._prepare_geometry(calibration.sampling)
        return build_surrogate(
            calibration,
            setup.obj,
            setup.attacked[number].shown(setup.views),
            clean,
            geometry=self._geometries[calibration.sampling].result(),
            backdrops=setup.backdrops,
            device=setup.device,
        )

    def _stored(self, name: str) -> Calibration | None:
        """A shared calibration, marked as used; ``None`` if there is none or it is damaged."""
        if not self._shared.exists(name):
            return None
        try:
            found = unpack_calibration(self._shared.read(name))
        except (ValueError, OSError):
            logger.warning("the stored calibration %s is damaged; probing the target again", name)
            return None
        self._shared.touch(name)
        return found

    def _probe(self, number: int, clean: Image8, ask: Ask) -> Calibration:
        setup, search = self._setup, self._search
        return calibrate(
            setup.obj,
            setup.attacked[number].shown(setup.views),
            clean,
            ask,
            wanted=search.surrogate,
            generator=np.random.default_rng([search.seed, PROBE_STREAM]),
            backdrops=setup.backdrops,
            on_sampling=self._prepare_geometry,
            deterministic=setup.attacked[number].engine.deterministic,
            device=setup.device,
        )

    def _prepare_geometry(self, sampling: SamplingModel) -> None:
        """Rasterise all views once, in a thread: while the renderer is busy with the probes."""
        if sampling in self._geometries:
            return
        setup = self._setup
        executor = ThreadPoolExecutor(1, thread_name_prefix="rasterise")
        self._geometries[sampling] = executor.submit(
            prepare_geometry, setup.obj, setup.views, size=setup.size, sampling=sampling, device=setup.device
        )
        executor.shutdown(wait=False)
