# Trabecula in a container:
#
#   docker build -t trabecula .
#   docker run --rm --shm-size=1g -v "$PWD/out:/work/out" trabecula run --mode lockstep
#
# --shm-size: a run's messages lie in /dev/shm; the default scene takes 190 MB there, and Docker gives 64 MB. --ipc: see docs/install.md.
FROM rust:1.95.0-bookworm AS build
# The image's compiler, not the newest that rust-toolchain.toml would fetch: it stands in every log.
ENV RUSTUP_TOOLCHAIN=1.95.0
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends python3-pip && rm -rf /var/lib/apt/lists/*
COPY . /trabecula
RUN pip wheel --no-cache-dir --no-deps -w /wheels /trabecula

FROM python:3.11-slim-bookworm
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && rm -r /wheels && useradd --create-home --uid 1000 trabecula \
    && install -d -o 1000 /work /work/out
USER 1000
WORKDIR /work
ENTRYPOINT ["trabecula"]
CMD ["run"]
