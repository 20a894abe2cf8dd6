# The demo in a container:
#     docker build --build-arg UID="$(id -u)" --tag torch-ekm .
#     mkdir -p demo_output && docker run --rm --volume "$PWD/demo_output:/torch_ekm/demo_output" torch-ekm
FROM python:3.11-slim

# libraries of OpenCV, SAPIEN and VTK, which the slim image lacks
RUN apt-get update \
    && apt-get install --yes --no-install-recommends make libgl1 libglib2.0-0 libgomp1 libx11-6 libxrender1 libvulkan1 \
    && rm -rf /var/lib/apt/lists/*

# builds of torch for the CPU, at the version of constraints.txt
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu PIP_NO_CACHE_DIR=1

# nothing runs as root; the user's number is that of who is to own the demo's output
ARG UID=1000
RUN useradd --create-home --uid "$UID" ekm && install --directory --owner ekm /torch_ekm
USER ekm
WORKDIR /torch_ekm
COPY --chown=ekm . .
RUN make install
CMD ["make", "demo"]
