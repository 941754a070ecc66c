# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0

# Two images, each of one target:
#     docker build --target robot -t surfel_mapper:robot .        ROS 2 Jazzy from apt, the node
#     docker build --target desktop -t surfel_mapper:desktop .    bags and scans, no ROS
# `--net=host --ipc=host` lets the node see the topics of the machine; a folder of bags and maps
# is mounted at /data. Neither runs as root. Fast DDS cannot open the shared memory of another user,
# and the user of the image owns its kernels: build with `--build-arg UID=$(id -u)` of the user that
# runs the driver. `develop` is the image of .devcontainer.

FROM ros:jazzy-ros-base AS robot
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# numba, rosbags and mcap have no apt packages on Ubuntu 24.04, and packages of the system stay as they are.
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends \
        python3-argcomplete python3-matplotlib python3-numpy python3-pil python3-scipy python3-tqdm python3-venv \
        python3-yaml ros-jazzy-launch-ros ros-jazzy-nav-msgs ros-jazzy-tf2-msgs \
        ros-jazzy-visualization-msgs \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv --system-site-packages /opt/surfel_mapper_venv \
    && /opt/surfel_mapper_venv/bin/pip install --no-cache-dir \
        'numba>=0.61' 'rosbags>=0.11.7,<0.12' 'mcap>=1.1'
COPY . /ros2_ws/src/surfel_mapper
WORKDIR /ros2_ws
ARG UID=1000
RUN source /opt/ros/jazzy/setup.bash && colcon build --packages-select surfel_mapper \
    && useradd --uid "$UID" --non-unique --create-home mapper \
    && install -d -o mapper /data /var/cache/surfel_mapper
USER mapper
ENV PATH=/opt/surfel_mapper_venv/bin:$PATH NUMBA_CACHE_DIR=/var/cache/surfel_mapper
# Kernels are compiled for the processor that builds the image; another kind compiles its own.
RUN source /opt/ros/jazzy/setup.bash && source install/setup.bash \
    && python3 -m surfel_mapper.cli.main compile
WORKDIR /data
ENTRYPOINT ["/bin/bash", "-c", \
    "source /opt/ros/jazzy/setup.bash && source /ros2_ws/install/setup.bash && exec \"$@\"", "--"]
CMD ["ros2", "launch", "surfel_mapper", "mapper.launch.py"]

FROM python:3.12-slim AS develop
# make, git and a browser: for the tests, and for those that open report.html
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends chromium git make \
    && rm -rf /var/lib/apt/lists/*

FROM python:3.12-slim AS desktop
COPY . /src
ENV NUMBA_CACHE_DIR=/var/cache/surfel_mapper
ARG UID=1000
RUN pip install --no-cache-dir '/src[cluster,formats,las]' && rm -rf /src \
    && useradd --uid "$UID" --non-unique --create-home mapper \
    && install -d -o mapper /data /var/cache/surfel_mapper
USER mapper
RUN surfel-mapper compile
WORKDIR /data
ENTRYPOINT ["surfel-mapper"]
CMD ["--help"]
