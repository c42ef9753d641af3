# facerf on the processor. Build and run:
#   docker build -t facerf .
#   docker run --rm -v "$PWD:/work" facerf relight me.jpg --light 40,25 -o out
FROM python:3.12-slim

# numpy, torch and OpenImageIO come as wheels; dlib and embree need only the C++ runtime.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libgomp1 libstdc++6 \
    && rm -rf /var/lib/apt/lists/*

# All that the wheel holds (pyproject.toml: package-data and data-files).
COPY pyproject.toml MANIFEST.in constraints.txt LICENSE README.md MODEL_CARD.md CHANGELOG.md /src/
COPY facerf_cli /src/facerf_cli
COPY man /src/man
COPY docs /src/docs
COPY examples /src/examples
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu -c /src/constraints.txt /src \
    && rm -rf /src

RUN useradd --create-home facerf
USER facerf
WORKDIR /work
ENTRYPOINT ["facerf"]
