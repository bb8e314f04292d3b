# docker build -t stillmap .
# docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/data" stillmap map log.bag -o out
# The recording lies in the mounted folder, and the result appears in it, owned by the caller.
ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
RUN apt-get update && apt-get install --yes --no-install-recommends \
    g++ python3 python3-dev python3-pip python3-venv
COPY . /source
RUN python3 -m pip wheel --no-deps --wheel-dir /wheels /source

FROM ${BASE}
RUN apt-get update \
  && apt-get install --yes --no-install-recommends python3 python3-venv \
  && rm -rf /var/lib/apt/lists/*
# optional dependencies: io (LAS, E57, Parquet), mesh; empty for none
ARG EXTRAS=io
COPY --from=build /wheels /wheels
RUN python3 -m venv /opt/stillmap \
  && /opt/stillmap/bin/pip install --no-cache-dir --no-compile \
    "$(echo /wheels/stillmap-*.whl)${EXTRAS:+[$EXTRAS]}" \
  && rm -rf /wheels \
  && useradd --create-home stillmap \
  && mkdir /data && chown stillmap /data
ENV PATH=/opt/stillmap/bin:$PATH PYTHONDONTWRITEBYTECODE=1
USER stillmap
WORKDIR /data
ENTRYPOINT ["stillmap"]
CMD ["--help"]
