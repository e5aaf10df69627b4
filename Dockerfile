# The command line:  docker build --target cli -t fgtrack .
#                    docker run --rm --user "$(id -u)" -v "$PWD:/data" fgtrack replay drive.mcap -o /data/run
# The ROS 2 node:    docker build --target node -t fgtrack-ros .
#                    docker run --rm --net=host -v "$PWD:/data" fgtrack-ros parameters:=/data/MY.yaml
ARG PYTHON=3.12
# Its message packages must have been built with NumPy 2, as those of Ubuntu 26.04.
ARG ROS_DISTRO=lyrical

FROM python:${PYTHON}-slim AS build
WORKDIR /src
RUN python -m venv /opt/fgtrack
ENV PATH=/opt/fgtrack/bin:$PATH
COPY requirements/install.txt requirements/run.txt requirements/
RUN pip install --no-cache-dir --disable-pip-version-check --require-hashes -r requirements/install.txt \
    && uv pip install --no-cache --require-hashes -r requirements/run.txt
COPY pyproject.toml README.md LICENSE ./
COPY configs configs
COPY fgtrack fgtrack
RUN uv pip install --no-cache --no-deps --no-build-isolation . \
    && pip uninstall --yes --quiet uv

FROM python:${PYTHON}-slim AS cli
RUN useradd --create-home --uid 10001 fgtrack
COPY --from=build /opt/fgtrack /opt/fgtrack
# Compiled loops are stored in /tmp/fgtrack: mount a volume there, and they are compiled once.
ENV PATH=/opt/fgtrack/bin:$PATH OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=/tmp/fgtrack
USER fgtrack
WORKDIR /data
ENTRYPOINT ["fgtrack"]
CMD ["--help"]

FROM ros:${ROS_DISTRO}-ros-base AS node
ARG ROS_DISTRO
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-venv python3-colcon-common-extensions \
       ros-${ROS_DISTRO}-vision-msgs ros-${ROS_DISTRO}-diagnostic-msgs ros-${ROS_DISTRO}-tf2-ros \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 10001 fgtrack
COPY requirements/install.txt requirements/run.txt /src/requirements/
RUN python3 -m venv --system-site-packages /opt/fgtrack \
    && /opt/fgtrack/bin/python -m pip install --no-cache-dir --require-hashes -r /src/requirements/install.txt \
    && /opt/fgtrack/bin/python -m pip install --no-cache-dir --require-hashes -r /src/requirements/run.txt
COPY pyproject.toml README.md LICENSE /src/
COPY configs /src/configs
COPY fgtrack /src/fgtrack
COPY ros2/fgtrack_ros /src/ros2/fgtrack_ros
RUN /opt/fgtrack/bin/python -m pip install --no-cache-dir --no-deps --no-build-isolation /src \
    && . /opt/ros/${ROS_DISTRO}/setup.sh \
    && cd /src/ros2 \
    && /opt/fgtrack/bin/python -m colcon build --install-base /opt/fgtrack_ros --merge-install --packages-select fgtrack_ros
ENV ROS_DISTRO=${ROS_DISTRO} OPENBLAS_NUM_THREADS=1 NUMBA_CACHE_DIR=/tmp/fgtrack \
    PATH=/opt/fgtrack/bin:$PATH
USER fgtrack
WORKDIR /data
ENTRYPOINT ["/bin/bash", "-c", ". /opt/ros/$ROS_DISTRO/setup.bash && . /opt/fgtrack_ros/setup.bash && exec ros2 launch fgtrack_ros tracker.launch.py \"$@\"", "launch"]
