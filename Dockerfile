# The images of Trompe: renderer (no torch), server (REST API, migration), worker (attacks), cluster (attacks on Ray).
#
#   TORCH_INDEX  index of torch. Default: its builds for CPUs; empty: PyPI's, which include CUDA.
#   WHEELS       image with additional wheels in its root folder. Default: none.
ARG WHEELS=scratch

FROM ${WHEELS} AS wheels
WORKDIR /

FROM python:3.11-slim AS python
ENV PATH=/opt/trompe/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1
RUN groupadd --gid 10001 trompe \
 && useradd --uid 10001 --gid trompe --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin trompe \
 && python -m venv --without-pip /opt/trompe

# Requirements are a layer below our code, so that an edit rebuilds only a small layer. pip reads them from a wheel of
# Trompe without code.
FROM python AS requirements
WORKDIR /requirements
COPY pyproject.toml deploy/image/constraints.txt ./
RUN mkdir -p client/trompe_client experiments/trompe_experiments server/trompe_server renderer_worker/trompe_renderer shared/trompe_shared \
 && touch README.md client/trompe_client/__init__.py \
 && pip wheel --no-deps --wheel-dir . .

FROM python AS project
WORKDIR /source
COPY . .
RUN pip --python /opt/trompe/bin/python install --no-deps --root /project .

FROM python AS renderer
RUN apt-get update \
 && apt-get install --yes --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \
 && apt-get clean && rm -rf /var/lib/apt/lists/*
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=bind,from=requirements,source=/requirements,target=/requirements \
    pip --python /opt/trompe/bin/python install -c /requirements/constraints.txt \
      "$(echo /requirements/*.whl)[renderer]" \
 && pip --python /opt/trompe/bin/python uninstall --yes trompe
COPY deploy/image/renderer_health.py /opt/health.py
COPY --from=project /project /
USER trompe
EXPOSE 8085
HEALTHCHECK --interval=10s --timeout=10s --start-period=60s CMD ["python", "/opt/health.py"]
ENTRYPOINT ["trompe"]
CMD ["render", "--host", "0.0.0.0"]

FROM python AS server
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=bind,source=deploy/image/constraints.txt,target=/constraints.txt \
    --mount=type=bind,from=wheels,target=/wheels \
    pip --python /opt/trompe/bin/python install -c /constraints.txt --find-links /wheels \
      ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} torch torchvision \
 && cd /opt/trompe/lib/python3.11/site-packages/torch \
 && rm -rf include test \
 && find bin -type f ! -name torch_shm_manager -delete
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=bind,from=requirements,source=/requirements,target=/requirements \
    pip --python /opt/trompe/bin/python install -c /requirements/constraints.txt \
      "$(echo /requirements/*.whl)[vision,s3]" \
 && pip --python /opt/trompe/bin/python uninstall --yes trompe
# assimp reads FBX files.
RUN apt-get update \
 && apt-get install --yes --no-install-recommends assimp-utils \
 && apt-get clean && rm -rf /var/lib/apt/lists/*
COPY deploy/image/api_health.py /opt/health.py
COPY deploy/image/make_secrets.py /opt/
COPY --from=project /project /
RUN install --directory --owner=trompe --group=trompe --mode=0700 /data /models /objects \
 && install --directory --owner=trompe --group=trompe --mode=0750 /secrets/token /secrets/database /secrets/objects /secrets/cluster
ENV TROMPE_DATA=/data TORCH_HOME=/models
USER trompe
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=10s --start-period=60s CMD ["python", "/opt/health.py"]
ENTRYPOINT ["trompe"]
CMD ["serve", "--host", "0.0.0.0"]

FROM server AS worker
COPY deploy/image/worker_health.py /opt/health.py
HEALTHCHECK --interval=15s --timeout=14s --start-period=60s CMD ["python", "/opt/health.py"]
CMD ["worker"]

FROM worker AS cluster
USER root
RUN --mount=type=cache,target=/root/.cache/pip --mount=type=bind,from=requirements,source=/requirements,target=/requirements \
    pip --python /opt/trompe/bin/python install -c /requirements/constraints.txt "ray[default]>=2.60"
USER trompe
