# polysft in a container, on the CPU (x86-64):
#     docker build -t polysft .
#     docker run --rm --user $(id -u):$(id -g) -v "$PWD:/work" polysft demo
# The results lie in out/demo of the current folder.

FROM python:3.12-slim AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
COPY constraints.txt /tmp/
# The first start of Python as root finishes the installation of LLVM, whose links it makes
RUN --mount=type=bind,from=build,source=/wheels,target=/wheels \
    pip install --no-cache-dir -c /tmp/constraints.txt /wheels/*.whl \
    && python -m polyfit.backend
# For the caches of whatever user runs it
ENV HOME=/tmp
WORKDIR /work
ENTRYPOINT ["polysft"]
